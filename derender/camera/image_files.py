"""Image files: bytes to arrays and back, in the formats that depth images have; decoders kept quiet.

Which format a file has shows in its first bytes. PNG is written by zlib alone; OpenEXR has one channel of depth.
"""

import contextlib
import io
import json
import logging
import math
import os
import struct
import sys
import tempfile
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import MOST_PIXELS, Camera
from derender.errors import DerenderError
from derender.json_text import parse_json


def read_bytes(path: str | Path, most: int, what: str, remedy: str) -> bytes:
    """Return the bytes of a file, `-` for stdin.

    Raises DerenderError : it cannot be read (`what` says what it is, `remedy` what to do), is too large or empty.
    """
    try:
        if str(path) == "-":
            data = sys.stdin.buffer.read(most + 1)
        else:
            with open(path, "rb") as file:
                data = file.read(most + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise DerenderError(f"cannot read {what}: {reason}", path, remedy) from None
    if len(data) > most:
        raise DerenderError(f"too large for {what.replace('the ', 'a ', 1)}", path)
    if not data.strip():
        raise DerenderError("the file is empty", path, remedy)
    return data


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Send the process's stdout and stderr, Python's and C's, to nowhere, and Pillow's log with them.

    Not for use while other threads write.
    """
    log = logging.getLogger("PIL")
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    kept = [os.dup(stream) for stream in (1, 2)]
    try:
        with open(os.devnull, "w") as nowhere:
            for stream in (1, 2):
                os.dup2(nowhere.fileno(), stream)
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            yield
    finally:
        for stream, copy in zip((1, 2), kept, strict=True):
            os.dup2(copy, stream)
            os.close(copy)
        log.setLevel(level)


GREY, COLOUR, PALETTE = 0, 2, 3  # colour types of the format


def png_bytes(pixels: np.ndarray, palette: np.ndarray | None = None) -> bytes:
    """Return a PNG file of pixels: (height, width, 3) uint8, or (height, width) uint16 as 16-bit grey.

    palette : (256, 3) uint8, colours of which pixels (height, width) uint8 are numbers.
    """
    height, width = pixels.shape[:2]
    colour = PALETTE if palette is not None else GREY if pixels.ndim == 2 else COLOUR
    lines = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder(">"))).view(np.uint8).reshape(height, -1)
    rows = np.zeros((height, 1 + lines.shape[1]), dtype=np.uint8)  # each begins with its filter: none
    rows[:, 1:] = lines

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8 * pixels.dtype.itemsize, colour, 0, 0, 0)
    colours = chunk(b"PLTE", palette.tobytes()) if palette is not None else b""
    body = colours + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + body


DEPTH_NAMES = ("Z", "depth", "Depth", "V", "Y", "R")  # the renderers' names for it, the surest first


def decode_exr(data: bytes) -> np.ndarray:
    """Return the (height, width) depth channel of an .exr: the only channel, or the one that is named like depth.

    Raises DerenderError : a colour image, or no channel that could be depth.
    """
    import OpenEXR

    with tempfile.TemporaryDirectory(prefix="derender-") as folder:
        path = Path(folder) / "image.exr"
        path.write_bytes(data)
        try:
            with silence(), OpenEXR.File(str(path), separate_channels=True) as file:
                channels = {name: channel.pixels for name, channel in file.channels().items()}
        except (RuntimeError, ValueError, TypeError, IndexError, KeyError, OSError):
            raise ValueError("OpenEXR cannot read it") from None
    return _depth_channel(channels)


def encode_exr(depth: np.ndarray) -> bytes:
    """Return the bytes of an .exr with `depth` as its one channel Z, float32, compressed without loss."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with tempfile.TemporaryDirectory(prefix="derender-") as folder:
        path = Path(folder) / "image.exr"
        with OpenEXR.File(header, {"Z": np.ascontiguousarray(depth, dtype=np.float32)}) as file:
            file.write(str(path))
        return path.read_bytes()


def _depth_channel(channels: dict[str, np.ndarray]) -> np.ndarray:
    if len(channels) == 1:
        return next(iter(channels.values()))
    colours = {name.rsplit(".", 1)[-1]: pixels for name, pixels in channels.items()}
    if {"R", "G", "B"} <= colours.keys() and not any(name in colours for name in ("Z", "depth", "Depth", "V")):
        # Blender saves a depth pass as grey colour.
        if not all(np.array_equal(colours["R"], colours[name]) for name in "GB"):
            raise DerenderError("a colour image", remedy="give the depth pass: one channel, best called Z")
    for name in DEPTH_NAMES:
        if name in colours:
            return colours[name]
    raise DerenderError(f"no channel of depth among {', '.join(channels)}", remedy="give one channel, best called Z")


SUFFIXES = (".npz", ".npy", ".png", ".tiff", ".tif", ".exr")
MOST_BYTES = 4_000_000_000  # of an image, or of a film in one file
LEVEL = 4  # of compression: half the time of the usual 6 for files a sixth larger
RAW = "give the raw depth image: one channel of 16-bit units or float metres, no picture to look at"
STRETCHED, FEW_STEPS = 257, 8  # 8 bits become 16 by it; different depths that an image has at least
ORIENTATION, TURNS_OF = 274, {1: 0, 3: 180, 6: 90, 8: 270}  # a tag of EXIF; degrees clockwise to turn it upright
# Tags of TIFF, and a compression under which Pillow forgets a predictor.
WIDE, TALL, BITS, COMPRESSION, STRIPS, STRIP_SIZES, PREDICTOR, SAMPLE_FORMAT = 256, 257, 258, 259, 273, 279, 317, 339
PACKBITS = 32773
SATURATED = 65535  # the largest 16-bit number: farther than the image can tell, or no return at all
# What decoders raise on damaged files; anything else is a bug and shows its traceback.
DAMAGE = (OSError, EOFError, SyntaxError, ValueError, TypeError, KeyError, IndexError, OverflowError, MemoryError)
DAMAGE += (struct.error, zlib.error, zipfile.BadZipFile, tokenize.TokenError, RuntimeError)  # type: ignore[assignment]


class Decoded(NamedTuple):
    """What a format's decoder found: the raw array and, in an .npz, camera and meta.

    turn : degrees clockwise by which the file says that it is to be turned, with its camera.
    timing : what it says of time and gravity.
    """

    array: np.ndarray
    camera: object = None
    meta: dict[str, Any] = {}
    turn: int = 0
    timing: dict[str, Any] = {}


def recognise(data: bytes, path: str | Path) -> tuple[Callable[[bytes], Decoded], str]:
    """Return the decoder and the name of the format that the first bytes show; DerenderError where none."""
    for magic, name, decoder in MAGIC:
        if data.startswith(magic):
            return decoder, name
    for magic, name in ((b"\xff\xd8", "JPEG"), (b"BM", "BMP"), (b"GIF8", "GIF"), (b"P5", "PGM"), (b"P6", "PPM")):
        if data.startswith(magic):
            raise DerenderError(f"a {name} is not a depth image", path, "give " + " ".join(SUFFIXES))
    text = Path(path).suffix.lower() in (".yaml", ".yml", ".json")
    remedy = "--scene or --camera takes such a file" if text else "give " + " ".join(SUFFIXES)
    raise DerenderError("not a depth image that derender knows", path, remedy)


def encode_npy(array: np.ndarray) -> bytes:
    """Return the bytes of an .npy."""
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.asarray(array, order="C"), allow_pickle=False)
    return stream.getvalue()


