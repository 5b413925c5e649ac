"""How depth images are read: with which camera and unit, turned, without the pixels that the sensor itself doubts."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from derender.camera.depth_file import DepthImage, read_depth, turned
from derender.camera.depth_formats import MOST_BYTES
from derender.camera.image_files import read_bytes
from derender.camera.intrinsics import unit_vector
from derender.errors import DerenderError


@dataclass(frozen=True)
class Reading:
    """How depth images are read.

    Attributes
    ----------
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

    def read(self, path: str | Path) -> DepthImage:
        """Return the depth image of a file.

        Raises
        ------
        DerenderError : anything that makes the image, its camera or its confidence unusable.
        """
        seen = read_depth(path, self.camera, self.depth_scale, self.topic)
        if self.up is not None:
            down = [-number for number in direction(self.up)]
            seen = seen._replace(camera=replace(seen.camera, gravity=unit_vector(down, "--up")))
        if self.confidence is not None:
            seen = seen._replace(depth=without_doubtful(seen.depth, path, self.confidence, self.least_confidence))
        return turned(seen, self.rotate)


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
    values = _map(place)
    if values.shape != depth.shape:
        what = f"the map is {values.shape[1]} x {values.shape[0]} pixels, the image {depth.shape[1]} x {depth.shape[0]}"
        raise DerenderError(what, place, "give the map of this image")
    kept = np.where(values >= least, depth, np.nan)
    if not np.isfinite(kept).any():
        raise DerenderError(f"no pixel has a confidence of {least:g}", place, "give less with --least-confidence")
    return kept


def _map(path: Path) -> np.ndarray:
    """Return a map of confidence (H, W) from a .npy or a grey picture."""
    data = read_bytes(path, MOST_BYTES, "the confidence map", "check the path")
    try:
        if data.startswith(b"\x93NUMPY"):
            values = np.load(path, allow_pickle=False)
        else:
            import imageio.v3 as imageio

            values = imageio.imread(data)
    except (OSError, ValueError, SyntaxError) as error:
        raise DerenderError("not a map that derender knows", path, "give a grey .png or .tiff, or a .npy") from error
    if values.ndim == 3:
        values = values[..., 0]
    if values.ndim != 2:
        raise DerenderError("the map is no picture", path, "a map is height x width")
    return values
