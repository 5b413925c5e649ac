"""One reader for the camera files that people have, which a table tells apart by their keys: BOP's, ROS's, devices'.

Depth images of devices and apps (ARKit and Record3D, Polycam, Nerfstudio, OAK, ZED) are often smaller than the colour
images that the intrinsics belong to, and registered to them: then the camera is scaled to the image at hand.
"""

import codecs
import contextlib
import json
import math
from collections.abc import Callable
from io import BytesIO
from itertools import accumulate
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from derender.camera.image_files import DAMAGE, MOST_BYTES, decode_npz, read_bytes
from derender.camera.intrinsics import Camera, finite_number, from_matrix, numbers_in
from derender.errors import DerenderError, at_fault
from derender.json_text import MOST_DEPTH, parse_json

STRAY_SCANNER = (1920, 1440)  # pixels of the video that its camera_matrix.csv belongs to
RIGHT_SOCKET = 2  # of an OAK: its depth is that of the rectified right camera
SAME_ASPECT = 0.02  # by how much the aspects of an image and of a smaller one registered to it differ at most
LARGEST_FILE = 16_000_000  # bytes; a camera file has a few hundred
MOST_DEGREES, LEAST_DEGREES = 175.0, 0.05  # field of view: no lens shows more without distortion, or less


class Format(NamedTuple):
    """How a tool writes a camera.

    numbers : keys of fx, fy, cx and cy, or that of their matrix; also : keys that a file of it has besides.
    order : of the matrix: "C" by rows, "F" by columns, "A" either, as its zeros tell.
    unit : what makes millimetres of the depth's unit; None where the file does not tell one.
    colour : whether the numbers belong to a larger image, of colours, to which the depth image is registered.
    corner : image coordinates of the first pixel's middle.
    """

    numbers: tuple[str, ...] = ("fx", "fy", "cx", "cy")
    also: tuple[str, ...] = ()
    order: Literal["C", "F", "A"] = "C"
    unit: Callable[[float], float] | None = None
    colour: bool = False
    corner: float = 0.0

    def fits(self, tree: dict) -> bool:
        """Return whether a tree is of this format."""
        if not tree.keys() >= {*self.numbers, *self.also} - {"fl_y"}:
            return False
        matrix = tree[self.numbers[0]]  # which may also be a wrapper's name
        return len(self.numbers) > 1 or not isinstance(matrix, dict) or "data" in matrix


# The most specific first.
FORMATS = (
    Format(("fl_x", "fl_y", "cx", "cy"), colour=True, corner=0.5),  # Nerfstudio's transforms.json; fl_y may be missing
    Format(("K",), ("w", "h"), order="A", colour=True),  # Record3D
    *(Format((key,), order="A", colour=True) for key in ("intrinsics", "cameraIntrinsics", "intrinsicMatrix")),  # ARKit
    Format(also=("t_00", "t_22"), colour=True),  # Polycam
    Format(also=("disto",), colour=True),  # ZED
    Format(("fx", "fy", "ppx", "ppy"), unit=lambda metres: 1000 * metres),  # RealSense
    Format(("intrinsic_matrix",), order="F", unit=lambda per_metre: 1000 / per_metre),  # Open3D
    Format(("cam_K",), unit=float),  # BOP's scene_camera.json
    *(Format((key,)) for key in ("K", "k", "camera_matrix")),  # ROS camera_info
    Format(unit=float),  # BOP's camera.json
)
UNIT_KEYS = ("depth_scale", "depth_units")
POSE_KEYS = ("cameraPoseARFrame", "cameraTransform", "transform")
DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "coeffs", "D", "d", "distortion_coefficients",
                   "dist_coeffs", "distortion", "cam_D", "disto")  # fmt: skip
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
        if isinstance(tree, list) and len(tree) in (3, 4, 9, 12, 16):
            matrix = _intrinsic_part(numbers_in(tree, "the matrix")).tolist()
            of_video = Path(path).name == "camera_matrix.csv"  # StrayScanner's belongs to its video
            tree = {"K": matrix, "w": STRAY_SCANNER[0], "h": STRAY_SCANNER[1]} if of_video else {"cam_K": matrix}
        return camera_from_tree(tree, shape, frame)
    except DerenderError as error:
        where = path if error.where in (None, "camera") else f"{path}: {error.where}"
        raise DerenderError(error.what, where, error.remedy) from None


