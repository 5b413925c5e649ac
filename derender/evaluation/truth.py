"""Truth in the files that people have: BOP's scene_gt.json, scenes as JSON, label images.

(Our own YAML is read by `derender.document` and turned into the same dictionaries by `derender.report.scene_json`.)
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from derender.camera.image_files import read_numbers
from derender.errors import DerenderError
from derender.json_text import misfit, parse_json
from derender.scene.pose import from_axes, from_rotation_vector

MILLIMETRE = 1e-3
TURNS = 64  # by which a continuous symmetry is stood for
FOLDERS = ("models", "models_eval", "models_cad")


def bop_scene(
    tree: Mapping[str, Any], path: str | Path, frame: str | None = None, models: str | Path | None = None
) -> dict[str, Any]:
    """Return one frame of BOP's scene_gt.json as a scene: a mesh for each object, without supports (BOP has none).

    Poses are moved from the models' origins to the middles of their boxes, sizes are the boxes' of models_info.json.
    Where the models themselves lie beside it, objects have the `vertices` of their convex hulls; `symmetries` are the
    rotations that models_info.json says leave a model as it is.
    """
    if frame is None:
        if len(tree) > 1:
            some = ", ".join(list(tree)[:5])
            raise DerenderError(f"{len(tree)} frames are in this file", path, f"choose one with --frame: {some} ...")
        frame = next(iter(tree))
    if frame not in tree:
        raise DerenderError(f"no frame {frame!r}", path, "choose from " + ", ".join(list(tree)[:8]))
    information, folder = read_models_info(path, models)
    objects, count = [], {}
    for entry in tree[frame]:
        number = str(entry["obj_id"])
        if number not in information:
            raise DerenderError(f"no model {number} in models_info.json", path, "give the right one with --models")
        model = information[number]
        low = np.array([model[f"min_{axis}"] for axis in "xyz"], float) * MILLIMETRE
        size = np.array([model[f"size_{axis}"] for axis in "xyz"], float) * MILLIMETRE
        middle = low + 0.5 * size
        axes = np.reshape(entry["cam_R_m2c"], (3, 3))
        pose = from_axes(axes.T, np.array(entry["cam_t_m2c"]) * MILLIMETRE + axes @ middle)
        count[number] = count.get(number, 0) + 1
        name = f"object_{number}" + (f"_{count[number]}" if count[number] > 1 else "")
        item = {"name": name, "type": "mesh", "size": size.tolist(), "pose": pose.tolist()}
        item["symmetries"] = symmetries(model).tolist()
        hull = model_hull(folder / f"obj_{int(number):06d}.ply")
        if hull is not None:
            item["vertices"] = hull - middle
        objects.append(item)
    return {"frame": "camera", "gravity": [0.0, 0.0, 0.0], "objects": objects}


def model_hull(path: Path) -> np.ndarray | None:
    """Return the (V, 3) corners of a model's convex hull in metres, model axes; None where there is no such file."""
    if not path.is_file():
        return None
    import trimesh

    try:
        mesh: Any = trimesh.load(path, process=False)
        return np.asarray(mesh.convex_hull.vertices, float) * MILLIMETRE
    except Exception as fault:  # whatever a reader of other people's formats raises
        raise DerenderError("this is no mesh", path, "leave it out, or export it anew") from fault


def symmetries(model: Mapping[str, Any]) -> np.ndarray:
    """Return the rotations (K, 3, 3) that leave a model as it is, the identity first: of models_info.json."""
    found = [np.eye(3)]
    for numbers in model.get("symmetries_discrete", ()):
        matrix = numbers_of(numbers, (16,))
        if matrix is not None:
            found.append(matrix.reshape(4, 4)[:3, :3])
    for entry in model.get("symmetries_continuous", ()):
        axis = numbers_of(entry.get("axis") if isinstance(entry, Mapping) else None, (3,))
        if axis is None or np.linalg.norm(axis) < 1e-9:
            continue
        steps = 2.0 * np.pi * np.arange(TURNS)[:, None] / TURNS * axis / np.linalg.norm(axis)
        found = [from_rotation_vector(step)[:3, :3] @ other for other in found for step in steps]
    return np.array(found)


