"""Depth images on disk: read any of the formats that people have, write the same formats.

In memory a depth image is (height, width) float64 in metres, NaN where there is no return; in a file no return is 0.
16-bit images (.png, .tiff, integer .npy) count units of the camera's `depth_scale` millimetres; floats are metres.
"""

import contextlib
import io
import json
import struct
import sys
import tokenize
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from derender.errors import DerenderError
from derender.vision.camera import FALLBACK_FIELD_OF_VIEW, MOST_PIXELS, Camera, camera_from_tree, read_camera

SUFFIXES = (".npz", ".npy", ".png", ".tiff", ".tif", ".exr")
FARTHEST = 1000.0  # metres; farther than any depth camera sees
FARTHEST_MEDIAN = 100.0  # metres; an image whose middle is farther has a wrong unit
NEAREST_MEDIAN = 0.002  # metres; likewise
SKY = 65504.0  # the largest half float: what Blender and others write into an .exr where a ray hits nothing
MOST_BYTES = 2**30
# What decoders raise on damaged files; anything else is a bug and shows its traceback.
DAMAGE = (OSError, EOFError, SyntaxError, ValueError, TypeError, KeyError, IndexError, OverflowError, MemoryError)
DAMAGE += (struct.error, zlib.error, zipfile.BadZipFile, tokenize.TokenError, RuntimeError)  # type: ignore[assignment]


class DepthImage(NamedTuple):
    """A depth image with the camera that saw it.

    Attributes
    ----------
    depth : (height, width) float64, metres; NaN where there is no return.
    camera : its camera.
    camera_is_guess : True where neither the file nor the user gave one, so that it has the fallback field of view.
    meta : what the file says about its origin (seed, version, command), or {}.
    """

    depth: np.ndarray
    camera: Camera
    camera_is_guess: bool = False
    meta: dict[str, Any] = {}


class _Decoded(NamedTuple):
    """What a format's decoder found: the raw array and, in an .npz, camera and meta."""

    array: np.ndarray
    camera: object = None
    meta: dict[str, Any] = {}


def read_depth(
    path: str | Path, camera: Camera | str | Path | None = None, depth_scale: float | None = None
) -> DepthImage:
    """Read a depth image of any known format, recognised by its first bytes, and its camera.

    Parameters
    ----------
    path : the file; `-` is stdin.
    camera : a Camera or a camera file; default: the camera in the file, else a guess of 60 degrees field of view.
    depth_scale : millimetres for one unit; overrides the camera's, and applies to float images too.

    Raises
    ------
    DerenderError : anything that makes the image unusable, in one line.
    """
    data = _read_bytes(path)
    decoder, name = _recognise(data, path)
    try:
        decoded = decoder(data)
    except DerenderError as error:
        raise DerenderError(error.what, path, error.remedy) from None
    except DAMAGE as error:
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise DerenderError(f"the {name} file is damaged or cut off ({reason})", path, "write it again") from None
    array = _two_dimensional(decoded.array, path)
    found, guessed = _camera(path, camera, decoded.camera, array.shape)
    if found.shape != array.shape:
        what = f"the image is {array.shape[1]} x {array.shape[0]} pixels, its camera {found.width} x {found.height}"
        raise DerenderError(what, path, "give the camera of this image")
    depth = _metres(array, found.depth_scale, depth_scale, path)
    return DepthImage(depth, found, guessed, decoded.meta)