def _intrinsic_part(numbers: np.ndarray) -> np.ndarray:
    """Return (3, 3) of the numbers of such a matrix, or of one (3, 4) or (4, 4) that adds nothing to it: ScanNet's."""
    wide = {9: 3, 12: 4, 16: 4}.get(len(numbers))
    whole = numbers.reshape(-1, wide) if wide else np.ones((4, 4))
    if not np.array_equal(whole[:, 3:], np.eye(4)[: len(whole), 3:wide]) or whole[3:, :3].any():
        raise DerenderError(
            "the matrix is no 3 x 3 matrix of intrinsics", "camera", "its rows are fx 0 cx, 0 fy cy, 0 0 1"
        )
    return whole[:3, :3]


def camera_beside(path: str | Path) -> Path | None:
    """Return NAME_camera.json or camera.json beside an image NAME.png, or the latter in a folder; None without any."""
    place = Path(path)
    beside = [place / "camera.json"] if place.is_dir() else [
        place.with_name(name) for name in (f"{place.stem}_camera.json", "camera.json")
    ]  # fmt: skip
    return None if str(path) == "-" else next((file for file in beside if file.is_file()), None)


def camera_from_tree(tree: object, shape: tuple[int, int] | None = None, frame: str | None = None) -> Camera:
    """Return the camera that a loaded JSON or YAML tree describes; see `read_camera`."""
    for _ in range(4):  # wrappers are at most a few deep
        if not isinstance(tree, dict) or not tree:
            break
        form = next((form for form in FORMATS if form.fits(tree)), None)
        if form is not None:
            arguments = _arguments(tree, form, shape)
            missing = [name for name in ("width", "height") if name not in arguments]
            if missing:
                raise DerenderError("the file does not say the image's size", remedy="add " + " and ".join(missing))
            camera = Camera(**arguments)
            _refuse_impossible(camera, room=0 if len(_size(tree)) < 2 else 1)
            return camera
        tree = _unwrap(tree, frame)
    raise DerenderError("this is not a camera", remedy="it needs at least fx, fy, cx, cy")


def _arguments(tree: dict, form: Format, shape: tuple[int, int] | None) -> dict[str, Any]:
    """Return Camera's arguments from a tree of this format; width or height may be missing where no `shape` is."""
    _refuse_what_is_no_pinhole(tree)
    if len(form.numbers) == 1:
        (key,) = form.numbers
        matrix = numbers_in(tree[key], key, 9).reshape(3, 3)
        by_columns = form.order == "F" or (form.order == "A" and matrix[0, 2] == matrix[1, 2] == 0)
        arguments: dict[str, Any] = from_matrix(matrix.T if by_columns else matrix, key)
    else:
        found = (finite_number(tree.get(key, tree[form.numbers[0]]), key) for key in form.numbers)
        arguments = dict(zip(("fx", "fy", "cx", "cy"), found, strict=True))
    arguments |= {key: arguments[key] - form.corner for key in ("cx", "cy")}
    key = next((key for key in UNIT_KEYS if key in tree), "")
    if key and form.unit is not None:
        unit = finite_number(tree[key], key)
        if unit <= 0:
            raise DerenderError(f"{key} is {unit:g}", "camera", "give a positive number")
        arguments["depth_scale"] = form.unit(unit)
    gravity = tree["gravity"] if tree.get("gravity") is not None else _gravity_of_pose(tree) if form.colour else None
    if gravity is not None:
        arguments["gravity"] = gravity
    size = _size(tree)
    if form.colour and shape is not None and len(size) == 2 and (size["height"], size["width"]) != shape:
        return _at_image_size(arguments, (size["width"], size["height"]), shape)
    return arguments | ({} if shape is None else {"height": shape[0], "width": shape[1]}) | size