def _load_npy(data: bytes) -> np.ndarray:
    """Return the array of an .npy; its header is checked against the length before memory is asked for."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _fortran, dtype = header(stream)
    if dtype.hasobject:
        raise DerenderError(f"the array holds Python objects ({dtype})", remedy="save it as float32 metres")
    count = math.prod(shape)
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
            archive.writestr(info, encode_npy(array), zipfile.ZIP_DEFLATED, compresslevel=LEVEL)
    return stream.getvalue()


PINHOLE = ("fx", "fy", "cx", "cy")
MATRICES, TIMING = ("K", "intrinsics"), ("fps", "gravity", "times", "timestamps")
BESIDE = ("camera", "meta", "depth_scale", *PINHOLE, *MATRICES, *TIMING)  # an .npz may hold besides


def decode_npz(data: bytes) -> Decoded:
    """Decode an .npz as derender writes it, or of others: `depth`, or the only array that is called like it, or that
    is none of BESIDE, and `K` or fx, fy, cx, cy."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        sizes = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        if sum(info.file_size for info in sizes.values()) > MOST_BYTES:
            raise DerenderError("too large for a depth image")
        others = [key for key in sizes if key not in BESIDE]
        named = [key for key in others if "depth" in key.lower()]
        found = ["depth"] if "depth" in sizes else named if len(named) == 1 else others
        if len(found) != 1:
            kinds = ", ".join(list(sizes)[:6])
            raise DerenderError(f"no array `depth` among {kinds}", remedy="give an .npz as derender writes it")
        array = _load_npy(archive.read(sizes[found[0]]))
        beside = {key: _load_npy(archive.read(sizes[key])) for key in BESIDE if key in sizes}
    trees = {key: parse_json(str(text.item()), key) for key, text in beside.items() if text.dtype.kind == "U"}
    numbers = {
        key: each.item() if each.size == 1 else each.tolist() for key, each in beside.items() if key not in trees
    }
    camera = trees.get("camera")
    if camera is None and (matrix := next((beside[key] for key in MATRICES if key in beside), None)) is not None:
        numbers["K"] = (matrix[0] if matrix.ndim == 3 else matrix).ravel().tolist()  # of a film one for each frame
    if camera is None and ("K" in numbers or set(PINHOLE) <= numbers.keys()):
        camera = {key: numbers[key] for key in ("K", *PINHOLE) if key in numbers}
    meta, timing = trees.get("meta"), {key: numbers[key] for key in TIMING if key in numbers}
    return Decoded(array, camera, meta if isinstance(meta, dict) else {}, timing=timing)


