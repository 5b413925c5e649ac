"""derender eval: predicted scenes against the truth."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from derender.cli import options
from derender.cli.options import Talk
from derender.errors import DerenderError

if TYPE_CHECKING:
    import numpy as np

    from derender.cli.reading import Found


@click.command()
@click.argument("predicted", metavar="PREDICTED")
@click.argument("truth", metavar="TRUTH")
@click.option("--frame", metavar="KEY", help="Frame of BOP's scene_gt.json, where it has several.")
@click.option("--models", metavar="FILE", help="BOP's models_info.json or its folder, where it is not near the scene.")
@click.option("--background", default="0", metavar="N,N", help="Labels of a label image that are no object.")
@click.option(
    "--divisor",
    type=click.IntRange(1, 10_000),
    default=1,
    help="Labels are the image's numbers over this (10 where 21 and 22 are parts of object 2).",
)
@click.option(
    "--graph-iou",
    type=options.Finite(0, 1),
    default=0.25,
    help="Overlap from which two solids are the same object in edges and errors.",
)
@options.as_json
@options.verbosity
def command(
    predicted: str,
    truth: str,
    frame: str | None,
    models: str | None,
    background: str,
    divisor: int,
    graph_iou: float,
    as_json: bool,
    talk: Talk,
) -> None:
    """Compare PREDICTED scenes with TRUTH: files, or folders in which things of the same name go together.

    A prediction is a scene file, a folder written by `derender infer`, or JSON as `derender show --json` prints it.
    Truth may be any of these, BOP's scene_gt.json, or a label image, whose masks are compared with those of the
    prediction's rendering. Prints the F1 of objects at an overlap in volume of .5, .75 and .9, the F1 of edges, whether
    the graph is exact, errors of what was found (up to symmetry), ADD-S, and whether the prediction floats, overlaps
    itself by more than 5 mm, and stands.

    \b
    Examples:
        derender eval results/ sample_000.yaml
        derender eval predictions/ truth/ --json | jq .total
        derender eval results/ label.png --divisor 10 --background 0,1
    """
    from derender.evaluation.metrics import LABEL_SUFFIXES, compare_scenes, condition_of, mask_f1, paired, totals
    from derender.evaluation.truth import read_labels

    pairs = paired(predicted, truth)
    labels = _numbers(background)
    kinds = {right.suffix for _, _, right in pairs}
    if (frame is not None or models is not None) and ".json" not in kinds:
        raise DerenderError("this is not BOP's scene_gt.json", truth, "leave out --frame and --models")
    if (divisor != 1 or background != "0") and not kinds.intersection(LABEL_SUFFIXES):
        raise DerenderError("this is no label image", truth, "leave out --background and --divisor")
    results = []
    for name, left, right in talk.counted(pairs, len(pairs), "comparing scene"):
        talk.detail(f"{name}: {left} against {right}")
        scene, found = _scene(left)
        if right.suffix in LABEL_SUFFIXES:
            seen = read_labels(right, divisor)
            result = {"masks": mask_f1(_rendered_labels(found, left, seen.shape), seen, background=labels)}
        else:
            result = compare_scenes(scene, _scene(right, frame, models)[0], graph_iou)
        results.append({"name": name, **result, "condition": condition_of(scene)})
    total = totals(results)
    if as_json:
        click.echo(json.dumps({"total": total, "scenes": results}))
        return
    if len(results) == 1:
        for line in _details(results[0]):
            click.echo(line)
    click.echo(_total_table(total))


def _numbers(text: str) -> list[int]:
    try:
        return [int(word) for word in text.split(",") if word.strip()]
    except ValueError:
        raise click.BadParameter("give whole numbers with commas between them", param_hint="--background") from None


def _scene(path: Path, frame: str | None = None, models: str | None = None) -> Any:
    """Return a scene as `show --json` prints it, the corners of its meshes' hulls with it; and what was read."""
    from derender.cli.reading import read_scene
    from derender.evaluation.truth import read_json_scene
    from derender.physics.bodies import matter_of_graph
    from derender.report.scene_json import scene_json

    if path.suffix == ".json":
        return read_json_scene(path, frame, models), None
    found = read_scene(str(path))
    scene = scene_json(found.graph, found.posterior)
    hulls = {body.name: body.vertices for body in matter_of_graph(found.graph).bodies if body.kind == "mesh"}
    for item in scene["objects"]:
        if item["name"] in hulls and item["type"] == "mesh":
            item["vertices"] = hulls[item["name"]]
    return scene, found