def _size(tree: dict) -> dict[str, float]:
    """Return the width and height that a tree tells, if it does, in pixels."""
    for key in ("imageResolution", "resolution", "image_size"):
        value = tree.get(key)
        if isinstance(value, dict):
            tree = value
        elif isinstance(value, list) and len(value) == 2:
            tree = dict(zip(("width", "height"), value, strict=True))
    found = {}
    for name in ("width", "height"):
        for key in (name, name[0], f"image_{name}"):
            if key in tree:
                found.setdefault(name, finite_number(tree[key], name))
    return found


def _gravity_of_pose(tree: dict) -> tuple[float, float, float] | None:
    """Return the direction of fall in camera axes from a frame's pose in a world whose y points up; None without one.

    ARKit's pose is a matrix by rows or by columns, Polycam's t_00 to t_23; the camera has y up and z backwards.
    """
    if "t_00" in tree:
        up = [finite_number(tree.get(f"t_1{j}"), f"t_1{j}") for j in range(3)]
        return -up[0], up[1], up[2]
    for key in POSE_KEYS:
        if key in tree:
            pose = numbers_in(tree[key], key, 16).reshape(4, 4)
            x, y, z = pose[:3, 1] if np.any(abs(pose[3, :3]) > 1e-6) else pose[1, :3]  # by columns, or by rows
            return float(-x), float(y), float(z)
    return None


def _refuse_what_is_no_pinhole(tree: dict) -> None:
    """Raise a DerenderError where a camera has distortion, or its image is binned or cut out of another."""
    for key in DISTORTION_KEYS:
        value = tree.get(key)
        if not isinstance(value, None | str | bool):
            if np.any(numbers_in(value if isinstance(value, dict | list | tuple | np.ndarray) else [value], key) != 0):
                remedy = "rectify first, then give the rectified image's camera with zeros there"
                raise DerenderError(f"the camera has distortion ({key} is not zero)", "camera", remedy)
    for name in ("binning_x", "binning_y"):
        if finite_number(tree.get(name, 0), name) > 1:
            raise DerenderError(f"{name} is {tree[name]}", remedy="give the camera_info of the image without binning")
    region = tree.get("roi")
    if isinstance(region, dict) and any(finite_number(region.get(k, 0), f"roi.{k}") for k in ("x_offset", "y_offset")):
        raise DerenderError("the region of interest has an offset", remedy="give the camera_info of the whole image")


def _at_image_size(arguments: dict[str, Any], of: tuple[float, float], shape: tuple[int, int]) -> dict[str, Any]:
    """Return a camera's arguments for an image that is registered to a larger one, of (width, height), to which they
    belong."""
    height, width = shape
    x, y = (length / other if other > 0 else math.inf for length, other in ((width, of[0]), (height, of[1])))
    if not abs(x / y - 1) <= SAME_ASPECT:
        what = f"the camera is that of {of[0]:g} x {of[1]:g} pixels, the image has {width} x {height}"
        raise DerenderError(what, "camera", "give the camera of this image")
    scaled = {"fx": arguments["fx"] * x, "fy": arguments["fy"] * y, "width": width, "height": height}
    return arguments | scaled | {"cx": (arguments["cx"] + 0.5) * x - 0.5, "cy": (arguments["cy"] + 0.5) * y - 0.5}


