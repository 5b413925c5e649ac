"""derender infer: one depth image in, a posterior over scene graphs out."""

import sys

import click

from derender.cli import options
from derender.cli.bar import Bar
from derender.cli.options import Talk, command_line


@click.command()
@click.argument("image", metavar="IMAGE")
@click.option(
    "--scene",
    "--prior",
    "prior",
    metavar="FILE",
    help="Scene file with distributions, or a built-in prior: its objects are given, their numbers are inferred. "
    "Without it, everything is found from the image.",
)
@options.camera
@options.depth_scale
@click.option(
    "--method",
    type=click.Choice(["auto", "mcmc", "map", "smc"]),
    default="auto",
    show_default=True,
    help="auto and mcmc: chains; smc: particles; map: the single best scene. Without --scene auto weighs structures by "
    "integrals, mcmc and smc by visiting them.",
)
@click.option(
    "--gradient",
    type=click.Choice(["exact", "finite-difference"]),
    default="exact",
    show_default=True,
    help="Derivatives that --method map uses.",
)
@click.option("--shapes", metavar="NAMES", help="Without --scene: shapes to look for, such as box,cylinder.")
@click.option("--max-objects", type=click.IntRange(1, 1000), help="Without --scene: at most so many.")
@click.option(
    "--floor",
    metavar="PLANE",
    help="Without --scene: auto (find it), none, or a,b,c,d of the plane ax + by + cz + d = 0 in camera axes.",
)
@click.option("--known", metavar="FILE", help="Without --scene: a library of known objects, by size or by mesh.")
@click.option("--only-known", is_flag=True, help="There is nothing but what --known lists.")
@click.option("--allow-interpenetration", "may_overlap", is_flag=True, help="Without --scene: solids may enter others.")
@click.option("--allow-floating", "may_float", is_flag=True, help="Without --scene: solids may hang in the air.")
@click.option("--chains", type=click.IntRange(1, 1000), help="How many. Default 4, without --scene 2 of auto.")
@click.option(
    "--draws",
    type=click.IntRange(1, 10_000_000),
    help="Kept draws of each chain. Default 1000; without --scene 100, with --method mcmc 250.",
)
@click.option(
    "--warmup",
    type=click.IntRange(0, 10_000_000),
    help="Rounds in which a chain adapts. Default 200; without --scene 40, of mcmc alone.",
)
@options.jobs
@click.option("--resume", is_flag=True, help="Go on where the same command was stopped.")
@options.seed
@options.output("Folder for the results. Default: the image's name with _inferred.", None, "DIR")
@options.strict
@options.verbosity
def command(talk: Talk, **arguments) -> int | None:
    """Infer the scene graph behind the depth image IMAGE.

    IMAGE holds depth along the optical axis, not range: 16 bits a pixel (.png, .tiff) in millimetres unless
    --depth-scale or the camera says otherwise; metres in .npy, float .tiff and .exr; or an .npz that derender wrote.
    0, NaN, inf and 65535 mean no return. The camera is that of the depth image, in its pixels and without lens
    distortion; a file {"fx": 615, "fy": 615, "cx": 320, "cy": 240} is enough. Without one, a field of view of 60
    degrees is assumed. Which way is up need not be said: it is found from the floor, so leave the table around the
    things in the image.

    Writes DIR/scene.yaml (the most probable scene), DIR/posterior.npz (and posterior.nc where h5netcdf is installed),
    DIR/report.html, DIR/summary.json, DIR/observation.npz, DIR/labels.png (16 bits, k where the pixel shows the k-th
    object of `derender show DIR --json`) and DIR/explained.npy (the depth of the best scene, metres), and prints a
    table. Ctrl-C writes what there is.

    \b
    Examples:
        derender sample && derender infer sample_000.npz
        derender infer frame.png --camera camera.json -o out && derender show out
        derender infer frame.png --camera camera.json --known groceries.yaml
        derender infer sample_000.npz --scene figure-4 --chains 4 --draws 2000
    """
    from derender.structures.options import Options
    from derender.workflow import infer_to_folder

    image, prior, output, camera, depth_scale, gradient, strict = (
        arguments.pop(key) for key in ("image", "prior", "output", "camera", "depth_scale", "gradient", "strict")
    )
    if arguments["shapes"] is not None:
        arguments["shapes"] = [name.strip() for name in arguments["shapes"].split(",")]
    wanted = Options(**arguments)
    bar = Bar(sys.stderr) if sys.stderr.isatty() and talk.level >= 0 else None
    try:
        outcome = infer_to_folder(
            image, wanted, prior, output, camera, depth_scale, gradient, command_line(),
            progress=bar, say=talk.say, warn=talk.warn,
        )  # fmt: skip
    finally:
        if bar:
            bar.close()
    if sys.stdout.isatty():
        outcome.print_rich()
    else:
        click.echo(outcome.table())
    talk.detail(outcome.details())
    talk.say(f"wrote {outcome.folder}/")
    if outcome.interrupted:
        return 130
    for line in outcome.verdict():
        talk.say(line, always=not outcome.trusted)
    return 3 if strict and not outcome.trusted else None
