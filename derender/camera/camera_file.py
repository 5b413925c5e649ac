"""One reader for the camera files that people have, which a table tells apart by their keys: BOP's, ROS's, devices'.

Depth images of devices and apps (ARKit and Record3D, Polycam, Nerfstudio, OAK, ZED) are often smaller than the colour
images that the intrinsics belong to, and registered to them: then the camera is scaled to the image at hand. Of several
cameras in a file one is taken where the image's name or size tells which.
"""

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from derender.camera.camera_text import load_tree
from derender.camera.intrinsics import Camera, finite_number, from_matrix, numbers_in
from derender.errors import DerenderError

STRAY_SCANNER = (1920, 1440)  # pixels of the video that its camera_matrix.csv belongs to
RIGHT_SOCKET = 2  # of an OAK: its depth is that of the rectified right camera
SAME_ASPECT = 0.02  # by how much the aspects of an image and of a smaller one registered to it differ at most
# Share of both sides from which on a principal point is another image's: of one twice as large it is the corner itself.
# Crops of the other corner of an image say how large they are.
CORNER = 0.9
MOST_DEGREES, LEAST_DEGREES = 175.0, 0.05  # field of view: no lens shows more without distortion, or less
DEEPEST = 4  # levels below which a camera is not looked for


class Format(NamedTuple):
    """How a tool writes a camera.

    numbers : keys of fx, fy, cx and cy, or that of their matrix, in small letters; also : those that it has besides.
    colour : whether the numbers belong to a larger image, of colours, to which the depth image is registered.
    corner : image coordinates of the first pixel's middle.
    """

    numbers: tuple[str, ...] = ("fx", "fy", "cx", "cy")
    also: tuple[str, ...] = ()
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
    Format(("fl_x", "fl_y", "cx", "cy"), colour=True, corner=0.5),  # Nerfstudio, COLMAP; fl_y may be missing
    Format(("camera_angle_x",), colour=True),  # NeRF's transforms.json, from Blender
    Format(("k",), ("w", "h"), colour=True),  # Record3D
    *(Format((key,), colour=True) for key in ("intrinsics", "cameraintrinsics", "intrinsicmatrix")),  # ARKit, Kalibr
    Format(also=("t_00", "t_22"), colour=True),  # Polycam
    Format(also=("disto",), colour=True),  # ZED
    Format(("fx", "fy", "ppx", "ppy")),  # RealSense
    Format(("fx_depth", "fy_depth", "mx_depth", "my_depth")),  # ScanNet
    *(
        Format((key,))
        for key in ("intrinsic_matrix", "cam_k", "k", "camera_matrix", "cameramatrix", "mtx", "intrinsic")
    ),
    Format(),  # BOP's camera.json, ORB-SLAM
)
UNIT_KEYS = ("depth_scale", "depth_units", "png_depth_scale", "depthmapfactor", "factor_depth", "scale")
LEAST_UNIT, MOST_UNIT = 0.002, 100.0  # mm; a smaller number says metres to a unit, a larger one units to the metre
POSE_KEYS = ("cameraposearframe", "cameratransform", "transform")
SIZE_KEYS = {
    "width": ("width", "w", "image_width", "depthwidth", "resolution_x"),
    "height": ("height", "h", "image_height", "depthheight", "resolution_y"),
}
DISTORTION = re.compile(r"[kp]\d|d\d?|coeffs?|cam_d|.*dist(?!ance).*|.*(radial|tangential).*")  # keys
NO_PINHOLE = re.compile(
    r"fish|equidist|kannala|f.?theta|omnidir|\bmei\b|ucm|double.?sphere|equirect|spheric|ortho|panor|^fov$"
)
PREFERRED = ("calibration_parameters", "left_cam")  # of a ZED: its depth is that of the rectified left camera


def read_camera(path: str | Path, shape: tuple[int, int] | None = None, frame: str | None = None) -> Camera:
    """Read a camera of any of the known formats, recognised by its keys.

    path : a JSON or YAML file: BOP camera.json or scene_camera.json, Open3D, OpenCV, ROS camera_info, RealSense
        intrinsics, what devices and apps write, or a derender scene; or text that a tool printed (`camera_text`), or
        a 3 x 3 matrix as JSON, CSV, text or .npy; `-` is stdin.
    shape : (height, width) of the image it belongs to; fills in a size that the file does not give.
    frame : name of the image, which chooses among the frames of a scene_camera.json ("000003" or "3").

    Raises DerenderError : unreadable or unknown file, distortion, no size, impossible numbers; says which file.
    """
    tree = load_tree(path)
    try:
        if isinstance(tree, list) and len(tree) in (3, 4, 9, 12, 16):
            of_video = Path(path).name == "camera_matrix.csv"  # StrayScanner's belongs to its video
            tree = {"K": tree, "w": STRAY_SCANNER[0], "h": STRAY_SCANNER[1]} if of_video else {"cam_K": tree}
        return camera_from_tree(tree, shape, frame)
    except DerenderError as error:
        where = path if error.where in (None, "camera") else f"{path}: {error.where}"
        raise DerenderError(error.what, where, error.remedy) from None


