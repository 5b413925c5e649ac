"""One reader for the camera files that people have, which knows them by their keys: BOP, Open3D, ROS and devices' own.

Depth images of devices and apps (ARKit and Record3D, Polycam, Nerfstudio, OAK, ZED, Azure Kinect) are often smaller
than the colour images that the intrinsics belong to, and registered to them: such a reader returns the size of the
colour image under `of`, and the camera is scaled to the image at hand.
"""

import json
import math
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from derender.camera.image_files import read_bytes
from derender.camera.intrinsics import Camera, finite_number, from_matrix, numbers_in
from derender.errors import DerenderError
from derender.json_text import MOST_DEPTH, parse_json

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


SAME_ASPECT = 0.02  # by how much the aspects of an image and of a smaller one registered to it differ at most
LARGEST_FILE = 16_000_000  # bytes; a camera file has a few hundred

MOST_DEGREES, LEAST_DEGREES = 175.0, 0.05  # field of view: no lens shows more without distortion, or less

# Readers. Each takes the file's tree and returns Camera's arguments; width and height may be missing.


def _read_bop(tree: dict) -> dict[str, Any]:
    keys = ("fx", "fy", "cx", "cy", "width", "height", "depth_scale")
    _refuse_distortion(tree)
    return {key: tree[key] for key in keys if key in tree}


def _read_bop_frame(tree: dict) -> dict[str, Any]:
    arguments = from_matrix(tree["cam_K"], "cam_K")
    return arguments | {key: tree[key] for key in ("width", "height", "depth_scale") if key in tree}


def _read_open3d(tree: dict) -> dict[str, Any]:
    matrix = numbers_in(tree["intrinsic_matrix"], "intrinsic_matrix", 9)
    arguments = from_matrix(matrix.reshape(3, 3).T, "intrinsic_matrix (column-major)")
    arguments |= {key: tree[key] for key in ("width", "height") if key in tree}
    if "depth_scale" in tree:  # Open3D counts units to the metre
        per_metre = finite_number(tree["depth_scale"], "depth_scale")
        if per_metre <= 0:
            raise DerenderError(f"depth_scale is {per_metre:g}", remedy="Open3D's is 1000 for millimetres")
        arguments["depth_scale"] = 1000 / per_metre
    return arguments


def _read_ros(tree: dict) -> dict[str, Any]:
    _refuse_distortion(tree)
    matrix = _first(tree, "K", "k", "camera_matrix")
    arguments = from_matrix(matrix, "K")
    for name in ("width", "height"):
        value = _first(tree, name, f"image_{name}")
        if value is not None:
            arguments[name] = value
    for name in ("binning_x", "binning_y"):
        if finite_number(tree.get(name, 0), name) > 1:
            raise DerenderError(f"{name} is {tree[name]}", remedy="give the camera_info of the image without binning")
    region = tree.get("roi")
    if isinstance(region, dict) and any(finite_number(region.get(k, 0), f"roi.{k}") for k in ("x_offset", "y_offset")):
        raise DerenderError("the region of interest has an offset", remedy="give the camera_info of the whole image")
    return arguments


def _read_realsense(tree: dict) -> dict[str, Any]:
    _refuse_distortion(tree)
    arguments = {key: tree[key] for key in ("fx", "fy", "width", "height") if key in tree}
    arguments |= {"cx": tree["ppx"], "cy": tree["ppy"]}
    scale = _first(tree, "depth_scale", "depth_units")  # librealsense: metres for one unit
    return arguments if scale is None else arguments | {"depth_scale": 1000 * finite_number(scale, "depth_scale")}


# The keys that tell the formats apart, the most specific first.
FORMATS: tuple[tuple[str, frozenset[str], Callable[[dict], dict[str, Any]]], ...] = (
    *DEVICES,
    ("RealSense intrinsics", frozenset({"ppx", "ppy", "fx", "fy"}), _read_realsense),
    ("Open3D", frozenset({"intrinsic_matrix"}), _read_open3d),
    ("BOP scene_camera.json", frozenset({"cam_K"}), _read_bop_frame),
    ("ROS camera_info", frozenset({"K"}), _read_ros),
    ("ROS camera_info", frozenset({"k"}), _read_ros),
    ("ROS camera_info", frozenset({"camera_matrix"}), _read_ros),
    ("BOP camera.json", frozenset({"fx", "fy", "cx", "cy"}), _read_bop),
)
WRAPPERS = ("camera", "intrinsic", "intrinsics", "depth_intrinsics", "depth", "camera_info", "calibration_parameters",
            "left_cam")  # fmt: skip