def _unwrap(tree: dict, frame: str | None) -> object:
    """Return the part of a tree that holds the camera."""
    if "CalibrationInformation" in tree:
        what = "this is the raw calibration of an Azure Kinect, whose depth image has lens distortion"
        remedy = "give those that Open3D's azure_kinect_mkv_reader writes, or the matrix of the undistorted image"
        raise DerenderError(what, "camera", remedy)
    sockets = tree.get("cameraData")
    if isinstance(sockets, list) and sockets:  # of an OAK, whose rectified image has no distortion any more
        cameras = {str(entry[0]): entry[1] for entry in sockets if isinstance(entry, list) and len(entry) == 2}
        return cameras.get(str(RIGHT_SOCKET)) or next(iter(cameras.values()), None)
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
    lacking = [key for key in Format().numbers if key not in tree]
    if len(lacking) < 4:
        raise DerenderError("this is not a whole camera", remedy="add " + " and ".join(lacking))
    known = ", ".join(sorted(map(str, tree))[:8])
    remedy = "derender reads BOP, Open3D, ROS camera_info and RealSense cameras"
    raise DerenderError(f"no camera in the keys {known}"[:300], remedy=remedy)


def _refuse_impossible(camera: Camera, room: int) -> None:
    """Refuse intrinsics that no depth camera has: mostly those of another image size or unit.
    room : how many times its size an image's principal point may lie outside; none where nothing says that size."""
    for name, focal, extent in (("fx", camera.fx, camera.width), ("fy", camera.fy, camera.height)):
        degrees = math.degrees(2 * math.atan(extent / (2 * focal)))
        if not LEAST_DEGREES <= degrees <= MOST_DEGREES:
            what = f"{name} is {focal:g} pixels for {extent} pixels: a field of view of {degrees:.3g} degrees"
            raise DerenderError(what, "camera", "give the focal length in pixels of this image")
    for name, centre, extent in (("cx", camera.cx, camera.width), ("cy", camera.cy, camera.height)):
        if not -extent * room <= centre <= extent * (1 + room):
            far = "farther outside the image than it is large" if room else "outside the image"
            remedy = "give the camera of this image, in its pixels" + ("" if room else ", or width and height with it")
            raise DerenderError(f"{name} is {centre:g}, {far} ({extent} pixels)", "camera", remedy)


def load_tree(
    path: str | Path, what: str = "the camera", remedy: str = "give a camera file, e.g. a BOP camera.json"
) -> object:
    """Return the tree of a JSON or YAML file or of a .npy; YAML's scalars stay text, which `finite_number` reads.

    what, remedy : what the file should be, and what to do where it cannot be read.
    """
    import yaml

    most = MOST_BYTES if str(path).lower().endswith(".npz") else LARGEST_FILE  # a depth image with its camera
    data = read_bytes(path, most, what, remedy)
    try:
        if data.startswith(b"PK"):
            with at_fault(path):
                return decode_npz(data).camera
        if data.startswith(b"\x93NUMPY"):
            return np.load(BytesIO(data), allow_pickle=False).tolist()
        wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))  # as PowerShell's `>` writes
        text = data.decode("utf-16" if wide else "utf-8-sig")
        words = text.replace(",", " ").replace(";", " ").split()
        if len(words) in (9, 12, 16):  # a matrix as numpy.savetxt or a table writes it
            with contextlib.suppress(ValueError):
                return [float(word) for word in words]
        if text.lstrip().startswith("{"):
            try:
                return parse_json(text, path)
            except DerenderError as error:
                if not isinstance(error.__cause__, ValueError):  # else it is YAML in flow style
                    raise
        loader = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
        steps = (isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
                 for event in yaml.parse(text, loader))  # fmt: skip
        if max(accumulate(steps), default=0) > MOST_DEPTH:  # building its tree would recurse, in C, without a limit
            raise ValueError
        return next(iter(yaml.load_all(text, loader)))  # `rostopic echo` separates messages by ---
    except (yaml.YAMLError, RecursionError, StopIteration, *DAMAGE):
        raise DerenderError("neither JSON nor YAML", path, remedy) from None
