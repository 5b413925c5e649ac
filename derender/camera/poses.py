"""Where cameras stood: of each image of one scene a (4, 4) matrix, camera to world, in OpenCV's axes.

A list in the order of the images, or a mapping by their names. What others write is known by its keys: Nerfstudio's
transforms.json, whose cameras have y up and z backwards, and BOP's scene_camera.json, world to camera, in millimetres.
"""

import json
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from derender.atomic import write_text
from derender.camera.camera_text import LARGEST_FILE, load_tree
from derender.camera.image_files import read_bytes
from derender.camera.intrinsics import finite_number
from derender.errors import DerenderError, at_fault
from derender.scene.pose import from_axes, inverse, rotation_z

FARTHEST = 1e6  # metres from the first camera: numbers with more digits than that tell no millimetres
UNTURNED = 1e-2  # by which a rotation's columns may be off length 1 and off right angles: poses printed to two digits
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenCV's camera axes to OpenGL's
WHAT, REMEDY = "the poses", "give a 4 x 4 matrix, camera to world, for each image"


def read_poses(path: str | Path, images: Sequence[str]) -> np.ndarray:
    """Return (V, 4, 4) float64, the poses, camera to world, of images by their names.

    path : JSON, YAML, .npy or .npz: a list of matrices or an array (V, 4, 4); or matrices by the images' names, with or
        without suffix; either also under `poses`. Or a transforms.json, or a scene_camera.json with poses.

    Raises DerenderError : unreadable, an image without a pose, or a matrix that is no pose; says which file.
    """
    found = poses_in(_tree(path))
    if found is None:
        raise DerenderError("there are no poses in it", path, REMEDY)
    with at_fault(path, always=True):
        return _of_images(found, images)


def poses_of_camera_file(path: str | None, images: Sequence[str]) -> np.ndarray | None:
    """Return the poses (V, 4, 4) of images that their camera file holds; None where it holds none."""
    if path is None or str(path).lower().endswith((".npz", ".npy")) or poses_in(load_tree(path)) is None:
        return None
    return read_poses(path, images)


def poses_in(tree: object) -> list[Any] | dict[str, Any] | None:
    """Return the matrices of a loaded file, in order or by names of images; None where it holds none."""
    if isinstance(tree, Mapping):
        if "poses" in tree:
            return poses_in(tree["poses"])
        frames = tree.get("frames")
        if isinstance(frames, list) and all(isinstance(frame, Mapping) for frame in frames):
            return _nerfstudio(frames)
        if any(isinstance(value, Mapping) and "cam_R_w2c" in value for value in tree.values()):
            return {key: _bop(value) for key, value in tree.items() if isinstance(value, Mapping)}
        named = {str(key): value for key, value in tree.items() if not isinstance(value, Mapping | str)}
        return named if named and all(_shape(value) == (4, 4) for value in named.values()) else None
    if isinstance(tree, list | np.ndarray) and len(tree) and all(_shape(pose) == (4, 4) for pose in tree):
        return list(tree)
    return [tree] if _shape(tree) == (4, 4) else None


def turned_pose(pose: np.ndarray, degrees: int) -> np.ndarray:
    """Return the pose (4, 4), camera to world, of the camera that would have seen the image turned clockwise."""
    return pose @ rotation_z(-np.radians(degrees))


def write_poses(path: str | Path, poses: Sequence[np.ndarray]) -> None:
    """Write poses (4, 4), camera to world, in the order of the images: a file that `read_poses` reads."""
    tree = [np.asarray(pose, float).tolist() for pose in poses]
    write_text(Path(path), json.dumps({"poses": tree}, indent=1) + "\n")


def _shape(value: object) -> tuple[int, ...]:
    """Return the shape of nested lists or of an array, () where it has none."""
    try:
        return np.shape(value)  # type: ignore[arg-type]
    except ValueError:  # rows of different lengths
        return ()


def _tree(path: str | Path) -> object:
    if str(path).lower().endswith(".npz"):
        data = read_bytes(path, LARGEST_FILE, WHAT, REMEDY)
        try:
            with np.load(BytesIO(data), allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
        except (OSError, ValueError, EOFError, KeyError) as error:
            raise DerenderError("not an .npz of arrays", path, REMEDY) from error
    return load_tree(path, WHAT, REMEDY)


def _nerfstudio(frames: list[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the poses of a transforms.json by the files that it names, depth before colour."""
    found = {}
    for frame in frames:
        name = frame.get("depth_file_path") or frame.get("file_path")
        if name is not None and "transform_matrix" in frame:
            found[str(name)] = _matrix(frame["transform_matrix"], str(name)) @ OPENGL
    return found


def _bop(frame: Mapping[str, Any]) -> np.ndarray:
    """Return the pose of an entry of a scene_camera.json: it holds world to camera, millimetres."""
    if "cam_R_w2c" not in frame or "cam_t_w2c" not in frame:
        raise DerenderError("an entry has no cam_R_w2c and cam_t_w2c", remedy=REMEDY)
    axes = np.reshape([finite_number(x, "cam_R_w2c") for x in frame["cam_R_w2c"]], (3, 3)).T
    return inverse(from_axes(axes, [finite_number(x, "cam_t_w2c") / 1000.0 for x in frame["cam_t_w2c"]]))


def _of_images(found: list[Any] | dict[str, Any], images: Sequence[str]) -> np.ndarray:
    if isinstance(found, list):
        if len(found) != len(images):
            poses = "is 1 pose" if len(found) == 1 else f"are {len(found)} poses"
            what = f"there {poses} for {len(images)} images"
            raise DerenderError(what, remedy="give one for each image, in the order of the images, or name them")
        return np.array([_matrix(pose, f"pose {k + 1}") for k, pose in enumerate(found)])
    keys = {Path(name).stem: name for name in found}
    keys.update({str(int(stem)): name for stem, name in keys.items() if stem.isdecimal()})
    chosen = []
    for image in images:
        stem = Path(image).stem
        number = stem.split("_")[-1]
        key = keys.get(stem) or keys.get(str(int(number)) if number.isdecimal() else stem)
        if key is None:
            names = ", ".join(list(keys)[:4]) + (", ..." if len(keys) > 4 else "")
            raise DerenderError(f"there is no pose for {image}", remedy=f"it has poses for {names}")
        chosen.append(_matrix(found[key], key))
    return np.array(chosen)


def _matrix(value: Any, name: str) -> np.ndarray:
    """Return a pose (4, 4) whose rotation is exact, or say why the matrix is none."""
    if _shape(value) != (4, 4):
        raise DerenderError(f"{name} is no 4 x 4 matrix", remedy=REMEDY)
    pose = np.array([[finite_number(x, name) for x in row] for row in value])
    if not np.allclose(pose[3], [0.0, 0.0, 0.0, 1.0]):
        columns = np.allclose(pose[:3, 3], 0.0)
        remedy = "give it by rows: this one is by columns" if columns else "its last row is 0, 0, 0, 1"
        raise DerenderError(f"{name} is no pose", remedy=remedy)
    turn = pose[:3, :3]
    if np.abs(pose).max() > FARTHEST:
        raise DerenderError(f"{name} lies {np.abs(pose).max():.3g} m away", remedy="poses are in metres")
    if np.abs(turn.T @ turn - np.eye(3)).max() > UNTURNED or np.linalg.det(turn) < 0:
        raise DerenderError(f"{name} is no rotation and translation", remedy="its first 3 x 3 numbers are a rotation")
    left, _, right = np.linalg.svd(turn)
    pose[:3, :3] = left @ right
    return pose