def read_camera(path: str | Path, shape: tuple[int, int] | None = None, frame: str | None = None) -> Camera:
    """Read a camera of any of the known formats, recognised by its keys.

    path : a JSON or YAML file: BOP camera.json or scene_camera.json, Open3D, ROS camera_info, RealSense
        intrinsics, what devices and apps write, or a derender scene; or a 3 x 3 matrix as JSON, CSV,
        text or .npy; `-` is stdin.
    shape : (height, width) of the image it belongs to; fills in a size that the file does not give.
    frame : name of the image, which chooses among the frames of a scene_camera.json ("000003" or "3").

    Raises DerenderError : unreadable or unknown file, distortion, no size, impossible numbers; says which file.
    """
    tree = load_tree(path)
    try:
        if isinstance(tree, list) and len(tree) in (3, 9):
            tree = _matrix_tree(tree, Path(path).name)
        return camera_from_tree(tree, shape, frame)
    except DerenderError as error:
        where = path if error.where in (None, "camera") else f"{path}: {error.where}"
        raise DerenderError(error.what, where, error.remedy) from None


def camera_from_tree(tree: object, shape: tuple[int, int] | None = None, frame: str | None = None) -> Camera:
    """Return the camera that a loaded JSON or YAML tree describes; see `read_camera`."""
    for _ in range(4):  # wrappers are at most a few deep
        if not isinstance(tree, dict) or not tree:
            raise DerenderError("this is not a camera", remedy="it needs at least fx, fy, cx, cy")
        for _name, keys, reader in FORMATS:
            if keys <= tree.keys():
                arguments = reader(tree)
                if tree.get("gravity") is not None:
                    arguments["gravity"] = tree["gravity"]
                arguments = _at_image_size(arguments, shape)
                if shape is not None:
                    arguments = {"height": shape[0], "width": shape[1]} | arguments
                missing = [name for name in ("width", "height") if name not in arguments]
                if missing:
                    raise DerenderError("the file does not say the image's size", remedy="add " + " and ".join(missing))
                camera = Camera(**arguments)
                _refuse_impossible(camera)
                return camera
        tree = _unwrap(tree, frame)
    raise DerenderError("this is not a camera", remedy="it needs at least fx, fy, cx, cy")


def _at_image_size(arguments: dict[str, Any], shape: tuple[int, int] | None) -> dict[str, Any]:
    """Return a camera's arguments for an image that is registered to the one they belong to, which may be larger."""
    arguments = dict(arguments)
    of = arguments.pop("of", None)
    if of is None:
        return arguments
    if shape is None or of == (shape[1], shape[0]):
        return arguments | {"width": of[0], "height": of[1]}
    height, width = shape
    x, y = width / of[0], height / of[1]
    if abs(x / y - 1) > SAME_ASPECT:
        what = f"the camera is that of {of[0]:g} x {of[1]:g} pixels, the image has {width} x {height}"
        raise DerenderError(what, "camera", "give the camera of this image")
    numbers = {key: finite_number(arguments[key], key) for key in ("fx", "fy", "cx", "cy")}
    scaled = {"fx": numbers["fx"] * x, "fy": numbers["fy"] * y, "width": width, "height": height}
    return arguments | scaled | {"cx": (numbers["cx"] + 0.5) * x - 0.5, "cy": (numbers["cy"] + 0.5) * y - 0.5}


def _unwrap(tree: dict, frame: str | None) -> object:
    """Return the part of a tree that holds the camera."""
    for key in WRAPPERS:
        if isinstance(tree.get(key), dict):
            return tree[key]
    parameters = tree.get("parameters")
    if isinstance(parameters, list) and parameters:  # Open3D PinholeCameraTrajectory
        return parameters[0]
    frames = {key: value for key, value in tree.items() if isinstance(value, dict) and "cam_K" in value}
    if frames:  # BOP scene_camera.json
        digits = "".join(filter(str.isascii, filter(str.isdecimal, frame.split("_")[-1]))) if frame else ""
        if digits and str(int(digits)) in frames:
            return frames[str(int(digits))]
        if len({json.dumps(value["cam_K"]) + str(value.get("depth_scale")) for value in frames.values()}) == 1:
            return next(iter(frames.values()))
        names = ", ".join(list(frames)[:5]) + (", ..." if len(frames) > 5 else "")
        raise DerenderError("the frames have different cameras", remedy=f"name the image after one of {names}")
    lacking = [key for key in ("fx", "fy", "cx", "cy") if key not in tree]
    if len(lacking) < 4:
        raise DerenderError("this is not a whole camera", remedy="add " + " and ".join(lacking))
    known = ", ".join(sorted(map(str, tree))[:8])
    remedy = "derender reads BOP, Open3D, ROS camera_info and RealSense cameras"
    raise DerenderError(f"no camera in the keys {known}"[:300], remedy=remedy)


