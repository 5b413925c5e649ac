"""Image files: their bytes, PNG written by zlib alone, OpenEXR with one channel of depth; decoders kept quiet."""

import contextlib
import io
import logging
import os
import struct
import sys
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from derender.errors import DerenderError


def read_bytes(path: str | Path, most: int, what: str, remedy: str) -> bytes:
    """Return the bytes of a file, `-` for stdin.

    Raises
    ------
    DerenderError : it cannot be read (`what` says of it what it is, `remedy` what to do), has more than `most` bytes,
        or none.
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


GREY, COLOUR = 0, 2  # colour types of the format


def png_bytes(pixels: np.ndarray) -> bytes:
    """Return a PNG file of pixels: (height, width, 3) uint8, or (height, width) uint16 as 16-bit grey."""
    height, width = pixels.shape[:2]
    colour = GREY if pixels.ndim == 2 else COLOUR
    lines = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder(">"))).view(np.uint8).reshape(height, -1)
    rows = np.zeros((height, 1 + lines.shape[1]), dtype=np.uint8)  # each begins with its filter: none
    rows[:, 1:] = lines

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8 * pixels.dtype.itemsize, colour, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


DEPTH_NAMES = ("Z", "depth", "Depth", "V", "Y", "R")  # the renderers' names for it, the surest first


def decode_exr(data: bytes) -> np.ndarray:
    """Return the (height, width) depth channel of an .exr: the only channel, or the one that is named like depth.

    Raises
    ------
    DerenderError : a colour image, or no channel that could be depth.
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
