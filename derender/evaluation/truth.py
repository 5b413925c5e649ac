"""Truth in the files that people have: BOP's scene_gt.json, scenes as JSON, label images.

(Our own YAML is read by `derender.document` and turned into the same dictionaries by `derender.report.scene_json`.)
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from derender.errors import DerenderError

MILLIMETRE = 1e-3
LABEL_SUFFIXES = (".png", ".npy", ".tiff", ".tif")


def read_json_scene(path: str | Path, frame: str | None = None, models: str | Path | None = None) -> dict[str, Any]:
    """Read a scene from JSON: as `derender show --json` prints it, or one frame of BOP's scene_gt.json.

    Parameters
    ----------
    frame : of a BOP file, its key; needed where there are several.
    models : BOP's models_info.json or its folder; looked for beside the file and above it where not given.

    Raises
    ------
    DerenderError : not JSON, or neither of the two.
    """
    try:
        tree = json.loads(Path(path).read_text(encoding="utf-8"))
    except (ValueError, UnicodeDecodeError) as fault:
        raise DerenderError("this is not JSON", path, "give a scene, or BOP's scene_gt.json") from fault
    if isinstance(tree, Mapping) and isinstance(tree.get("objects"), list):
        return checked_scene(tree, path)
    if isinstance(tree, Mapping) and tree and all(_is_bop_frame(value) for value in tree.values()):
        return bop_scene(tree, path, frame, models)
    raise DerenderError("neither a scene of `derender show --json` nor a scene_gt.json of BOP", path)


def checked_scene(tree: Mapping[str, Any], where: object = None) -> dict[str, Any]:
    """Return a scene after checking what the comparison needs: names, types, sizes, rigid poses, gravity.

    Raises
    ------
    DerenderError : says which object lacks what.
    """
    seen: set[str] = set()
    for number, item in enumerate(tree["objects"]):
        if not isinstance(item, Mapping) or not isinstance(item.get("name"), str):
            raise DerenderError(f"object {number} has no name", where)
        name = item["name"]
        if name in seen:
            raise DerenderError(f"two objects are called {name!r}", where)
        seen.add(name)
        if not isinstance(item.get("type"), str):
            raise DerenderError(f"{name} has no type", where)
        pose = _array(item.get("pose"), (4, 4))
        if pose is None or not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-4):
            raise DerenderError(
                f"the pose of {name} is not a rigid 4x4 matrix", where, "rows, object to camera, metres"
            )
        size = item.get("size")
        if size is not None:
            extents = _array(size, (3,))
            if extents is None or not np.all(extents > 0):
                raise DerenderError(
                    f"the size of {name} is not three positive lengths", where, "metres; null for a plane"
                )
        elif item["type"] not in ("plane", "frame"):
            raise DerenderError(f"{name} has no size", where, "three lengths in metres")
    scene = dict(tree)
    gravity = _array(tree.get("gravity", (0.0, 0.0, 0.0)), (3,))
    scene["gravity"] = [0.0, 0.0, 0.0] if gravity is None else gravity.tolist()
    return scene


def bop_scene(
    tree: Mapping[str, Any], path: str | Path, frame: str | None = None, models: str | Path | None = None
) -> dict[str, Any]:
    """Return one frame of BOP's scene_gt.json as a scene: a mesh for each object, without supports (BOP has none).

    Poses are moved from the models' origins to the middles of their boxes, sizes are the boxes' of models_info.json.
    """
    if frame is None:
        if len(tree) > 1:
            some = ", ".join(list(tree)[:5])
            raise DerenderError(f"{len(tree)} frames are in this file", path, f"choose one with --frame: {some} ...")
        frame = next(iter(tree))
    if frame not in tree:
        raise DerenderError(f"no frame {frame!r}", path, "choose from " + ", ".join(list(tree)[:8]))
    information = read_models_info(path, models)
    objects, count = [], {}
    for entry in tree[frame]:
        number = str(entry["obj_id"])
        rotation = _array(entry["cam_R_m2c"], (9,))
        position = _array(entry["cam_t_m2c"], (3,))
        if rotation is None or position is None:
            raise DerenderError(f"object {number} has no pose", path)
        if number not in information:
            raise DerenderError(f"no model {number} in models_info.json", path, "give the right one with --models")
        model = information[number]
        low = np.array([model[f"min_{axis}"] for axis in "xyz"], float) * MILLIMETRE
        size = np.array([model[f"size_{axis}"] for axis in "xyz"], float) * MILLIMETRE
        pose = np.eye(4)
        pose[:3, :3] = rotation.reshape(3, 3)
        pose[:3, 3] = position * MILLIMETRE + pose[:3, :3] @ (low + 0.5 * size)
        count[number] = count.get(number, 0) + 1
        name = f"object_{number}" + (f"_{count[number]}" if count[number] > 1 else "")
        objects.append({"name": name, "type": "mesh", "size": size.tolist(), "pose": pose.tolist()})
    return {"frame": "camera", "gravity": [0.0, 0.0, 0.0], "objects": objects}


def read_models_info(path: str | Path, models: str | Path | None = None) -> dict[str, Any]:
    """Read BOP's models_info.json: as given, or in models/ or models_eval/ beside the scene or some folders above."""
    if models is not None:
        given = Path(models)
        candidates = [given / "models_info.json" if given.is_dir() else given]
    else:
        folders = list(Path(path).resolve().parents)[:4]
        candidates = [folder / name for folder in folders for name in ("models_info.json", *_model_files())]
    for candidate in candidates:
        if candidate.is_file():
            try:
                return json.loads(candidate.read_text(encoding="utf-8"))
            except ValueError as fault:
                raise DerenderError("this is not JSON", candidate) from fault
    raise DerenderError("sizes of the models are needed: no models_info.json", path, "give it with --models")


def read_labels(path: str | Path, divisor: int = 1) -> np.ndarray:
    """Read a label image: one number for each object.

    Parameters
    ----------
    divisor : labels are the file's numbers divided by this, rounded down (10 where 21 and 22 are parts of object 2).

    Returns
    -------
    (height, width) int64.

    Raises
    ------
    DerenderError : no such picture, or one of several channels.
    """
    path = Path(path)
    try:
        if path.suffix == ".npy":
            labels = np.load(path, allow_pickle=False)
        elif path.suffix == ".npz":
            labels = np.load(path, allow_pickle=False)["label"]
        else:
            import imageio.v3 as imageio

            labels = imageio.imread(path, plugin="pillow")
    except FileNotFoundError:
        raise DerenderError("there is no such file", path) from None
    except (OSError, ValueError, KeyError, EOFError) as fault:
        raise DerenderError("this is no label image", path, "a picture of one channel, one number an object") from fault
    if labels.ndim != 2:
        raise DerenderError(f"a label image has one channel, not {labels.shape[2:]}", path)
    return labels.astype(np.int64) // divisor


def _model_files() -> tuple[str, ...]:
    return tuple(f"{folder}/models_info.json" for folder in ("models", "models_eval", "models_cad"))


def _is_bop_frame(value: object) -> bool:
    return isinstance(value, list) and all(
        isinstance(entry, Mapping) and {"cam_R_m2c", "cam_t_m2c", "obj_id"} <= set(entry) for entry in value
    )


def _array(value: object, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return finite numbers of that shape, or None."""
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return None
    return array if array.shape == shape and np.all(np.isfinite(array)) else None
