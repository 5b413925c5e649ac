"""Truth in the files that people have: BOP's scene_gt.json, scenes as JSON, label images.

(Our own YAML is read by `derender.document` and turned into the same dictionaries by `derender.report.scene_json`.)
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.evaluation.bop import bop_scene, is_bop_frame, numbers_of
from derender.json_text import parse_json

LABEL_SUFFIXES = (".png", ".npy", ".tiff", ".tif")


def read_json_scene(path: str | Path, frame: str | None = None, models: str | Path | None = None) -> dict[str, Any]:
    """Read a scene from JSON: as `derender show --json` prints it, or one frame of BOP's scene_gt.json.

    Parameters
    ----------
    frame : of a BOP file, its key; needed where there are several.
    models : BOP's models_info.json or its folder; looked for beside the file and above it where not given.

    Raises
    ------
    DerenderError : not JSON, or neither of the two; `frame` or `models` for what is not BOP's.
    """
    try:
        tree = parse_json(Path(path).read_text(encoding="utf-8"), path)
    except UnicodeDecodeError as fault:
        raise DerenderError("this is not JSON", path, "give a scene, or BOP's scene_gt.json") from fault
    if isinstance(tree, Mapping) and isinstance(tree.get("objects"), list):
        if frame is not None or models is not None:
            raise DerenderError("this is not BOP's scene_gt.json", path, "leave out --frame and --models")
        return checked_scene(tree, path)
    if isinstance(tree, Mapping) and tree and all(is_bop_frame(value) for value in tree.values()):
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
        pose = numbers_of(item.get("pose"), (4, 4))
        if pose is None or not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-4):
            raise DerenderError(
                f"the pose of {name} is not a rigid 4x4 matrix", where, "rows, object to camera, metres"
            )
        size = item.get("size")
        if size is not None:
            extents = numbers_of(size, (3,))
            if extents is None or not np.all(extents > 0):
                raise DerenderError(
                    f"the size of {name} is not three positive lengths", where, "metres; null for a plane"
                )
        elif item["type"] not in ("plane", "frame"):
            raise DerenderError(f"{name} has no size", where, "three lengths in metres")
    scene = dict(tree)
    gravity = numbers_of(tree.get("gravity", (0.0, 0.0, 0.0)), (3,))
    scene["gravity"] = [0.0, 0.0, 0.0] if gravity is None else gravity.tolist()
    return scene


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
        raise DerenderError("there is no such file", path, "check the path") from None
    except (OSError, ValueError, KeyError, EOFError) as fault:
        raise DerenderError("this is no label image", path, "a picture of one channel, one number an object") from fault
    if labels.ndim != 2:
        raise DerenderError(f"a label image has one channel, not {labels.shape[2:]}", path)
    return labels.astype(np.int64) // divisor