def write_depth(
    path: str | Path,
    depth: np.ndarray,
    camera: Camera,
    meta: dict[str, Any] | None = None,
    label: np.ndarray | None = None,
) -> None:
    """Write a depth image in the format of the suffix, whole or not at all; `-` writes an .npz to stdout.

    Parameters
    ----------
    depth : (height, width), metres; NaN, inf and 0 mean no return.
    camera : goes into an .npz; of the other formats a 16-bit .png uses its depth_scale.
    meta : seed, version, command; kept in an .npz only.
    label : (height, width) int32, which solid each pixel sees or -1; kept in an .npz only.
    """
    suffix = ".npz" if str(path) == "-" else Path(path).suffix.lower()
    check_suffix(path)
    metres = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
    if suffix == ".npz":
        data = encode_npz(metres, camera, meta or {}, label)
    elif suffix == ".npy":
        data = _npy(metres)
    elif suffix == ".png":
        data = _encode_png(metres, camera.depth_scale, path)
    elif suffix == ".exr":
        data = _encode_exr(metres)
    else:
        data = _encode_tiff(metres)
    if str(path) == "-":
        sys.stdout.buffer.write(data)
        return
    from derender.atomic import atomic_path

    with atomic_path(path) as temporary:
        Path(temporary).write_bytes(data)


def check_suffix(path: str | Path) -> None:
    """Raise DerenderError unless `write_depth` knows the suffix: commands ask before they compute."""
    if str(path) != "-" and Path(path).suffix.lower() not in SUFFIXES:
        what = f"no depth format has the suffix {Path(path).suffix!r}"
        raise DerenderError(what, path, "choose from " + " ".join(SUFFIXES))


# Checks that all formats share


def _read_bytes(path: str | Path) -> bytes:
    try:
        if str(path) == "-":
            data = sys.stdin.buffer.read(MOST_BYTES + 1)
        else:
            with open(path, "rb") as file:
                data = file.read(MOST_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise DerenderError(f"cannot read the depth image: {reason}", path, "check the path") from None
    if len(data) > MOST_BYTES:
        raise DerenderError("too large for a depth image", path)
    if not data:
        raise DerenderError("the file is empty", path, "write it again")
    return data


def _two_dimensional(array: np.ndarray, path: str | Path) -> np.ndarray:
    if array.ndim == 3 and 1 in (array.shape[0], array.shape[2]):
        array = array[0] if array.shape[0] == 1 else array[..., 0]
    if array.ndim != 2 or 0 in array.shape:
        shape = " x ".join(map(str, array.shape)) or "a single number"
        colour = "; this looks like a colour image" if array.ndim == 3 and array.shape[2] in (3, 4) else ""
        raise DerenderError(f"the array is {shape}{colour}", path, "a depth image is height x width")
    if array.size > MOST_PIXELS:
        raise DerenderError("too many pixels", path)
    if array.dtype == np.uint8 or array.dtype == np.int8 or array.dtype == bool:
        raise DerenderError("8 bits a pixel are too coarse for depth", path, "give 16-bit units or float metres")
    if array.dtype.kind not in "fiu":
        raise DerenderError(f"the array holds {array.dtype}", path, "give 16-bit units or float metres")
    return array


def _camera(path: str | Path, given: Camera | str | Path | None, inside: object, shape: tuple[int, int]):
    """Return the camera and whether it is a guess."""
    if isinstance(given, Camera):
        return given, False
    if given is not None:
        if str(given).lower().endswith(".npz"):
            return _camera_of_npz(given, shape), False
        return read_camera(given, shape, frame=Path(path).stem), False
    if inside is not None:
        try:
            return camera_from_tree(inside, shape), False
        except DerenderError as error:
            raise DerenderError(error.what, f"{path}: camera", error.remedy) from None
    return Camera.from_field_of_view(shape[1], shape[0], FALLBACK_FIELD_OF_VIEW), True


def _camera_of_npz(path: str | Path, shape: tuple[int, int]) -> Camera:
    try:
        tree = _decode_npz(_read_bytes(path)).camera
    except DAMAGE:
        tree = None
    if tree is None:
        raise DerenderError("no camera in this file", path, "give a camera file")
    return camera_from_tree(tree, shape)


def _metres(array: np.ndarray, camera_scale: float, explicit: float | None, path: str | Path) -> np.ndarray:
    """Return float64 metres with NaN for no return, or say what is impossible about the numbers."""
    integer = array.dtype.kind in "iu"
    depth = array.astype(np.float64)
    scale = explicit if explicit is not None else camera_scale if integer else None
    with np.errstate(over="ignore"):
        if scale is not None:
            depth *= scale / 1000
        elif depth.max(initial=0, where=np.isfinite(depth)) >= SKY:
            depth[depth >= SKY] = np.nan
    depth[~np.isfinite(depth) | (depth == 0)] = np.nan
    valid = depth[np.isfinite(depth)]
    if not valid.size:
        raise DerenderError("no pixel has a depth (all are 0, NaN or inf)", path, "check the camera or the export")
    if valid.min() < 0:
        count = np.count_nonzero(valid < 0)
        remedy = "depth is positive in front of the camera; negate it if your tool looks along -z"
        raise DerenderError(f"{count} of {valid.size} depths are negative", path, remedy)
    middle, farthest = float(np.median(valid)), float(valid.max())
    if middle > FARTHEST_MEDIAN or farthest > FARTHEST or middle < NEAREST_MEDIAN:
        what = f"the median depth is {middle:.3g} m, the largest {farthest:.3g} m"
        used = f"depth_scale is {scale:g} mm" if scale is not None else "floats count as metres"
        raise DerenderError(what, path, f"{used}; set --depth-scale (1 where a unit is a millimetre)")
    return depth


# Formats: the first bytes tell them apart


def _recognise(data: bytes, path: str | Path) -> tuple[Callable[[bytes], _Decoded], str]:
    for magic, name, decoder in MAGIC:
        if data.startswith(magic):
            return decoder, name
    for magic, name in ((b"\xff\xd8", "JPEG"), (b"BM", "BMP"), (b"GIF8", "GIF"), (b"P5", "PGM"), (b"P6", "PPM")):
        if data.startswith(magic):
            raise DerenderError(f"a {name} is not a depth image", path, "give " + " ".join(SUFFIXES))
    raise DerenderError("not a depth image that derender knows", path, "give " + " ".join(SUFFIXES))


def _npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.asarray(array, order="C"), allow_pickle=False)
    return stream.getvalue()


