"""Depth images on disk: read any of the formats that people have, write the same formats.

In memory a depth image is (height, width) float64 in metres, NaN where there is no return; in a file no return is 0.
16-bit images (.png, .tiff, integer .npy) count units of the camera's `depth_scale` millimetres; floats are metres.
`Reading` says with which camera and unit they are read, turned, without the pixels that the sensor itself doubts.
"""

import base64
import contextlib
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from derender.atomic import write_bytes
from derender.camera.camera_file import camera_beside, camera_from_tree, read_camera
from derender.camera.image_files import (
    DAMAGE,
    FEW_STEPS,
    MOST_BYTES,
    RAW,
    SATURATED,
    STRETCHED,
    SUFFIXES,
    Decoded,
    encode_exr,
    encode_npy,
    encode_npz,
    encode_png,
    encode_tiff,
    png_bytes,
    read_bytes,
    read_numbers,
    recognise,
)
from derender.camera.intrinsics import FALLBACK_FIELD_OF_VIEW, MOST_PIXELS, Camera, unit_vector
from derender.camera.ros_bag import is_bag, read_frame
from derender.errors import DerenderError, at_fault
from derender.registry import only_its_keywords

SHOWN_WIDTH = 240  # pixels of a picture in a notebook
TURNS = (0, 90, 180, 270)  # degrees clockwise
FARTHEST = 1000.0  # metres; farther than any depth camera sees: the sky, where a renderer's ray hits nothing
FARTHEST_MEDIAN = 100.0  # metres; an image whose middle is farther has a wrong unit
NEAREST_MEDIAN = 0.002  # metres; likewise
NEAREST = 1e-6  # metres; what is nearer is no return: its inverse square would overflow where noise is estimated