def _rendered_labels(found: "Found", path: Path, shape: tuple[int, int]) -> "np.ndarray":
    """Return which solid of a predicted scene each pixel sees, planes counting as nothing."""
    import numpy as np

    from derender.render.raycast.depth import render_depth
    from derender.scene.solids import PLANE

    if found is None or found.camera is None:
        raise DerenderError("a label image needs a scene with a camera", path, "give a scene file that has one")
    if found.camera.shape != shape:
        seen = f"{found.camera.width} x {found.camera.height}"
        raise DerenderError(f"the label image is {shape[1]} x {shape[0]} pixels, the scene's camera {seen}", path)
    solids = found.graph.solids()
    label = render_depth(solids, found.camera)[1]
    return np.where(np.isin(label, np.flatnonzero(solids.kind == PLANE)), -1, label)


def _details(result: dict[str, Any]) -> Iterator[Any]:
    """Yield lines about one scene."""
    import numpy as np

    from derender.report.tables import text_table

    rows = []
    for pair in result.get("pairs", ()):
        turned = "–" if pair["rotation"] is None else f"{np.rad2deg(pair['rotation']):.2f}"
        lengths = pair["position"], max(map(abs, pair["size"])), pair["add_s"]
        position, size, add_s = (f"{1000 * length:.1f}" for length in lengths)
        rows.append([f"{pair['predicted']} = {pair['truth']}", f"{pair['iou']:.3f}", position, turned, size, add_s])
    if rows:
        yield text_table(rows, ("object", "IoU", "position, mm", "rotation, deg", "size, mm", "ADD-S, mm"))
    for key in ("missed", "extra"):
        if result.get(key):
            yield f"{key}: {', '.join(result[key])}"
    condition = result["condition"]
    if condition["floating"]:
        yield f"floating: {', '.join(condition['floating'])}"
    for a, b, depth in condition["intersecting"]:
        yield f"overlapping: {a} and {b} by {1000 * depth:.1f} mm"
    if condition["fallen"]:
        yield f"would fall: {', '.join(condition['fallen'])}"


# What the totals are called, how many of a unit make one, and their digits after the point.
TOTALS = {
    "scenes": ("scenes", 1.0, 0), "f1@0.5": ("F1 @ 0.5", 1.0, 3), "f1@0.75": ("F1 @ 0.75", 1.0, 3),
    "f1@0.9": ("F1 @ 0.9", 1.0, 3), "edge_f1": ("edge F1", 1.0, 3), "graph_exact": ("graphs exact", 1.0, 3),
    "mask_f1": ("mask F1", 1.0, 3), "median_position": ("median position error, mm", 1000.0, 2),
    "median_rotation": ("median rotation error, deg", 57.29577951308232, 2),
    "median_add_s": ("median ADD-S, mm", 1000.0, 2), "median_size": ("median size error, mm", 1000.0, 2),
    "floating": ("scenes with something floating", 1.0, 3), "intersecting": ("scenes that overlap themselves", 1.0, 3),
    "stable": ("scenes that stand", 1.0, 3),
}  # fmt: skip


def _total_table(total: dict[str, Any]) -> str:
    """Return the totals, one line each, without those that there is nothing to say about."""
    lines = [(words, f"{total[key] * scale:.{digits}f}") for key, (words, scale, digits) in TOTALS.items()
             if total[key] is not None]  # fmt: skip
    width = max(len(name) for name, _ in lines)
    return "\n".join(f"{name.ljust(width)}  {value:>8}" for name, value in lines)
