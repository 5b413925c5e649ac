"""Camera files of devices and apps, by their keys: ARKit and Record3D, Polycam, Nerfstudio, OAK, ZED, Azure Kinect.

Their depth images are often smaller than the colour images that the intrinsics belong to, and registered to them: such
a reader returns the size of the colour image under `of`, and the camera is scaled to the image at hand.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from derender.camera.intrinsics import finite_number, from_matrix, numbers_in
from derender.errors import DerenderError

Reader = Callable[[dict], dict[str, Any]]
RIGHT_SOCKET = 2  # of an OAK: its depth is that of the rectified right camera
STRAY_SCANNER = (1920, 1440)  # pixels of the video that its camera_matrix.csv belongs to
MATRIX_KEYS = ("intrinsics", "cameraIntrinsics", "intrinsicMatrix", "intrinsic_matrix", "camera_matrix", "K")
POSE_KEYS = ("cameraPoseARFrame", "cameraTransform", "transform")
DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


def read_nerfstudio(tree: dict) -> dict[str, Any]:
    """Read a transforms.json. There the middle of the first pixel is at (0.5, 0.5)."""
    refuse_named_distortion(tree)
    arguments = {"fx": tree["fl_x"], "fy": tree.get("fl_y", tree["fl_x"])}
    arguments |= {to: finite_number(tree[key], key) - 0.5 for to, key in (("cx", "cx"), ("cy", "cy"))}
    return arguments | _size(tree)


def read_record3d(tree: dict) -> dict[str, Any]:
    """Read the metadata of a Record3D recording: K column by column, of the colour image; dw, dh of the depth image."""
    return _of_matrix(tree["K"], "K") | _size(tree)


def read_arkit(tree: dict) -> dict[str, Any]:
    """Read what apps write of an ARKit frame: a matrix by rows or by columns, the size, and the pose, for gravity."""
    key = next(key for key in MATRIX_KEYS if key in tree)
    arguments = _of_matrix(tree[key], key)
    gravity = gravity_of_arkit(tree)
    return arguments | _size(tree) | ({} if gravity is None else {"gravity": gravity})


def read_polycam(tree: dict) -> dict[str, Any]:
    """Read a Polycam keyframe: t_00 to t_23 are the camera's pose in a world whose y points up."""
    arguments = {key: tree[key] for key in ("fx", "fy", "cx", "cy")} | _size(tree)
    rows = [[finite_number(tree[f"t_{i}{j}"], f"t_{i}{j}") for j in range(3)] for i in range(3)]
    return arguments | {"gravity": _down_in_camera(np.array(rows))}


def read_oak(tree: dict) -> dict[str, Any]:
    """Read an OAK's calibration: the right camera, whose rectified image its depth belongs to, distortion taken out."""
    cameras = {int(finite_number(entry[0], "cameraData")): entry[1] for entry in tree["cameraData"]}
    data = cameras.get(RIGHT_SOCKET) or next(iter(cameras.values()))
    return _of_matrix(data["intrinsicMatrix"], "intrinsicMatrix") | _size(data)


def read_zed(tree: dict) -> dict[str, Any]:
    """Read the CameraParameters of a ZED's rectified left camera."""
    refuse_numbers(tree["disto"], "disto")
    return {key: tree[key] for key in ("fx", "fy", "cx", "cy")} | _size(tree.get("image_size", tree))


def refuse_azure(tree: dict) -> dict[str, Any]:
    """Say what to give in place of an Azure Kinect's factory calibration."""
    what = "this is the raw calibration of an Azure Kinect, whose depth image has lens distortion"
    remedy = (
        "give the intrinsics that Open3D's azure_kinect_mkv_reader writes, or the 3 x 3 matrix of the undistorted image"
    )
    raise DerenderError(what, "camera", remedy)


# The keys that tell the formats apart.
DEVICES: tuple[tuple[str, frozenset[str], Reader], ...] = (
    ("Azure Kinect calibration", frozenset({"CalibrationInformation"}), refuse_azure),
    ("OAK calibration", frozenset({"cameraData"}), read_oak),
    ("Nerfstudio transforms.json", frozenset({"fl_x", "cx", "cy"}), read_nerfstudio),
    ("Record3D", frozenset({"K", "w", "h"}), read_record3d),
    ("Polycam", frozenset({"fx", "fy", "cx", "cy", "t_00", "t_22"}), read_polycam),
    ("ZED", frozenset({"fx", "fy", "cx", "cy", "disto"}), read_zed),
    *((f"ARKit ({key})", frozenset({key, other}), read_arkit)
      for key in ("intrinsics", "cameraIntrinsics", "intrinsicMatrix")
      for other in ("imageResolution", "resolution", "width", "w", *POSE_KEYS)),
)  # fmt: skip


def gravity_of_arkit(tree: dict) -> tuple[float, float, float] | None:
    """Return the direction of fall in camera axes from a frame's pose: ARKit's world has y upwards."""
    for key in POSE_KEYS:
        if key in tree:
            pose = numbers_in(tree[key], key, 16).reshape(4, 4)
            if np.any(abs(pose[3, :3]) > 1e-6):  # by columns
                pose = pose.T
            return _down_in_camera(pose[:3, :3])
    return None


def _down_in_camera(rotation: np.ndarray) -> tuple[float, float, float]:
    """Return the world's -y in OpenCV's camera axes; rotation : (3, 3), a camera with y up and z backwards to world."""
    x, y, z = -rotation[1]
    return float(x), float(-y), float(-z)


def refuse_named_distortion(tree: dict) -> None:
    """Raise a DerenderError where a distortion coefficient with a name of its own is not zero."""
    for key in DISTORTION_KEYS:
        if key in tree:
            refuse_numbers(tree[key], key)


def refuse_numbers(value: object, key: str) -> None:
    """Raise a DerenderError where distortion coefficients are not all zero."""
    numbers = value if isinstance(value, dict | list | tuple | np.ndarray) else [value]
    if np.any(numbers_in(numbers, key) != 0):
        remedy = "rectify first, then give the rectified image's camera with zeros there"
        raise DerenderError(f"the camera has distortion ({key} is not zero)", "camera", remedy)


def _size(tree: dict) -> dict[str, Any]:
    """Return under `of` the size (width, height) that the intrinsics belong to, where the file says it."""
    for key in ("imageResolution", "resolution", "image_size"):
        value = tree.get(key)
        if isinstance(value, dict):
            tree = value
        elif isinstance(value, list) and len(value) == 2:
            return {"of": (finite_number(value[0], key), finite_number(value[1], key))}
    for width, height in (("w", "h"), ("width", "height")):
        if width in tree and height in tree:
            return {"of": (finite_number(tree[width], width), finite_number(tree[height], height))}
    return {}


def _of_matrix(value: object, name: str) -> dict[str, Any]:
    """Return fx, fy, cx, cy of a matrix by rows or by columns."""
    matrix = numbers_in(value, name, 9).reshape(3, 3)
    return from_matrix(matrix.T if matrix[0, 2] == matrix[1, 2] == 0 else matrix, name)