def _decode_picture(data: bytes) -> Decoded:
    """Decode a .png or .tiff; what its mode says about depth is checked before a pixel is read."""
    import warnings

    from PIL import Image, UnidentifiedImageError

    with silence(), warnings.catch_warnings(), contextlib.ExitStack() as stack:
        warnings.simplefilter("ignore")  # about corrupt metadata; the pixels are what counts
        try:
            picture = stack.enter_context(Image.open(io.BytesIO(data), formats=("PNG", "TIFF")))
        except UnidentifiedImageError:
            if (doubles := _doubles_of_tiff(data)) is not None:
                return Decoded(doubles)
            remedy = "save a 16-bit .png or a float32 .tiff of one channel"
            raise DerenderError("the picture is damaged, cut off, or of a rare kind", remedy=remedy) from None
        except Image.DecompressionBombError:
            raise DerenderError("the picture says that it has too many pixels", remedy="write it again") from None
        if picture.width * picture.height > MOST_PIXELS:
            raise DerenderError(f"{picture.width} x {picture.height} pixels are too many")
        if picture.mode in ("1", "L", "P"):
            raise DerenderError("8 bits a pixel are too coarse for depth", remedy=RAW)
        if picture.mode not in ("I;16", "I;16B", "I;16L", "I", "F"):
            raise DerenderError(f"this is a colour image ({picture.mode})", remedy=RAW)
        tags = getattr(picture, "tag_v2", {})
        if tags.get(COMPRESSION) == PACKBITS and tags.get(PREDICTOR, 1) != 1:
            raise DerenderError("PackBits with a predictor is not read", remedy="save the .tiff without the predictor")
        pages = getattr(picture, "n_frames", 1)
        if pages > 1:
            raise DerenderError(f"the picture has {pages} pages", remedy="save the one that holds the depth by itself")
        orientation = picture.getexif().get(ORIENTATION, 1)
        if orientation not in TURNS_OF:
            raise DerenderError("its EXIF orientation mirrors the image", remedy="save it without")
        picture.load()
        array, turn = np.array(picture), TURNS_OF[orientation]
        if ORIENTATION not in picture.getexif():  # Pillow has turned it, as it does to a TIFF, but not its camera
            array = np.rot90(array, turn // 90)
    return Decoded(array.astype(array.dtype.newbyteorder("=")), turn=turn)


def _doubles_of_tiff(data: bytes) -> np.ndarray | None:
    """Return the (height, width) 64-bit floats of a .tiff, which Pillow does not read; None: it is something else, or
    compressed, or tiled."""
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    stream, tags = io.BytesIO(data), ImageFileDirectory_v2(data[:8])
    with contextlib.suppress(*DAMAGE), silence():
        stream.seek(tags.next)
        tags.load(stream)
        plain = (tags[BITS], tags.get(SAMPLE_FORMAT), tags.get(COMPRESSION, 1)) == ((64,), (3,), 1)
        if not plain or (shape := (tags[TALL], tags[WIDE])) and math.prod(shape) > MOST_PIXELS:
            return None
        parts = zip(tags[STRIPS], tags[STRIP_SIZES], strict=True)
        pixels = b"".join(data[first : first + size] for first, size in parts)
        return np.frombuffer(pixels, tags._endian + "f8").reshape(shape).astype(float)
    return None


def encode_png(depth: np.ndarray, depth_scale: float, path: str | Path) -> bytes:
    """Return the bytes of a 16-bit .png in units of `depth_scale` mm; DerenderError where a depth does not fit."""
    units = np.round(depth.astype(np.float64) * (1000 / depth_scale))
    if units.max(initial=0) >= SATURATED:
        what = f"{depth.max():.4g} m does not fit into 16 bits of {depth_scale:g} mm"
        raise DerenderError(what, path, "write .npz, .npy, .tiff or .exr, or a camera with a larger depth_scale")
    return png_bytes(units.astype(np.uint16))


def encode_tiff(depth: np.ndarray) -> bytes:
    """Return the bytes of a float32 .tiff."""
    import imageio.v3 as imageio

    return imageio.imwrite("<bytes>", depth, extension=".tiff", plugin="pillow")


def read_numbers(path: str | Path, what: str, remedy: str) -> np.ndarray:
    """Return the numbers of a map or of labels: of an .npy, of `label` in an .npz, or of a picture whose colours count
    for nothing; (H, W), or (H, W, channels) of a picture that has several.

    Raises DerenderError : it cannot be read, or is neither. what, remedy : what it should be, and what would be right.
    """
    from PIL import Image

    data = read_bytes(path, MOST_BYTES, what, "check the path")
    try:
        if data.startswith(b"\x93NUMPY"):
            found = _load_npy(data)
        elif data.startswith(b"PK"):
            with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
                found = arrays["label"]
        else:
            with silence():
                found = np.asarray(Image.open(io.BytesIO(data)))
        if found.dtype.kind not in "buif":
            raise DerenderError(f"it holds {found.dtype}")
        return found
    except (*DAMAGE, DerenderError, Image.DecompressionBombError) as fault:
        why = f" ({fault.what})" if isinstance(fault, DerenderError) else ""
        raise DerenderError(f"this is no {what.removeprefix('the ')}{why}", path, remedy) from fault


MAGIC: tuple[tuple[bytes, str, Callable[[bytes], Decoded]], ...] = (
    (b"\x89PNG", ".png", _decode_picture),
    (b"II*\x00", ".tiff", _decode_picture),
    (b"MM\x00*", ".tiff", _decode_picture),
    (b"II+\x00", ".tiff", _decode_picture),
    (b"\x93NUMPY", ".npy", lambda data: Decoded(_load_npy(data))),
    (b"PK\x03\x04", ".npz", decode_npz),
    (b"v/1\x01", ".exr", lambda data: Decoded(decode_exr(data))),
)
