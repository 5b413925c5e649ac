"""derender render: scenes to depth images, or to pictures."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from derender.cli import options
from derender.cli.options import Talk
from derender.cli.reading import read_scene_document
from derender.errors import DerenderError, Idle

if TYPE_CHECKING:
    from derender.camera.intrinsics import Camera
    from derender.document import Document
    from derender.scene.graph import SceneGraph

PICTURES = (".png", ".jpg", ".jpeg", ".gif", ".bmp", ".webp")
PREVIEW_WIDTH = 640  # pixels; smaller cameras are enlarged for a picture


@click.command()
@click.argument("scenes", nargs=-1, required=True, metavar="SCENE...")
@options.output(
    "Where to: a file, whose suffix is the format (.npz .npy .png .tiff .exr); a folder/; a name with {} for the "
    "scene's; - for an .npz on stdout. Default {}.depth.npz, with --preview {}.preview.png."
)
@options.camera
@options.depth_scale
@options.renderer
@click.option("--antialias", type=click.IntRange(1, 16), default=1, metavar="N", help="N x N samples.")
@options.noise
@click.option(
    "--sensor",
    metavar="NAME|DIR",
    help="Distort as a real camera does: kinect, realsense, or as the likelihood says in a scene file or in "
    "a DIR, where infer has fitted it to an image.",
)
@click.option("--preview", is_flag=True, help="Draw a shaded colour picture instead of depth.")
@options.seed
@options.quiet
@options.tells_idle(
    Idle(("noise", "sensor", "antialias", "depth_scale"), lambda given: given["preview"], "--preview draws no depth"),
    Idle(
        ("depth_scale",),
        lambda given: Path(given["output"] or ".npz").suffix.lower() != ".png",
        "depth is in metres but in a .png",
    ),
)
def command(
    scenes: tuple[str, ...],
    output: str | None,
    camera: str | None,
    depth_scale: float | None,
    renderer: str,
    antialias: int,
    noise: bool,
    sensor: str | None,
    preview: bool,
    seed: int,
    talk: Talk,
) -> None:
    """Render SCENE files, or folders written by `derender infer`, to depth images or to pictures.

    An .npz holds depth in metres (0: no return), the camera, and which solid each pixel sees.

    \b
    Examples:
        derender render scene.yaml -o depth.png
        derender render scene.yaml --preview -o scene.png
        derender render scene.yaml --sensor kinect -o - | derender infer -
        derender render results/*/scene.yaml -o images/
    """
    from derender.camera.depth_file import write_depth
    from derender.posterior.forward import observe
    from derender.render.renderers import find_renderer

    engine = find_renderer(renderer)
    targets = _targets(scenes, output, preview)
    distort = _sensor(sensor) if sensor and not preview else None
    seeds = np.random.SeedSequence(seed).spawn(len(scenes))
    for scene, target, child in zip(scenes, targets, seeds, strict=True):
        document, rng = read_scene_document(scene), np.random.default_rng(child)
        graph, eye = document.graph, _camera(document, camera, depth_scale, talk)
        if preview:
            _write_picture(target, engine, graph, eye)
        else:
            depth, label = engine.render_depth(graph.solids(), eye, antialias=antialias)
            if noise:
                depth = observe(rng, depth, document.likelihood)
            if distort:
                depth = distort(rng, depth)
            write_depth(target, depth, eye, {"seed": seed, "command": options.command_line()}, label)
        if target != "-":
            own = camera or (scene if document.camera and scene != "-" else None)
            apart = own and not preview and Path(target).suffix.lower() != ".npz"  # else the file holds it
            unit = f" --depth-scale {depth_scale:g}" if depth_scale is not None else ""
            talk.say(f"wrote {target}" + (f" (infer needs its camera: --camera {own}{unit})" if apart else ""))


def _targets(scenes: tuple[str, ...], output: str | None, preview: bool) -> list[str]:
    """Return the name of the file for each scene, checked before anything is computed."""
    from derender.camera.depth_file import check_suffix

    suffix = ".preview.png" if preview else ".depth.npz"
    names = [_name(scene) for scene in scenes]
    pattern = output if output is not None else "{}" + suffix
    if pattern != "-" and (pattern.endswith("/") or Path(pattern).is_dir()):
        pattern = str(Path(pattern) / ("{}" + suffix))
    targets = [pattern.replace("{}", name) for name in names]
    if len(set(targets)) < len(targets):
        raise DerenderError(f"{len(scenes)} scenes go to the same file", pattern, "put {} into the name given with -o")
    for target in targets:
        if preview and Path(target).suffix.lower() not in PICTURES:
            raise DerenderError("not the name of a picture", target, "choose from " + " ".join(PICTURES))
        if not preview:
            check_suffix(target)
    return targets


def _name(scene: str) -> str:
    """Return a scene's name: that of its file, or of the folder where the file is called scene.yaml."""
    path = Path(scene)
    if scene == "-":
        return "scene"
    if path.is_dir():
        return path.resolve().name
    return path.absolute().parent.name if path.name == "scene.yaml" and path.parent.name else path.stem


def _camera(document: "Document", given: str | None, depth_scale: float | None, talk: Talk) -> "Camera":
    """Return the camera: the one given, else the scene's, else a guess."""
    from dataclasses import replace

    from derender.camera.camera_file import read_camera
    from derender.camera.intrinsics import Camera
    from derender.posterior.forward import HEIGHT, WIDTH

    camera = read_camera(given) if given is not None else document.camera
    if camera is None:
        camera = Camera.from_field_of_view(WIDTH, HEIGHT)
        talk.say(f"no camera given: {WIDTH} x {HEIGHT} pixels and a field of view of 60 degrees (--camera)")
    return camera if depth_scale is None else replace(camera, depth_scale=depth_scale)


def _sensor(name: str) -> Callable[..., Any]:
    """Return the function (rng, clean depth) -> observed depth of a sensor's name, a scene file or a folder."""
    from derender.camera.sensor import SENSORS, find_sensor
    from derender.posterior.forward import observe

    if name in SENSORS or not (Path(name).suffix or Path(name).exists()):
        return find_sensor(name).observe
    likelihood = read_scene_document(name).likelihood
    if likelihood is None:
        raise DerenderError("this scene has no likelihood", name, "take kinect, realsense, or a DIR that infer wrote")
    return lambda rng, depth: observe(rng, depth, likelihood)


def _write_picture(target: str, engine: Any, graph: "SceneGraph", camera: Any) -> None:
    """Write a picture shaded from a renderer's depth."""
    import imageio.v3 as imageio

    from derender.atomic import atomic_path
    from derender.render.renderers.preview import draw_preview
    from derender.report.pictures import colours_of

    camera, solids = camera.downscaled(1 / max(1, -(-PREVIEW_WIDTH // camera.width))), graph.solids()
    picture = draw_preview(engine.render_depth, solids, camera, colours_of(solids, graph.solid_names))
    with atomic_path(target) as temporary:
        imageio.imwrite(temporary, picture)
