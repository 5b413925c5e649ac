"""How far a predicted scene is from the true one, and whether it could be: what floats, what overlaps, what falls.

Scenes are dictionaries as `derender show --json` prints them. Lengths are metres and angles radians throughout.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.evaluation.convex import distance_to_surface, intersection_over_union, surface_points
from derender.physics.bodies import Matter, matter_of_scene
from derender.physics.statics import find_contacts
from derender.scene.pose import rotation_angle
from derender.scene.shapes.kinds import ROTATIONS

# Two planes are the same support within these: wider than any depth sensor's error, narrower than a stair.
PLANE_ANGLE = np.deg2rad(15.0)
PLANE_DISTANCE = 0.03

WITHOUT_EXTENT = ("plane", "frame")


def solids_of(scene: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the objects of a scene that have an extent."""
    return [item for item in scene["objects"] if item["type"] not in WITHOUT_EXTENT and item.get("size") is not None]


def planes_of(scene: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the planes of a scene."""
    return [item for item in scene["objects"] if item["type"] == "plane"]


def iou_matrix(predicted: Sequence[Mapping[str, Any]], truth: Sequence[Mapping[str, Any]]) -> np.ndarray:
    """Return the intersection over union of each predicted solid with each true one, (P, T) float64."""
    overlap = [[intersection_over_union(a, b) for b in truth] for a in predicted]
    return np.array(overlap, float).reshape(len(predicted), len(truth))


def assign(overlap: np.ndarray, threshold: float) -> list[tuple[int, int]]:
    """Return the one-to-one pairs with the most members, each overlapping at least `threshold`.

    Among pairings of the same number the one with the greatest summed overlap is taken (Hungarian algorithm).

    overlap : (P, T) float64 in [0, 1].
    """
    if overlap.size == 0:
        return []
    from scipy.optimize import linear_sum_assignment

    # One more pair outweighs any difference in overlap.
    value = np.where(overlap >= threshold, 1 + min(overlap.shape) + overlap, 0.0)
    rows, columns = linear_sum_assignment(value, maximize=True)
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return [pair for pair in pairs if overlap[pair] >= threshold and overlap[pair] > 0]


def match_planes(predicted: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, str]:
    """Return which true plane each predicted plane is.

    Planes have no volume: two match where their normals differ by at most 15 degrees (whichever way they point) and the
    predicted plane passes within 3 cm of the foot of the true scene on the true plane.
    """
    left, right = planes_of(predicted), planes_of(truth)
    centres = [np.asarray(item["pose"], float)[:3, 3] for item in solids_of(truth)]
    agreement = np.zeros((len(left), len(right)))
    for i, a in enumerate(left):
        for j, b in enumerate(right):
            pose_a, pose_b = np.asarray(a["pose"], float), np.asarray(b["pose"], float)
            normal = pose_b[:3, 2]
            middle = np.mean(centres, axis=0) if centres else pose_b[:3, 3]
            foot = middle - normal * float(normal @ (middle - pose_b[:3, 3]))
            angle = np.arccos(np.clip(abs(pose_a[:3, 2] @ normal), 0, 1))
            distance = abs(float(pose_a[:3, 2] @ (foot - pose_a[:3, 3])))
            if angle <= PLANE_ANGLE and distance <= PLANE_DISTANCE:
                agreement[i, j] = 1 - 0.5 * angle / PLANE_ANGLE - 0.49 * distance / PLANE_DISTANCE
    return {left[i]["name"]: right[j]["name"] for i, j in assign(agreement, 0.0)}


def f1(hits: int, predicted: int, truth: int) -> float:
    """Return the harmonic mean of precision and recall; 1 where there was nothing to find and nothing was said."""
    return 2 * hits / (predicted + truth) if predicted + truth else 1.0


THRESHOLDS = (0.5, 0.75, 0.9)
# Who rests on whom does not hang on a hidden side whose length nobody can see: matching for edges is lenient.
GRAPH_IOU = 0.25
ROOT = "root"
TOLERANCE = 0.005  # metres by which contacts of real scenes are open or closed and still are contacts


def edges_of(scene: Mapping[str, Any]) -> set[tuple[str, str]] | None:
    """Return the support edges (child, parent) of the solids, second supports included.

    Nothing rests on the root, so that a floating object has no edge. None where the scene says nothing of parents.
    """
    solids = solids_of(scene)
    if solids and not any("parent" in item for item in solids):
        return None
    bearers = ((item["name"], parent) for item in solids for parent in (item.get("parent"), *item.get("supports", ())))
    return {(name, parent) for name, parent in bearers if parent not in (None, ROOT)}


def relabellings(size: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the 24 ways to name a box's axes: (R, size along the new axes), new axes to old ones.

    The box with pose T and `size` is the box with pose T R and the size returned.
    """
    return [(rotation, np.abs(rotation.T) @ np.asarray(size, float)) for rotation in ROTATIONS]


def pose_and_size_errors(predicted: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, Any]:
    """Return errors of position, rotation and size of one solid, up to the symmetry of its shape.

    A box's axes may be named in 24 ways: the naming taken brings the corners closest together. A cylinder is the same
    turned about its axis or upside down, a sphere however it is turned. Two meshes are compared as they stand, turned
    by each of the true one's `symmetries` (K, 3, 3).

    Returns `position` (metres), `rotation` (radians; None between shapes that have no common axes) and `size`
    (three differences predicted - true along the true axes, metres).
    """
    pose_p, pose_t = np.asarray(predicted["pose"], float), np.asarray(truth["pose"], float)
    size_p, size_t = np.asarray(predicted["size"], float), np.asarray(truth["size"], float)
    kinds = {_family(predicted), _family(truth)}
    position = float(np.linalg.norm(pose_p[:3, 3] - pose_t[:3, 3]))
    rotation: float | None
    if kinds == {"sphere"}:
        rotation, size = 0.0, size_p - size_t
    elif kinds == {"cylinder"}:
        # arctan2, because arccos loses half the digits near 1.
        axis_p, axis_t = pose_p[:3, 2], pose_t[:3, 2]
        rotation = float(np.arctan2(np.linalg.norm(np.cross(axis_p, axis_t)), abs(axis_p @ axis_t)))
        size = size_p - size_t
    elif kinds == {"mesh"}:
        same = np.asarray(truth.get("symmetries", [np.eye(3)]), float)
        rotation, size = min(rotation_angle(pose_p, pose_t[:3, :3] @ turn) for turn in same), size_p - size_t
    else:
        best = min(relabellings(size_p), key=lambda way: _corner_gap(pose_p, way, pose_t, size_t))
        size = best[1] - size_t
        rotation = rotation_angle(pose_p[:3, :3] @ best[0], pose_t) if kinds == {"box"} else None
    return {"position": position, "rotation": rotation, "size": [float(value) for value in size]}


def add_s(predicted: Mapping[str, Any], truth: Mapping[str, Any]) -> float:
    """Return ADD-S in metres: the mean distance from the true surface to the nearest point of the predicted one.

    Where both are the same solid this is Hodan et al.'s measure; where sizes differ it judges size with pose.
    """
    return float(np.mean(distance_to_surface(surface_points(truth), predicted)))


def compare_scenes(
    predicted: Mapping[str, Any], truth: Mapping[str, Any], graph_iou: float = GRAPH_IOU, ignored: Collection[str] = ()
) -> dict[str, Any]:
    """Compare a predicted scene with the true one.

    predicted, truth : scenes as `derender show --json` prints them, in the same frame.
    graph_iou : overlap from which two solids count as the same object in edges, errors and the list of pairs.
    ignored : names of true objects that need not be found (too few visible pixels): neither missing them nor finding
        them counts.

    Returns `objects` (numbers and, for each threshold, hits, precision, recall, F1), `edges` (the same, None where the
    truth has none to compare), `graph_exact` (every object found, none invented, each on what it stands on; None
    likewise), `pairs` (errors of each object found), `missed`, `extra`.
    """
    left, right = solids_of(predicted), solids_of(truth)
    overlap = iou_matrix(left, right)
    spared = {j for j, item in enumerate(right) if item["name"] in ignored}

    def score(pairs: list[tuple[int, int]]) -> dict[str, Any]:
        hits = sum(j not in spared for _, j in pairs)
        said = len(left) - sum(j in spared for _, j in pairs)
        return _rates(hits, said, len(right) - len(spared))

    objects: dict[str, Any] = {"predicted": len(left), "truth": len(right) - len(spared)}
    for threshold in THRESHOLDS:
        objects[f"{threshold:g}"] = score(assign(overlap, threshold))

    pairs = assign(overlap, graph_iou)
    names = {left[i]["name"]: right[j]["name"] for i, j in pairs}
    spared_names = {right[j]["name"] for j in spared}
    extra = [item["name"] for item in left if item["name"] not in names]
    missed = [item["name"] for item in right if item["name"] not in names.values() and item["name"] not in spared_names]

    edges, exact = None, None
    said_edges, true_edges = edges_of(predicted), edges_of(truth)
    if said_edges is not None and true_edges is not None:
        translate = names | match_planes(predicted, truth)
        # An edge between things that are not in the truth is wrong, and different from every true edge.
        said = {(translate.get(c, f"?{c}"), translate.get(p, f"?{p}")) for c, p in said_edges}
        said = {edge for edge in said if not spared_names & set(edge)}
        true_edges = {edge for edge in true_edges if not spared_names & set(edge)}
        edges = _rates(len(said & true_edges), len(said), len(true_edges))
        exact = not missed and not extra and said == true_edges

    details = [
        {"predicted": a["name"], "truth": b["name"], "iou": iou, "same_type": _family(a) == _family(b),
         **pose_and_size_errors(a, b), "add_s": add_s(a, b)}
        for a, b, iou in ((left[i], right[j], float(overlap[i, j])) for i, j in pairs)
    ]  # fmt: skip
    return {
        "objects": objects,
        "edges": edges,
        "graph_exact": exact,
        "pairs": details,
        "missed": missed,
        "extra": extra,
    }


def mask_f1(predicted: np.ndarray, truth: np.ndarray, background: Collection[int] = (0,)) -> dict[str, Any]:
    """Compare label images: F1 of the objects whose masks overlap (intersection over union) by half at least.

    predicted, truth : (height, width) int, one number for each object, -1 of nothing predicted.
    background : true labels that are no object (nothing, the table).

    Returns hits, predicted, truth, precision, recall, f1, `pairs` {predicted label: true label}, `iou` (of each pair).
    """
    if predicted.shape != truth.shape:
        raise ValueError(f"label images of {predicted.shape} and {truth.shape} pixels cannot be compared")
    said = [label for label in np.unique(predicted) if label != -1]
    true = [label for label in np.unique(truth) if label not in background]
    overlap = np.zeros((len(said), len(true)))
    for i, a in enumerate(said):
        for j, b in enumerate(true):
            mask, other = predicted == a, truth == b
            overlap[i, j] = np.count_nonzero(mask & other) / np.count_nonzero(mask | other)
    pairs = assign(overlap, 0.5)
    return _rates(len(pairs), len(said), len(true)) | {
        "pairs": {int(said[i]): int(true[j]) for i, j in pairs},
        "iou": {int(said[i]): float(overlap[i, j]) for i, j in pairs},
    }


def _rates(hits: int, predicted: int, truth: int) -> dict[str, Any]:
    return {
        "hits": hits,
        "predicted": predicted,
        "truth": truth,
        "precision": hits / predicted if predicted else 1.0,
        "recall": hits / truth if truth else 1.0,
        "f1": f1(hits, predicted, truth),
    }


def _family(solid: Mapping[str, Any]) -> str:
    return "box" if solid["type"] == "cube" else solid["type"]


def _corner_gap(
    pose: np.ndarray, way: tuple[np.ndarray, np.ndarray], other: np.ndarray, other_size: np.ndarray
) -> float:
    """Return how far the corners of a box under a naming of its axes are from those of another (a sum of squares)."""
    rotation, size = way
    # Corners are centre + R (+-half sizes): the cross terms cancel in the sum over signs.
    difference = pose[:3, :3] @ rotation * (0.5 * size) - other[:3, :3] * (0.5 * other_size)
    return float(np.sum(difference**2))


def condition_of(scene: Mapping[str, Any]) -> dict[str, Any]:
    """Return what physics says of a scene as `derender show --json` prints it.

    Returns `floating` (names of what no chain of touches, within 5 mm, joins to a plane), `intersecting` ([name, name,
    metres] of what overlaps by more than 5 mm), `stable` (whether all stays where it is for two seconds; None where the
    scene has no gravity), `fallen`.
    """
    from derender.physics.simulate import judge, simulate

    known = bool(np.any(np.asarray(scene["gravity"], float)))
    matter = matter_of_scene(scene if known else {**scene, "gravity": [0.0, 0.0, -1.0]})
    verdict = judge(simulate(matter, early=True), matter) if known else None
    return {
        "floating": floating(matter),
        "intersecting": [list(pair) for pair in intersecting(matter)],
        "stable": None if verdict is None else verdict.stable,
        "fallen": [] if verdict is None else list(verdict.fallen),
    }


def gaps(matter: Matter, near: float = TOLERANCE) -> dict[tuple[str, str], float]:
    """Return how far the pairs of bodies that touch within `near` metres are apart; negative: how deep they overlap."""
    found = find_contacts(matter._replace(supports=()), near)
    pairs = zip(found.second.tolist(), found.first.tolist(), found.gap.tolist(), strict=True)
    deepest_last = sorted(pairs, key=lambda pair: -pair[2])
    return {(matter.bodies[a].name, matter.bodies[b].name): gap for a, b, gap in deepest_last}


def floating(matter: Matter, tolerance: float = TOLERANCE) -> list[str]:
    """Return the bodies that nothing joins to a plane or a fixed body, through touches within `tolerance` metres."""
    near = gaps(matter, tolerance)
    held = {body.name for body in matter.bodies if body.kind == "plane" or body.fixed}
    reached = held
    while reached:
        reached = {name for pair in near if held & set(pair) for name in pair} - held
        held |= reached
    return [body.name for body in matter.bodies if body.name not in held]


def intersecting(matter: Matter) -> list[tuple[str, str, float]]:
    """Return the pairs of bodies that overlap by more than TOLERANCE, and by how much, metres."""
    return [(*pair, -gap) for pair, gap in gaps(matter).items() if gap < -TOLERANCE]


SCENE_SUFFIXES = (".yaml", ".yml", ".json")
LABEL_SUFFIXES = (".png", ".npy", ".tif", ".tiff")


def paired(predicted: str | Path, truth: str | Path) -> list[tuple[str, Path, Path]]:
    """Return (name, prediction, truth) of what is to be compared.

    Two files are a pair, whatever their names. In folders things of the same name go together: a prediction is a scene
    file or a folder with a scene.yaml in it (which is one scene), a truth one of these or a label image.

    Raises DerenderError : nothing is there, or a truth has no prediction: a missing one is no zero to be averaged away.
    """
    left, right = Path(predicted), Path(truth)
    for path in (left, right):
        if str(path) != "-" and not path.exists():
            raise DerenderError("there is no such file or folder", path, "check the path")
        if (path / "track.json").exists():
            raise DerenderError(
                "this folder holds a film, and eval compares scenes", path, "give results of its frames"
            )
    if _is_single(left) and _is_single(right):
        return [(left.stem if left.is_file() else left.name, left, right)]
    kinds = ((left, SCENE_SUFFIXES), (right, (*SCENE_SUFFIXES, *LABEL_SUFFIXES)))
    found, true = ({} if _is_single(path) else _scenes_in(path, suffixes) for path, suffixes in kinds)
    for path, inside in ((left, found), (right, true)):
        if not inside and not _is_single(path):
            remedy = "scenes are .yaml or .json, label images .png"
            raise DerenderError("there is no scene in this folder", path, remedy)
    if _is_single(left) != _is_single(right):
        what = "one is a folder of scenes, the other a single scene"
        raise DerenderError(what, left, "give two files or two folders")
    missing = sorted(set(true) - set(found))
    if missing:
        some = ", ".join(missing[:5]) + (" ..." if len(missing) > 5 else "")
        raise DerenderError(f"{len(missing)} of {len(true)} scenes have no prediction: {some}", left)
    return [(name, found[name], true[name]) for name in sorted(true)]


def _is_single(path: Path) -> bool:
    return not path.is_dir() or (path / "scene.yaml").exists()


def _scenes_in(folder: Path, suffixes: Sequence[str]) -> dict[str, Path]:
    found: dict[str, Path] = {}
    of_run = (folder / "results.jsonl").exists()  # of `derender infer FRAMES...`: scenes are in its folders alone
    # Of several files of one name the first kind in `suffixes` is taken: a scene before a picture of it.
    ordered = sorted(folder.iterdir(), key=lambda p: suffixes.index(p.suffix) if p.suffix in suffixes else -1)
    for path in ordered:
        if path.is_dir() and (path / "scene.yaml").exists():
            found.setdefault(path.name, path)
        elif path.is_file() and path.suffix in suffixes and not of_run:
            found.setdefault(path.stem, path)
    return found


def totals(results: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what many comparisons come to: F1 over all objects and edges, shares of scenes, medians of errors.

    results : each as `metrics.compare_scenes` returns it, with `condition` from `condition_of`; or with
        `masks` from `metrics.mask_f1`.
    """
    results = list(results)
    scenes = [result for result in results if "objects" in result]
    found: dict[str, Any] = {"scenes": len(results)}
    for threshold in THRESHOLDS:
        key = f"{threshold:g}"
        found[f"f1@{key}"] = _pooled([result["objects"][key] for result in scenes])
    found["edge_f1"] = _pooled([result["edges"] for result in scenes if result["edges"] is not None])
    found["graph_exact"] = _share([result["graph_exact"] for result in scenes])
    found["mask_f1"] = _pooled([result["masks"] for result in results if "masks" in result])
    pairs = [pair for result in scenes for pair in result["pairs"]]
    for key in ("position", "rotation", "add_s"):
        values = [pair[key] for pair in pairs if pair[key] is not None]
        found[f"median_{key}"] = float(np.median(values)) if values else None
    sizes = [np.abs(pair["size"]).max() for pair in pairs]
    found["median_size"] = float(np.median(sizes)) if sizes else None
    conditions = [result["condition"] for result in results if "condition" in result]
    found["floating"] = _share([bool(each["floating"]) for each in conditions])
    found["intersecting"] = _share([bool(each["intersecting"]) for each in conditions])
    found["stable"] = _share([each["stable"] for each in conditions])
    return found


def _pooled(rates: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the F1 of hits, predictions and truths summed over scenes."""
    if not rates:
        return None
    return f1(*(sum(rate[key] for rate in rates) for key in ("hits", "predicted", "truth")))


def _share(flags: Sequence[bool | None]) -> float | None:
    known = [flag for flag in flags if flag is not None]
    return float(np.mean(known)) if known else None
