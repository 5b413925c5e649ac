"""derender sample: draw scenes from a prior, with their depth images."""

from pathlib import Path

import click

from derender.cli import options
from derender.cli.options import Talk
from derender.cli.reading import sample_name
from derender.errors import Idle


@click.command()
@click.argument("prior", default="tabletop", metavar="[PRIOR]")
@click.option("-n", "count", type=click.IntRange(1, 1_000_000), default=1, help="How many scenes.")
@options.output(
    "Folder for the files; - streams the scenes as YAML documents to stdout, without images.", "FOLDER", default="."
)
@click.option("--images/--no-images", default=True, help="Write a depth image for each scene.")
@click.option("--noise/--no-noise", default=True, help="Draw the image from the likelihood (Eq. 6), or clean.")
@options.camera
@options.renderer
@options.seed
@options.verbosity
@options.tells_idle(
    Idle(("noise", "renderer", "images"), lambda given: given["output"] == "-", "-o - streams scenes without images"),
    Idle(("noise", "renderer"), lambda given: not given["images"], "--no-images draws none"),
)
def command(
    prior: str,
    count: int,
    output: str,
    images: bool,
    noise: bool,
    camera: str | None,
    renderer: str,
    seed: int,
    talk: Talk,
) -> None:
    """Draw scenes from PRIOR: a prior file, or the name of a built-in one.

    Built in: tabletop (default), bare-image (what `infer IMAGE` believes), stack, two-stacks, relations, free, grammar,
    algorithm-1, one-box, figure-4, figure-5. Writes sample_000.yaml, the scene, and sample_000.npz, its depth image
    with the camera, and so on. Scene number k is the same whatever -n is.

    \b
    Examples:
        derender sample
        derender sample stack -n 20 --seed 1 -o scenes
        derender sample grammar -n 1000 --no-images -o - | derender show - | less
    """
    from derender.atomic import all_or_none, make_folder
    from derender.camera.camera_file import read_camera
    from derender.document import prior_as_seen_from, read_prior_document
    from derender.posterior.forward import draw_documents
    from derender.render.renderers import find_renderer

    document = read_prior_document(prior)
    made = {"seed": seed, "command": f"derender sample {prior} --seed {seed}" + ("" if noise else " --no-noise")}
    if prior != "-":
        made["prior"] = prior_as_seen_from(prior, Path("." if output == "-" else output))
    draws = draw_documents(document, count, seed, made)
    if output == "-":
        for number, draw in enumerate(draws):
            click.echo(("---\n" if number else "") + draw.text(), nl=False)
        return
    engine = find_renderer(renderer) if images else None
    given = read_camera(camera) if camera is not None else None
    folder = make_folder(output)
    for number, draw in enumerate(talk.counted(draws, count, "sampling scene")):
        path = folder / f"{sample_name(number, count)}.yaml"
        with all_or_none(path, path.with_suffix(".npz")):
            draw.write(path, given)
            if engine is not None:
                draw.write_image(path.with_suffix(".npz"), engine, noise, given)
        talk.detail(f"wrote {path}")
    first = folder / sample_name(0, count)
    names = f"{first}.yaml and {first.name}.npz" if images else f"{first}.yaml"
    talk.say(f"wrote {names}" + (f" and {count - 1} more" if count > 1 else ""))
