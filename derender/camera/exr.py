"""OpenEXR images with one channel of depth, through the OpenEXR package, which only reads and writes named files."""

import tempfile
from pathlib import Path

import numpy as np

from derender.camera.silence import silence
from derender.errors import DerenderError

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