class DepthImage(NamedTuple):
    """A depth image with the camera that saw it.

    depth : (height, width) float64, metres; NaN where there is no return.
    camera : its camera.
    camera_is_guess : True where neither the file nor the user gave one, so that it has the fallback field of view.
    meta : what the file says about its origin (seed, version, command), or {}.
    """

    depth: np.ndarray
    camera: Camera
    camera_is_guess: bool = False
    meta: dict[str, Any] = {}

    def __repr__(self) -> str:
        depth = np.asarray(self.depth)
        known = depth[np.isfinite(depth)]
        depths = f"{known.min():.3g} to {known.max():.3g} m" if known.size else "no depths"
        guess = ", its camera a guess" if self.camera_is_guess else ""
        size = " x ".join(map(str, depth.shape[::-1]))
        return f"<DepthImage: {size}, {depths} in {known.size / max(depth.size, 1):.0%} of it{guess}>"

    def _repr_html_(self) -> str:
        every = max(1, np.shape(self.depth)[1] // SHOWN_WIDTH)
        depth = np.asarray(self.depth)[::every, ::every]
        seen = np.isfinite(depth)
        near, far = np.quantile(depth[seen], (0.01, 0.99)) if seen.any() else (0.0, 1.0)
        part = np.clip((np.where(seen, depth, far) - near) / max(far - near, 1e-9), 0.0, 1.0)
        grey = np.where(seen, 255 - 215 * part, 0).astype(np.uint8)  # the nearer the lighter, black: no return
        picture = base64.b64encode(png_bytes(np.repeat(grey[..., None], 3, axis=2))).decode()
        words, style = escape(repr(self)), f"width:{SHOWN_WIDTH}px"
        return f'<div><img src="data:image/png;base64,{picture}" alt="{words}" style="{style}"><br>{words}</div>'


@only_its_keywords
def read_depth(
    path: str | Path | np.ndarray | Sequence[Sequence[float]],
    camera: Camera | Mapping[str, Any] | np.ndarray | Sequence[Sequence[float]] | str | Path | None = None,
    depth_scale: float | None = None,
    topic: str | None = None,
    may_be_empty: bool = False,
) -> DepthImage:
    """Read a depth image of any known format, recognised by its first bytes, and its camera; or take an array for one.

    path : the file; `-` is stdin; `recording.bag@12` is a frame of a ROS bag. Or an array (H, W), or a list of rows:
        floats are metres, integers of 16 bits or more are units of depth_scale millimetres.
    camera : a Camera, a camera file, a mapping as a camera file holds it (fx, fy, cx, cy are enough), or a 3 x 3 matrix
        of intrinsics; default: the camera in the file, else NAME_camera.json or camera.json beside it, else a
        guess of 60 degrees field of view.
    depth_scale : millimetres for one unit; overrides the camera's, and applies to float images too.
    topic : of a bag's depth images, where it has several. may_be_empty : whether no pixel need have a depth, as where a
        sensor drops a frame of a film.

    An image whose file says by EXIF that it is to be turned is turned, and its camera with it.

    Raises DerenderError : anything that makes the image unusable, in one line.

    >>> import numpy as np
    >>> from derender import read_depth
    >>> image = read_depth(np.full((48, 64), 900, np.uint16), camera={"fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5})
    >>> float(image.depth[0, 0]), image.camera.width  # 900 units are 900 mm
    (0.9, 64)
    """
    if isinstance(path, str | Path) and is_bag(path):
        return image_of(Decoded(*read_frame(str(path), topic)), path, camera, depth_scale, may_be_empty)
    if isinstance(path, str | Path):
        return image_of(decoded_file(path), path, camera, depth_scale, may_be_empty)
    return image_of(Decoded(_array(path)), "the array", camera, depth_scale, may_be_empty)


def decoded_file(path: str | Path) -> Decoded:
    """Return the array of a file that is recognised by its first bytes, with what is beside it."""
    data = read_bytes(path, MOST_BYTES, "the depth image", "check the path")
    decoder, name = recognise(data, path)
    try:
        with at_fault(path, always=True):
            return decoder(data)
    except DAMAGE as error:
        told = next((part for part in error.args if isinstance(part, str)), "")
        reason = " ".join(told.split())[:120] or type(error).__name__
        raise DerenderError(f"the {name} file is damaged or cut off ({reason})", path, "write it again") from None


def image_of(
    decoded: Decoded, where: str | Path, camera: Any, depth_scale: float | None, may_be_empty: bool
) -> DepthImage:
    """Return what was decoded as an image in metres, checked; where : what is at fault. Otherwise as `read_depth`."""
    array = _two_dimensional(decoded.array, where)
    found, guessed = _camera(where, camera, decoded.camera, array.shape)
    if found.shape != array.shape:
        what = f"the image is {array.shape[1]} x {array.shape[0]} pixels, its camera {found.width} x {found.height}"
        raise DerenderError(what, where, "give the camera of this image" + _at_its_size(found, array.shape))
    depth = _metres(array, found.depth_scale, depth_scale, where, may_be_empty)
    return turned(DepthImage(depth, found, guessed, decoded.meta), decoded.turn)


def turned(seen: DepthImage, degrees: int) -> DepthImage:
    """Return an image turned clockwise by 0, 90, 180 or 270 degrees, with the camera that would have seen it so."""
    if degrees not in TURNS:
        raise DerenderError(f"an image cannot be turned by {degrees}", "--rotate", "choose from 90, 180, 270")
    depth, camera = seen.depth, seen.camera
    for _ in range(degrees // 90):
        depth = np.rot90(depth, -1)
        gravity = camera.gravity
        camera = replace(
            camera, fx=camera.fy, fy=camera.fx, cx=camera.height - 1 - camera.cy, cy=camera.cx, width=camera.height,
            height=camera.width, gravity=None if gravity is None else (-gravity[1], gravity[0], gravity[2]),
        )  # fmt: skip
    return seen._replace(depth=np.ascontiguousarray(depth), camera=camera)


def _array(
    given: object, what: str = "a depth image", remedy: str = "an array (height, width) of metres"
) -> np.ndarray:
    """Return what a program gives as an array; DerenderError where it is none. what, remedy : what it should be."""
    if isinstance(given, np.ma.MaskedArray):  # what is masked has no return
        return given.filled(0 if given.dtype.kind in "iu" else np.nan)
    if isinstance(given, list | tuple) and any(isinstance(each, str | Path | DepthImage) for each in given):
        raise DerenderError("these are several images", remedy="give one; a loop over them is many")
    try:
        array = np.asarray(given)
    except ValueError:  # rows of different lengths
        raise DerenderError("the rows have different lengths", "the array", f"give {remedy}") from None
    if array.dtype == object:
        with contextlib.suppress(ValueError):
            array = np.array(array.tolist())  # numbers that were kept as objects, as pandas keeps UInt16
    if array.dtype == object:
        raise DerenderError(f"a {type(given).__name__} is no {what.removeprefix('a ')}", remedy=f"give {remedy}")
    return array.astype(np.float64) if isinstance(given, list | tuple) and array.dtype.kind in "iu" else array


def _at_its_size(camera: Camera, shape: tuple[int, int]) -> str:
    """Return what a camera file would have to hold were it the same camera, its image scaled; "" where it cannot be."""
    factor = camera.width / shape[1]
    if abs(camera.height - factor * shape[0]) > 0.5 * factor or camera.height < factor:  # another aspect
        return ""
    small = camera.downscaled(factor).to_dict() | {"height": shape[0], "width": shape[1]}
    numbers = {key: round(n, 3) for key, n in small.items() if isinstance(n, int | float)}
    return f"; scaled to its size the same would be {json.dumps(numbers)}"


def write_depth(
    path: str | Path,
    depth: np.ndarray,
    camera: Camera,
    meta: dict[str, Any] | None = None,
    label: np.ndarray | None = None,
) -> None:
    """Write a depth image in the format of the suffix, whole or not at all; `-` writes an .npz to stdout.

    depth : (height, width), metres; NaN, inf and 0 mean no return.
    camera : goes into an .npz; of the other formats a 16-bit .png uses its depth_scale.
    meta : seed, version, command; kept in an .npz only.
    label : (height, width) int32, which solid each pixel sees or -1; kept in an .npz only.
    """
    suffix = ".npz" if str(path) == "-" else Path(path).suffix.lower()
    check_suffix(path)
    metres = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
    data = {
        ".npz": lambda: encode_npz(metres, camera, meta or {}, label),
        ".npy": lambda: encode_npy(metres),
        ".png": lambda: encode_png(metres, camera.depth_scale, path),
        ".exr": lambda: encode_exr(metres),
    }.get(suffix, lambda: encode_tiff(metres))()
    if str(path) == "-":
        sys.stdout.buffer.write(data)
        return
    write_bytes(path, data)


def check_suffix(path: str | Path) -> None:
    """Raise DerenderError unless `write_depth` knows the suffix: commands ask before they compute."""
    if str(path) != "-" and Path(path).suffix.lower() not in SUFFIXES:
        what = f"no depth format has the suffix {Path(path).suffix!r}"
        raise DerenderError(what, path, "choose from " + " ".join(SUFFIXES))


# Checks that all formats share


def _two_dimensional(array: np.ndarray, path: str | Path) -> np.ndarray:
    if array.ndim == 3 and 1 in (array.shape[0], array.shape[2]):
        array = array[0] if array.shape[0] == 1 else array[..., 0]
    if array.ndim != 2 or 0 in array.shape:
        shape = " x ".join(map(str, array.shape)) if array.ndim > 1 else "no picture but a list or a number"
        colour = "; this looks like a colour image" if array.ndim == 3 and array.shape[2] in (3, 4) else ""
        film = ", and --track follows a film" if array.ndim == 3 and not colour else ""
        raise DerenderError(f"the array is {shape}{colour}", path, f"a depth image is height x width{film}")
    if array.size > MOST_PIXELS:
        raise DerenderError("too many pixels", path)
    if array.dtype == np.uint8 or array.dtype == np.int8 or array.dtype == bool:
        raise DerenderError("8 bits a pixel are too coarse for depth", path, RAW)
    if array.dtype.kind not in "fiu":
        raise DerenderError(f"the array holds {array.dtype}", path, "give 16-bit units or float metres")
    if array.dtype == np.uint16 and not (array % STRETCHED).any() and len(np.unique(array)) > FEW_STEPS:
        raise DerenderError("this is a picture of 8 bits a pixel, stretched to 16", path, RAW)
    return array


def _camera(path: str | Path, given: Any, inside: object, shape: tuple[int, int]) -> tuple[Camera, bool]:
    """Return the camera and whether it is a guess."""
    if isinstance(given, Camera):
        return given, False
    if isinstance(given, Mapping):
        return camera_from_tree(dict(given), shape), False
    if isinstance(given, str | Path):
        return read_camera(given, shape, frame=Path(path).stem), False
    if given is not None:
        with at_fault("camera"):
            return camera_from_tree({"cam_K": _array(given, "a camera", "a 3 x 3 matrix").tolist()}, shape), False
    if inside is not None:
        with at_fault(f"{path}: camera", always=True):
            return camera_from_tree(inside, shape), False
    beside = camera_beside(path)
    if beside is not None:
        return read_camera(beside, shape, frame=Path(path).stem), False
    return Camera.from_field_of_view(shape[1], shape[0], FALLBACK_FIELD_OF_VIEW), True


def _metres(
    array: np.ndarray, camera_scale: float, explicit: float | None, path: str | Path, may_be_empty: bool
) -> np.ndarray:
    """Return float64 metres with NaN for no return, or say what is impossible about the numbers."""
    if explicit is not None and not 0 < explicit < np.inf:
        raise DerenderError(f"it is {explicit:g}", "--depth-scale", "give millimetres for one unit, more than none")
    integer = array.dtype.kind in "iu"
    scale = explicit if explicit is not None else camera_scale if integer else None
    with np.errstate(over="ignore", invalid="ignore"):  # a damaged file holds NaNs of other kinds
        depth = array.astype(np.float64)
        if scale is not None:
            depth *= scale / 1000
    if array.dtype == np.uint16:
        depth[array == SATURATED] = np.nan
    depth[~np.isfinite(depth) | (np.abs(depth) < NEAREST)] = np.nan
    valid = depth[np.isfinite(depth)]
    if not valid.size:
        if may_be_empty:
            return depth
        raise DerenderError("no pixel has a depth (all are 0, NaN or inf)", path, "check the camera or the export")
    if valid.min() < 0:
        count = np.count_nonzero(valid < 0)
        remedy = "depth is positive in front of the camera; negate it if your tool looks along -z"
        raise DerenderError(f"{count} of {valid.size} depths are negative", path, remedy)
    near = valid[valid <= FARTHEST]
    middle, farthest = float(np.median(near if near.size else valid)), float(valid.max())
    if not NEAREST_MEDIAN <= middle <= FARTHEST_MEDIAN:
        what = f"the median depth is {middle:.3g} m, the largest {farthest:.3g} m"
        used = f"depth_scale is {scale:g} mm" if scale is not None else "floats count as metres"
        raise DerenderError(what, path, f"{used}; set --depth-scale (1 where a unit is a millimetre)")
    return np.where(depth <= FARTHEST, depth, np.nan)


@dataclass(frozen=True)
class Reading:
    """How depth images are read.

    camera : camera file, or None: the one in the image's file, else a guess.
    depth_scale : millimetres for one unit; None: the camera's.
    rotate : degrees, 0, 90, 180 or 270, by which the image is turned clockwise, its camera and gravity with it.
    confidence : a map of the image's size, or a folder with maps of the images' names; None: none.
    least_confidence : pixels whose confidence is less are taken as without a return.
    up : the direction upwards in camera axes before turning (x right, y down, z forward), or None: the camera's.
    topic : of a ROS bag's depth images, or None: the only one.
    """

    camera: str | None = None
    depth_scale: float | None = None
    rotate: int = 0
    confidence: str | None = None
    least_confidence: float = 1.0
    up: str | None = None
    topic: str | None = None

    def read(self, path: str | Path, camera: Camera | None = None) -> DepthImage:
        """Return the depth image of a file.

        camera : taken with its unit where nothing else says which it is and it fits the image, such as a prior's.

        Raises DerenderError : anything that makes the image, its camera or its confidence unusable.
        """
        seen = read_depth(path, self.camera, self.depth_scale, self.topic)
        if seen.camera_is_guess and camera is not None and camera.shape == seen.depth.shape and str(path) != "-":
            seen = read_depth(path, camera, self.depth_scale, self.topic)
        if self.up is not None:
            seen = with_up(seen, self.up)
        if self.confidence is not None:
            seen = seen._replace(depth=without_doubtful(seen.depth, path, self.confidence, self.least_confidence))
        return turned(seen, self.rotate)


def with_up(seen: DepthImage, up: str | Sequence[float] | np.ndarray) -> DepthImage:
    """Return an image whose camera knows which way is up: x,y,z in its axes, numbers or text, or an axis such as -y."""
    down = [-number for number in direction(up if isinstance(up, str) else ",".join(map(str, up)))]
    return seen._replace(camera=replace(seen.camera, gravity=unit_vector(down, "--up")))


def direction(text: str) -> list[float]:
    """Return the direction that x,y,z or an axis such as -y says."""
    axes = {f"{sign}{axis}": (axis, -1.0 if sign == "-" else 1.0) for axis in "xyz" for sign in ("", "+", "-")}
    if text.strip() in axes:
        axis, sign = axes[text.strip()]
        return [sign * (axis == other) for other in "xyz"]
    try:
        numbers = [float(part) for part in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not np.isfinite(numbers).all() or np.linalg.norm(numbers) < 1e-9:
        raise DerenderError(f"{text!r} is no direction", "--up", "give x,y,z in camera axes, or an axis such as -y")
    return numbers


def without_doubtful(depth: np.ndarray, path: str | Path, confidence: str, least: float) -> np.ndarray:
    """Return a depth image (H, W) with NaN where a map of confidence says less than `least`."""
    place = Path(confidence)
    if place.is_dir():
        stem = Path(path).stem
        found = sorted(other for other in place.iterdir() if other.stem == stem and other.is_file())
        if not found:
            raise DerenderError(f"no map is called {stem}", confidence, "give the folder of this image's maps")
        place = found[0]
    values = read_numbers(place, "the confidence map", "give a grey .png or .tiff, or a .npy")
    values = values[..., 0] if values.ndim == 3 else values
    if values.ndim != 2:
        raise DerenderError("the map is no picture", place, "a map is height x width")
    if values.shape != depth.shape:
        what = f"the map is {values.shape[1]} x {values.shape[0]} pixels, the image {depth.shape[1]} x {depth.shape[0]}"
        raise DerenderError(what, place, "give the map of this image")
    kept = np.where(values >= least, depth, np.nan)
    if not np.isfinite(kept).any():
        raise DerenderError(f"no pixel has a confidence of {least:g}", place, "give less with --least-confidence")
    return kept