def camera_beside(path: str | Path) -> Path | None:
    """Return NAME_camera.json or camera.json beside an image NAME.png, or the latter in a folder; None without any."""
    place = Path(path)
    beside = [place / "camera.json"] if place.is_dir() else [
        place.with_name(name) for name in (f"{place.stem}_camera.json", "camera.json")
    ]  # fmt: skip
    return None if str(path) == "-" else next((file for file in beside if file.is_file()), None)


def camera_from_tree(tree: object, shape: tuple[int, int] | None = None, frame: str | None = None) -> Camera:
    """Return the camera that a loaded JSON or YAML tree describes; see `read_camera`."""
    found = _cameras_in(_rectified(tree))
    if not found:
        raise _no_camera(tree)
    chosen = _of_image(found, shape, frame)
    arguments = _arguments(chosen, shape)
    missing = [name for name in ("width", "height") if name not in arguments]
    if missing:
        raise DerenderError("the file does not say the image's size", remedy="add " + " and ".join(missing))
    camera = Camera(**arguments)
    _refuse_impossible(camera, room=0 if len(_size(chosen.tree)) < 2 else 1)
    return camera


def _rectified(tree: object) -> object:
    """Return a tree, or of an OAK's calibration the camera of its rectified image, which has no distortion any more."""
    if isinstance(tree, dict) and "CalibrationInformation" in tree:
        what = "this is the raw calibration of an Azure Kinect, whose depth image has lens distortion"
        remedy = "give those that Open3D's azure_kinect_mkv_reader writes, or the matrix of the undistorted image"
        raise DerenderError(what, "camera", remedy)
    sockets = tree.get("cameraData") if isinstance(tree, dict) else None
    if not isinstance(sockets, list):
        return tree
    cameras = {str(each[0]): each[1] for each in sockets if isinstance(each, list) and len(each) == 2}
    right = cameras.get(str(RIGHT_SOCKET)) or next(iter(cameras.values()), None)
    kept = ("intrinsicMatrix", "width", "height")
    return {key: right[key] for key in kept if key in right} if isinstance(right, dict) else None


class Found(NamedTuple):
    """A camera of a file: the names that lead to it, its format, and its tree with what stands around it."""

    path: tuple[str, ...]
    form: Format
    tree: dict[str, Any]

    def numbers(self) -> list[str]:
        """Return what tells it from other cameras."""
        keys = (*self.form.numbers, *UNIT_KEYS, *SIZE_KEYS["width"], *SIZE_KEYS["height"])
        return [str(self.tree.get(key)) for key in keys]


def _cameras_in(tree: object) -> list[Found]:
    """Return the cameras of a tree, keys in small letters and without a prefix (ORB-SLAM's `Camera.fx`)."""
    found: list[Found] = []
    waiting: list[tuple[tuple[str, ...], Any, dict[str, Any]]] = [((), tree, {})] * isinstance(tree, dict | list)
    seen: set[int] = set()  # what YAML's aliases name again and again
    for path, part, around in waiting:
        if id(part) in seen or len(path) > DEEPEST:
            continue
        seen.add(id(part))
        if isinstance(part, dict):
            short = ((re.sub(r"\W+", "_", str(key).rsplit(".", 1)[-1].lower()), key) for key in reversed(part))
            around = around | {name: part[key] for name, key in short}
            form = next((form for form in FORMATS if form.fits(around)), None)
            if form is not None:
                found.append(Found(path, form, around))
                continue
            around = {
                key: each for key, each in around.items() if DISTORTION.fullmatch(key) or not _holds_mappings(each)
            }
        for key, each in part.items() if isinstance(part, dict) else enumerate(part):
            if isinstance(each, dict | list):
                image = each.get("depth_file_path", each.get("file_path")) if isinstance(each, dict) else None
                waiting.append(((*path, str(key) if image is None else Path(str(image)).stem), each, around))
    return found