def _refuse_impossible(camera: Camera) -> None:
    """Refuse intrinsics that no depth camera has: mostly those of another image size or unit."""
    for name, focal, extent in (("fx", camera.fx, camera.width), ("fy", camera.fy, camera.height)):
        degrees = math.degrees(2 * math.atan(extent / (2 * focal)))
        if not LEAST_DEGREES <= degrees <= MOST_DEGREES:
            what = f"{name} is {focal:g} pixels for {extent} pixels: a field of view of {degrees:.3g} degrees"
            raise DerenderError(what, "camera", "give the focal length in pixels of this image")
    for name, centre, extent in (("cx", camera.cx, camera.width), ("cy", camera.cy, camera.height)):
        if not -extent <= centre <= 2 * extent:
            what = f"{name} is {centre:g}, farther outside the image than it is large ({extent} pixels)"
            raise DerenderError(what, "camera", "give the camera of this image, in its pixels")


def _matrix_tree(rows: list, name: str) -> dict[str, Any]:
    """Return the tree of a file that is a 3 x 3 matrix and nothing else; StrayScanner's belongs to its video."""
    stray = name == "camera_matrix.csv"
    more = {"w": STRAY_SCANNER[0], "h": STRAY_SCANNER[1]} if stray else {}
    return {"K" if stray else "cam_K": numbers_in(rows, "the matrix", 9).reshape(3, 3).tolist(), **more}


def load_tree(
    path: str | Path, what: str = "the camera", remedy: str = "give a camera file, e.g. a BOP camera.json"
) -> object:
    """Return the tree of a JSON or YAML file or of a .npy; YAML's scalars stay text, which `finite_number` reads.

    what, remedy : what the file should be, and what to do where it cannot be read.
    """
    import yaml

    data = read_bytes(path, LARGEST_FILE, what, remedy)
    try:
        if data.startswith(b"\x93NUMPY"):
            return np.load(BytesIO(data), allow_pickle=False).tolist()
        text = data.decode("utf-8-sig")
        words = text.replace(",", " ").replace(";", " ").split()
        if len(words) == 9 and all(map(_is_number, words)):  # a matrix as numpy.savetxt or a table writes it
            return [words[0:3], words[3:6], words[6:9]]
        if text.lstrip().startswith("{") and _is_json(text):
            return parse_json(text, path)
        loader = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
        _refuse_deep(yaml.parse(text, loader))
        return next(iter(yaml.load_all(text, loader)))  # `rostopic echo` separates messages by ---
    except (ValueError, yaml.YAMLError, RecursionError, StopIteration, TypeError):
        raise DerenderError("neither JSON nor YAML", path, remedy) from None


def _is_json(text: str) -> bool:
    """Return whether it is JSON rather than YAML in flow style; nested too deep counts as JSON."""
    try:
        json.loads(text)
    except RecursionError:
        return True
    except ValueError:
        return False
    return True


def _refuse_deep(events: Iterator[Any]) -> None:
    """Raise ValueError where YAML is nested too deep: building its tree would recurse, in C, without a limit."""
    from yaml import events as yaml_events

    depth = 0
    for event in events:
        depth += isinstance(event, yaml_events.CollectionStartEvent)
        depth -= isinstance(event, yaml_events.CollectionEndEvent)
        if depth > MOST_DEPTH:
            raise ValueError


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _first(tree: dict, *names: str) -> Any:
    return next((tree[name] for name in names if name in tree), None)


def _refuse_distortion(tree: dict) -> None:
    refuse_named_distortion(tree)
    for key in ("coeffs", "D", "d", "distortion_coefficients", "dist_coeffs", "distortion", "cam_D"):
        if not isinstance(tree.get(key), None | str | bool):
            refuse_numbers(tree[key], key)