def _decode_npy(data: bytes) -> _Decoded:
    return _Decoded(_load_npy(data))


def _load_npy(data: bytes) -> np.ndarray:
    """Return the array of an .npy; its header is checked against the length before memory is asked for."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _fortran, dtype = header(stream)
    if dtype.hasobject:
        raise DerenderError(f"the array holds Python objects ({dtype})", remedy="save it as float32 metres")
    count = 1
    for length in shape:
        count *= length
    if count * dtype.itemsize > len(data) - stream.tell():
        raise ValueError(f"{count} numbers announced, fewer there")
    stream.seek(0)
    return np.load(stream, allow_pickle=False)


def encode_npz(depth: np.ndarray, camera: Camera, meta: dict[str, Any], label: np.ndarray | None = None) -> bytes:
    """Return the bytes of an .npz: `depth` float32 metres, `camera` and `meta` as JSON text, `label` int32.

    The same arguments give the same bytes: the members' times are fixed.
    """
    members = {"depth": depth, "camera": np.array(json.dumps(camera.to_dict())), "meta": np.array(json.dumps(meta))}
    if label is not None:
        members["label"] = np.asarray(label, dtype=np.int32)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, array in members.items():
            info = zipfile.ZipInfo(name + ".npy", date_time=(1980, 1, 1, 0, 0, 0))
            info.external_attr = 0o644 << 16
            info.create_system = 3
            archive.writestr(info, _npy(array), zipfile.ZIP_DEFLATED, compresslevel=6)
    return stream.getvalue()


def _decode_npz(data: bytes) -> _Decoded:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        sizes = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        if sum(info.file_size for info in sizes.values()) > MOST_BYTES:
            raise DerenderError("too large for a depth image")
        name = "depth" if "depth" in sizes else next(iter(sizes)) if len(sizes) == 1 else None
        if name is None:
            kinds = ", ".join(list(sizes)[:6])
            raise DerenderError(f"no array `depth` among {kinds}", remedy="give an .npz as derender writes it")
        array = _load_npy(archive.read(sizes[name]))
        texts = {key: _load_npy(archive.read(sizes[key])) for key in ("camera", "meta") if key in sizes}
        matrix = next((_load_npy(archive.read(sizes[k])) for k in ("K", "intrinsics") if k in sizes), None)
    trees = {key: json.loads(str(text.item())) for key, text in texts.items()}
    camera = trees.get("camera")
    if camera is None and matrix is not None:
        camera = {"K": matrix.ravel().tolist()}
    meta = trees.get("meta")
    return _Decoded(array, camera, meta if isinstance(meta, dict) else {})


def _decode_picture(data: bytes) -> _Decoded:
    """Decode a .png or .tiff; what its mode says about depth is checked before a pixel is read."""
    import warnings

    from PIL import Image, UnidentifiedImageError

    from derender.vision.silence import silence

    with silence(), warnings.catch_warnings(), contextlib.ExitStack() as stack:
        warnings.simplefilter("ignore")  # about corrupt metadata; the pixels are what counts
        try:
            picture = stack.enter_context(Image.open(io.BytesIO(data), formats=("PNG", "TIFF")))
        except UnidentifiedImageError:
            remedy = "save a 16-bit .png or a float32 .tiff of one channel"
            raise DerenderError("the picture is damaged, cut off, or of a rare kind", remedy=remedy) from None
        if picture.width * picture.height > MOST_PIXELS:
            raise DerenderError(f"{picture.width} x {picture.height} pixels are too many")
        if picture.mode in ("1", "L", "P"):
            raise DerenderError("8 bits a pixel are too coarse for depth", remedy="save 16 bits a pixel")
        if picture.mode not in ("I;16", "I;16B", "I;16L", "I", "F"):
            what = f"this is a colour image ({picture.mode})"
            raise DerenderError(what, remedy="give the depth image: one channel of 16-bit units or float metres")
        picture.load()
        array = np.array(picture)
    return _Decoded(array.astype(array.dtype.newbyteorder("=")))


def _encode_png(depth: np.ndarray, depth_scale: float, path: str | Path) -> bytes:
    from PIL import Image

    units = np.round(depth.astype(np.float64) * (1000 / depth_scale))
    if units.max(initial=0) > 65535:
        what = f"{depth.max():.4g} m does not fit into 16 bits of {depth_scale:g} mm"
        raise DerenderError(what, path, "write .npz, .npy, .tiff or .exr, or a camera with a larger depth_scale")
    stream = io.BytesIO()
    Image.fromarray(units.astype(np.uint16)).save(stream, "PNG")
    return stream.getvalue()


def _encode_tiff(depth: np.ndarray) -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(depth).save(stream, "TIFF")
    return stream.getvalue()


def _decode_exr(data: bytes) -> _Decoded:
    from derender.vision.exr import decode_exr

    return _Decoded(decode_exr(data))


def _encode_exr(depth: np.ndarray) -> bytes:
    from derender.vision.exr import encode_exr

    return encode_exr(depth)


MAGIC: tuple[tuple[bytes, str, Callable[[bytes], _Decoded]], ...] = (
    (b"\x89PNG", ".png", _decode_picture),
    (b"II*\x00", ".tiff", _decode_picture),
    (b"MM\x00*", ".tiff", _decode_picture),
    (b"II+\x00", ".tiff", _decode_picture),
    (b"\x93NUMPY", ".npy", _decode_npy),
    (b"PK\x03\x04", ".npz", _decode_npz),
    (b"v/1\x01", ".exr", _decode_exr),
)