def read_models_info(path: str | Path, models: str | Path | None = None) -> tuple[dict[str, Any], Path]:
    """Return BOP's models_info.json and its folder: as given, or found in one of FOLDERS beside the scene or above."""
    if models is not None:
        given = Path(models)
        candidates = [given / "models_info.json" if given.is_dir() else given]
    else:
        folders = list(Path(path).resolve().parents)[:4]
        names = ("models_info.json", *(f"{folder}/models_info.json" for folder in FOLDERS))
        candidates = [folder / name for folder in folders for name in names]
    for candidate in candidates:
        if candidate.is_file():
            found = parse_json(candidate.read_bytes(), candidate)
            if wrong := misfit(found, {str: MODEL}, "models_info"):
                raise DerenderError(f"{wrong} is not as BOP has it", candidate, "export it anew")
            return found, candidate.parent
    raise DerenderError("sizes of the models are needed: no models_info.json", path, "give it with --models")


def numbers_of(value: object, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return finite numbers of that shape, or None."""
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return None
    return array if array.shape == shape and np.all(np.isfinite(array)) else None


def read_json_scene(path: str | Path, frame: str | None = None, models: str | Path | None = None) -> dict[str, Any]:
    """Read a scene from JSON: as `derender show --json` prints it, or one frame of BOP's scene_gt.json.

    frame : of a BOP file, its key; needed where there are several.
    models : BOP's models_info.json or its folder; looked for beside the file and above it where not given.

    Raises DerenderError : not JSON, or neither of the two; `frame` or `models` for what is not BOP's.
    """
    tree = parse_json(Path(path).read_bytes(), path)
    if isinstance(tree, Mapping) and isinstance(tree.get("objects"), list):
        if frame is not None or models is not None:
            raise DerenderError("this is not BOP's scene_gt.json", path, "leave out --frame and --models")
        return checked_scene(tree, path)
    if tree and not misfit(tree, BOP):
        return bop_scene(tree, path, frame, models)
    raise DerenderError("neither a scene of `derender show --json` nor a scene_gt.json of BOP", path)


# What scene_gt.json holds for its frames, and models_info.json for a model.
BOP = {str: [{"cam_R_m2c": (float,) * 9, "cam_t_m2c": (float,) * 3, "obj_id": object}]}
MODEL = {f"{part}_{axis}": float for part in ("min", "size") for axis in "xyz"} | {
    "symmetries_discrete?": list, "symmetries_continuous?": list}  # fmt: skip
SIZE = {(float, float, float), None}
# What a comparison needs of a scene, as `misfit` takes it.
SCENE = {"gravity?": object, "objects": [{
    "name": str, "type": str, "size": SIZE, "pose": ((float, float, float, float),) * 4, "parent?": {str, None},
    "supports?": [str], "vertices?": [(float, float, float)],
}]}  # fmt: skip


def checked_scene(tree: Mapping[str, Any], where: object = None) -> dict[str, Any]:
    """Return a scene after checking what the comparison needs: names, types, sizes, rigid poses, gravity.

    Raises DerenderError : says which object lacks what.
    """
    if any("poses" in item for item in tree["objects"] if isinstance(item, Mapping)):
        raise DerenderError(
            "this is a film, a pose for each frame", where, "give scenes, as `derender show --json` does"
        )
    if wrong := misfit(tree, SCENE, "scene"):
        raise DerenderError(f"{wrong} is not as `derender show --json` has it", where)
    names = [item["name"] for item in tree["objects"]]
    for item in tree["objects"]:
        name, size, turn = item["name"], item["size"], np.array(item["pose"], float)[:3, :3]
        if names.count(name) > 1:
            raise DerenderError(f"two objects are called {name!r}", where)
        if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-4):
            remedy = "rows, object to camera, metres"
            raise DerenderError(f"the pose of {name} is not a rigid 4x4 matrix", where, remedy)
        if item["type"] not in ("plane", "frame") and (size is None or min(size) <= 0.0):
            raise DerenderError(f"the size of {name} is not three positive lengths", where, "metres; null for a plane")
    gravity = numbers_of(tree.get("gravity"), (3,))
    return dict(tree) | {"gravity": [0.0, 0.0, 0.0] if gravity is None else gravity.tolist()}


def read_labels(path: str | Path, divisor: int = 1) -> np.ndarray:
    """Return the labels (height, width) int64 of an image: one number for each object.

    divisor : labels are the file's numbers divided by this, rounded down (10 where 21 and 22 are parts of object 2).

    Raises DerenderError : no such picture, or one of several channels.
    """
    labels = read_numbers(path, "the label image", "give a picture of one channel, one number an object")
    if labels.ndim != 2:
        raise DerenderError(f"a label image has one channel, not {labels.shape[2:]}", path)
    if not np.isfinite(labels).all():
        raise DerenderError("a label is no number", path, "0 where there is no object")
    return labels.astype(np.int64) // divisor
