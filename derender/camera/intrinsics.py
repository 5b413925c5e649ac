"""The pinhole camera.

The axes are OpenCV's (x right, y down, z forward) and the centre of pixel (column i, row j) is at image coordinates
(i, j), as in BOP, RealSense and ROS; any other convention lives inside the renderer or reader that needs it.
"""

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.registry import only_its_keywords

FALLBACK_FIELD_OF_VIEW = 60.0  # degrees, horizontal: between a Kinect's 57 and a RealSense D435's 69
MOST_PIXELS = 2**28
# Cosine of the most by which a level plane leans against gravity: an accelerometer's error, and a fitted plane's.
LEVEL = math.cos(math.radians(12.0))


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion.

    fx, fy : focal lengths in pixels, positive.
    cx, cy : principal point in pixels; the centre of the first pixel is (0, 0).
    width, height : of the image, in pixels.
    depth_scale : millimetres that one unit of a 16-bit depth image stands for (BOP's meaning).
    gravity : direction in which things fall, (3,) in camera axes (x right, y down, z forward), of length 1; None where
        nobody measured it.

    Raises DerenderError : a number that no camera has.

    >>> from derender import Camera
    >>> camera = Camera(fx=150, fy=150, cx=79.5, cy=59.5, width=160, height=120)
    >>> Camera.from_matrix(camera.matrix, 160, 120) == camera
    True
    >>> Camera.from_matrix(camera.matrix, 160, 120, gravity=(0, 2, 0)).gravity  # y points down: an upright camera
    (0.0, 1.0, 0.0)
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    depth_scale: float = 1.0
    gravity: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        for name in ("fx", "fy", "cx", "cy", "depth_scale"):
            object.__setattr__(self, name, finite_number(getattr(self, name), name))
        for name in ("width", "height"):
            value = finite_number(getattr(self, name), name)
            if value != int(value) or value < 1:
                raise DerenderError(f"{name} is {value:g}", "camera", "give a whole number of pixels, at least 1")
            object.__setattr__(self, name, int(value))
        for name in ("fx", "fy", "depth_scale"):
            if getattr(self, name) <= 0:
                raise DerenderError(f"{name} is {getattr(self, name):g}", "camera", "give a positive number")
        if self.gravity is not None:
            object.__setattr__(self, "gravity", unit_vector(self.gravity, "gravity"))
        if self.width * self.height > MOST_PIXELS:
            raise DerenderError(f"an image of {self.width} x {self.height} pixels is too large", "camera")

    @classmethod
    @only_its_keywords
    def from_field_of_view(cls, width: int, height: int, degrees: float = FALLBACK_FIELD_OF_VIEW) -> "Camera":
        """Return a camera with square pixels, a centred principal point and this horizontal field of view."""
        if not 0.0 < degrees < 180.0:
            raise DerenderError(f"a field of view of {degrees:g} degrees", "camera", "give more than 0, less than 180")
        focal = width / (2 * math.tan(math.radians(degrees) / 2))
        return cls(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)

    @classmethod
    def from_matrix(cls, matrix: np.ndarray, width: int, height: int, **more: Any) -> "Camera":
        """Return the camera of a matrix of intrinsics (3, 3), row-major: fx, 0, cx; 0, fy, cy; 0, 0, 1.

        more : depth_scale and gravity.
        """
        return cls(**from_matrix(np.asarray(matrix), "the matrix"), width=width, height=height, **more)

    @classmethod
    @only_its_keywords
    def from_file(cls, path: str | Path, shape: tuple[int, int] | None = None) -> "Camera":
        """Return the camera of a file of any known format; shape : (height, width) where the file does not say it."""
        from derender.camera.camera_file import read_camera

        return read_camera(path, shape)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width): the shape of its depth arrays."""
        return self.height, self.width

    @property
    def matrix(self) -> np.ndarray:
        """(3, 3) float64, the intrinsic matrix K: (i, j, 1) is proportional to K p."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def field_of_view(self) -> float:
        """Horizontal field of view in degrees, for a principal point in the middle."""
        return math.degrees(2 * math.atan(self.width / (2 * self.fx)))

    def rays(self) -> np.ndarray:
        """Return (height, width, 3) float64, the ray of each pixel with z = 1; the point at depth z is z times it."""
        rays = np.ones((self.height, self.width, 3))
        rays[..., 0] = (np.arange(self.width) - self.cx) / self.fx
        rays[..., 1] = ((np.arange(self.height) - self.cy) / self.fy)[:, None]
        return rays

    def points(self, depth: np.ndarray) -> np.ndarray:
        """Return (height, width, 3), the point of each pixel of a (height, width) depth image; NaN stays NaN."""
        return self.rays() * np.asarray(depth)[..., None]

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return (..., 2), the image coordinates (column, row) of (..., 3) points in front of the camera."""
        points = np.asarray(points, dtype=float)
        return points[..., :2] / points[..., 2:] * (self.fx, self.fy) + (self.cx, self.cy)

    def downscaled(self, factor: float) -> "Camera":
        """Return the camera whose pixels are blocks of factor x factor of this one's; a rest at the edge is cut off.

        factor : 1 / n makes n x n samples of each pixel, whose mean is the pixel.
        """
        offset = (factor - 1) / 2
        width, height = (int(pixels / factor + 1e-9) for pixels in (self.width, self.height))  # 160 / (1 / 5) < 800
        cx, cy = ((centre - offset) / factor for centre in (self.cx, self.cy))
        return replace(self, fx=self.fx / factor, fy=self.fy / factor, cx=cx, cy=cy, width=width, height=height)

    def to_dict(self) -> dict[str, Any]:
        """Return the keys of a BOP camera.json, and `gravity` where it is known."""
        known = asdict(self)
        gravity = known.pop("gravity")
        return known if gravity is None else known | {"gravity": list(gravity)}


def finite_number(value: object, name: str) -> float:
    """Return a finite number of a camera, which may be text; `name` is its own."""
    try:
        if isinstance(value, bool):
            raise TypeError
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise DerenderError(f"{name} is {str(value)[:40]!r}", "camera", "give a number") from None
    if not math.isfinite(number):
        raise DerenderError(f"{name} is {number}", "camera", "give a finite number")
    return number


def unit_vector(value: Any, name: str) -> tuple[float, float, float]:
    """Return three finite numbers as a vector of length 1; `name` is its own."""
    if isinstance(value, dict):
        value = [value.get(axis) for axis in "xyz"]
    try:
        numbers = [finite_number(part, name) for part in value]
    except TypeError:
        numbers = []
    length = math.hypot(*numbers)
    if len(numbers) != 3 or length < 1e-9:
        remedy = "give three numbers: the direction of fall, x right, y down, z forward"
        raise DerenderError(f"{name} is no direction", "camera", remedy)
    x, y, z = (number / length for number in numbers)
    return x, y, z


def numbers_in(value: object, name: str, count: int | None = None) -> np.ndarray:
    """Return the flat numbers of a list, of a list of rows, or of ROS's {rows, cols, data}."""
    if isinstance(value, dict):
        value = value.get("data")
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, list | tuple) or len(value) > 100:
        raise DerenderError(f"{name} is not a list of numbers", "camera")
    rows = [item if isinstance(item, list | tuple) and len(item) <= 100 else [item] for item in value]
    numbers = np.array([finite_number(leaf, name) for row in rows for leaf in row])
    if count is not None and len(numbers) != count:
        raise DerenderError(f"{name} has {len(numbers)} numbers", "camera", f"it needs {count}")
    return numbers


def from_matrix(value: object, name: str) -> dict[str, Any]:
    """Return fx, fy, cx, cy of a row-major intrinsic matrix."""
    matrix = numbers_in(value, name, 9).reshape(3, 3)
    with np.errstate(over="ignore"):  # what is infinite then is told
        matrix = matrix / matrix[2, 2] if matrix[2, 2] else matrix
    if matrix[2, 0] or matrix[2, 1] or matrix[1, 0] or not matrix[2, 2]:
        remedy = "its last row is 0, 0, 1: check whether it is row-major (Open3D's is column-major)"
        raise DerenderError(f"{name} is not an intrinsic matrix", "camera", remedy)
    if abs(matrix[0, 1]) > 1e-6 * abs(matrix[0, 0]):
        raise DerenderError(f"{name} has skew {matrix[0, 1]:g}", "camera", "rectify first")
    return {"fx": matrix[0, 0], "fy": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2]}