def _holds_mappings(value: object) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and any(isinstance(each, dict) for each in value[:1]))


def _of_image(cameras: list[Found], shape: tuple[int, int] | None, frame: str | None) -> Found:
    """Return the camera of an image among those of a file; DerenderError where several could be it."""
    number = "".join(filter(str.isascii, filter(str.isdecimal, frame.split("_")[-1]))) if frame else ""
    by_number = all(each.form.numbers == ("cam_k",) for each in cameras)  # BOP's scene_camera.json
    kept: list[Callable[[Found], bool]] = [
        lambda each: each.path[-1] == frame or (by_number and each.path[-1] == str(int(number or -1))),
        *(lambda each, name=name: name in each.path for name in PREFERRED),  # type: ignore[misc]
        lambda each: (_size(each.tree).get("height"), _size(each.tree).get("width")) == shape,
    ]
    for keeps in kept:
        if len({json.dumps(each.numbers()) for each in cameras}) > 1:
            cameras = [each for each in cameras if keeps(each)] or cameras
    if all(each.numbers() == cameras[0].numbers() for each in cameras):
        return cameras[0]
    names = ", ".join("/".join(each.path)[:40] for each in cameras[:5]) + (", ..." if len(cameras) > 5 else "")
    if by_number:
        raise DerenderError("the frames have different cameras", remedy=f"name the image after one of {names}")
    remedy = "give a file with this image's (that of the colour image where depth was aligned to it)"
    raise DerenderError(f"the file holds different cameras: {names}", remedy=remedy)


def _no_camera(tree: object) -> DerenderError:
    """Return what to say of a tree without a camera."""
    if not isinstance(tree, dict) or not tree:
        return DerenderError("this is not a camera", remedy="it needs at least fx, fy, cx, cy")
    lacking = [key for key in Format().numbers if key not in tree]
    if len(lacking) < 4:
        return DerenderError("this is not a whole camera", remedy="add " + " and ".join(lacking))
    known = ", ".join(sorted(map(str, tree))[:8])
    remedy = "derender reads the cameras of BOP, ROS, OpenCV, Open3D, COLMAP and devices, or fx, fy, cx and cy"
    return DerenderError(f"no camera in the keys {known}"[:300], remedy=remedy)


def _arguments(found: Found, shape: tuple[int, int] | None) -> dict[str, Any]:
    """Return Camera's arguments; width or height may be missing where no `shape` is."""
    _path, form, tree = found
    _refuse_what_is_no_pinhole(tree)
    size = _size(tree)
    arguments: dict[str, Any] = {}
    if form.numbers == ("camera_angle_x",):
        arguments = _of_angle(tree, size or dict(zip(("height", "width"), shape or (), strict=False)))
    elif len(form.numbers) == 1:
        (key,) = form.numbers
        numbers = numbers_in(tree[key], key)
        if len(numbers) == 4:  # Kalibr's
            arguments = dict(zip(Format().numbers, numbers, strict=True))
        else:
            matrix = _intrinsic_part(numbers, key)
            by_columns = matrix[0, 2] == matrix[1, 2] == 0  # as Open3D and some of ARKit's writers have it
            arguments = from_matrix(matrix.T if by_columns else matrix, key)
    else:
        each = (finite_number(tree.get(key, tree[form.numbers[0]]), key) for key in form.numbers)
        arguments = dict(zip(Format().numbers, each, strict=True))
    arguments |= {key: arguments[key] - form.corner for key in ("cx", "cy")}
    for key in UNIT_KEYS:
        if key not in tree or (key == "scale" and max(_nonzero_numbers(tree[key]), default=0) <= MOST_UNIT):
            continue  # a small scale is a picture's
        if (unit := finite_number(tree[key], key)) <= 0:
            raise DerenderError(f"{key} is {unit:g}", "camera", "give a positive number")
        arguments["depth_scale"] = 1000 * unit if unit < LEAST_UNIT else 1000 / unit if unit > MOST_UNIT else unit
    gravity = tree["gravity"] if tree.get("gravity") is not None else _gravity_of_pose(tree) if form.colour else None
    if gravity is not None:
        arguments["gravity"] = gravity
    if form.colour and shape is not None and len(size) == 2 and (size["height"], size["width"]) != shape:
        return _at_image_size(arguments, (size["width"], size["height"]), shape)
    return arguments | ({} if shape is None else {"height": shape[0], "width": shape[1]}) | size


def _intrinsic_part(numbers: np.ndarray, name: str) -> np.ndarray:
    """Return (3, 3) of the numbers of such a matrix, or of one (3, 4) or (4, 4) that adds nothing to it: ScanNet's."""
    wide = {12: 4, 16: 4}.get(len(numbers), 3)
    if len(numbers) not in (9, 12, 16):
        raise DerenderError(f"{name} has {len(numbers)} numbers", "camera", "it needs 9")
    whole = numbers.reshape(-1, wide)
    if not np.array_equal(whole[:, 3:], np.eye(4)[: len(whole), 3:wide]) or whole[3:, :3].any():
        what = f"{name} is no 3 x 3 matrix of intrinsics"
        raise DerenderError(what, "camera", "its rows are fx 0 cx, 0 fy cy, 0 0 1")
    return whole[:3, :3]


def _of_angle(tree: dict, size: Mapping[str, float]) -> dict[str, Any]:
    """Return fx, fy, cx and cy of NeRF's fields of view, whole, in radians; pixels are square where one is given."""
    if len(size) < 2:
        raise DerenderError("the file does not say the image's size", remedy="add w and h")
    angle = {name: finite_number(tree[key], key) for name in "xy" if (key := f"camera_angle_{name}") in tree}
    for name, each in angle.items():
        if not 0 < each < math.pi:
            raise DerenderError(f"camera_angle_{name} is {each:g}", "camera", "give a field of view in radians")
    width, height = size["width"], size["height"]
    fx = width / (2 * math.tan(angle["x"] / 2))
    fy = height / (2 * math.tan(angle["y"] / 2)) if "y" in angle else fx
    return {"fx": fx, "fy": fy, "cx": (width - 1) / 2, "cy": (height - 1) / 2}


def _size(tree: dict) -> dict[str, float]:
    """Return the width and height that a tree tells, if it does, in pixels."""
    for key in ("imageresolution", "resolution", "image_size"):
        value = tree.get(key)
        if isinstance(value, dict):
            tree = value
        elif isinstance(value, list) and len(value) == 2:
            tree = dict(zip(("width", "height"), value, strict=True))
    found = {}
    for name, keys in SIZE_KEYS.items():
        for key in keys:
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
    remedy = "rectify first, then give the rectified image's camera"
    for key, value in tree.items():
        if DISTORTION.fullmatch(key) and not key.endswith(("model", "type")) and any(_nonzero_numbers(value)):
            raise DerenderError(
                f"the camera has distortion ({key} is not zero)", "camera", remedy + " with zeros there"
            )
        words = str(value).lower()
        by_name = re.search("(distortion|camera|projection)_?(model|type)|^(model|type)$", key) and NO_PINHOLE.search(
            words
        )
        if isinstance(value, str | bool) and (by_name or ("fisheye" in key and words not in ("false", "0", ""))):
            raise DerenderError(f"{key} is {words[:40]}, so this is no pinhole camera", "camera", remedy)
    for name in ("binning_x", "binning_y"):
        if finite_number(tree.get(name, 0), name) > 1:
            raise DerenderError(f"{name} is {tree[name]}", remedy="give the camera_info of the image without binning")
    region = tree.get("roi")
    if isinstance(region, dict) and any(finite_number(region.get(k, 0), f"roi.{k}") for k in ("x_offset", "y_offset")):
        raise DerenderError("the region of interest has an offset", remedy="give the camera_info of the whole image")


def _nonzero_numbers(value: object) -> Iterator[float]:
    """Yield the numbers in a value that are not zero: in lists, in mappings, in ROS's {rows, cols, data}, in text."""
    if isinstance(value, dict):
        value = [value["data"]] if "data" in value else list(value.values())
    if isinstance(value, str):
        try:
            yield from filter(None, map(float, re.sub(r"[\[\](),]", " ", value).split()))
        except ValueError:
            yield from [math.nan] * bool(re.search(r"\d|nan|inf", value))  # else the name of a model
    elif isinstance(value, list | tuple | np.ndarray):
        for each in value:
            yield from _nonzero_numbers(each)
    elif isinstance(value, int | float) and not isinstance(value, bool) and value != 0:
        yield float(value)


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
    across, down = camera.cx / camera.width, camera.cy / camera.height
    if room == 0 and min(across, down) > CORNER:
        what = f"cx and cy are {camera.cx:g} and {camera.cy:g}, the corner of {camera.width} x {camera.height} pixels"
        raise DerenderError(what, "camera", "give the camera of this image, in its pixels, or width and height with it")
