"""Where the scene stands before the camera: fixed, free in six coordinates, or looked at from somewhere."""

import math
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from derender.scene.distributions import Distribution
from derender.scene.pose import from_quaternion, quaternion, rotation_x, rotation_z, translation
from derender.scene.priors.values import QUATERNION, SAME, Value, draw, log_density


class RootPrior(Protocol):
    """Prior on the root's pose (4, 4), root to camera."""

    def sample(self, rng: np.random.Generator) -> np.ndarray: ...

    def log_density(self, pose: np.ndarray) -> float: ...

    def free_addresses(self) -> dict[str, Distribution]: ...

    def values(self, pose: np.ndarray) -> dict[str, Any]:
        """Return the coordinates of a pose by address, free and fixed ones."""
        ...

    def pose(self, values: Mapping[str, Any]) -> np.ndarray:
        """Return the pose of coordinates by address; those not given are the fixed ones."""
        ...


def written(pose: np.ndarray) -> np.ndarray:
    """Return a pose within rounding of `pose` that survives a quaternion bit for bit, so that a file can hold it."""
    for _ in range(30):
        again = from_quaternion(quaternion(pose), pose[:3, 3])
        if np.array_equal(again, pose):
            break
        pose = again
    return pose


class FixedRoot:
    """One pose, (4, 4)."""

    def __init__(self, pose: np.ndarray) -> None:
        self._pose = np.array(pose, dtype=float)

    def sample(self, rng: np.random.Generator) -> np.ndarray:
        return self._pose.copy()

    def log_density(self, pose: np.ndarray) -> float:
        return 0.0 if np.abs(pose - self._pose).max() <= SAME else -math.inf

    def free_addresses(self) -> dict[str, Distribution]:
        return {}

    def values(self, pose: np.ndarray) -> dict[str, Any]:
        return {}

    def pose(self, values: Mapping[str, Any]) -> np.ndarray:
        return self._pose.copy()


class FreeRoot:
    """Position x, y, z (metres, numbers or distributions) and a rotation (a quaternion, or uniform over all).

    Parameters
    ----------
    position : three values.
    rotation : (4,) unit quaternion (w, x, y, z), or the distribution uniform-rotation.
    """

    def __init__(self, position: tuple[Value, Value, Value], rotation: tuple[float, ...] | Distribution) -> None:
        self._position = position
        self._rotation = rotation

    def sample(self, rng: np.random.Generator) -> np.ndarray:
        position = [draw(value, rng) for value in self._position]
        rotation = self._rotation if isinstance(self._rotation, tuple) else self._rotation.sample(rng)
        return written(from_quaternion(rotation, position))

    def log_density(self, pose: np.ndarray) -> float:
        total = sum(log_density(value, x) for value, x in zip(self._position, pose[:3, 3].tolist(), strict=True))
        if isinstance(self._rotation, tuple):
            if np.abs(pose[:3, :3] - from_quaternion(self._rotation)[:3, :3]).max() > SAME:
                return -math.inf
        return total

    def free_addresses(self) -> dict[str, Distribution]:
        free = {f"root.{k}": v for k, v in zip("xyz", self._position, strict=True) if isinstance(v, Distribution)}
        if isinstance(self._rotation, Distribution):
            free[f"root.{QUATERNION}"] = self._rotation
        return free

    def values(self, pose):
        values = {f"root.{k}": float(x) for k, x in zip("xyz", pose[:3, 3], strict=True)}
        values[f"root.{QUATERNION}"] = tuple(quaternion(pose).tolist())
        return values

    def pose(self, values: Mapping[str, Any]) -> np.ndarray:
        position = [values.get(f"root.{k}", v) for k, v in zip("xyz", self._position, strict=True)]
        return from_quaternion(values.get(f"root.{QUATERNION}", self._rotation), position)


class LookedAtRoot:
    """The camera looks at the root's origin from a distance, `elevation` above the root's horizontal plane.

    With z_root up, camera to root is pose = Rz(roll) T(0, 0, distance) Rx(pi/2 + elevation) Rz(azimuth): at azimuth 0
    the root's x points to the right of the image and its y away from the camera.

    Parameters
    ----------
    distance : metres, positive.  elevation, azimuth, roll : radians.  Each a number or a distribution.
    """

    KEYS = ("distance", "elevation", "azimuth", "roll")

    def __init__(self, distance: Value, elevation: Value, azimuth: Value = 0.0, roll: Value = 0.0) -> None:
        self._parts: tuple[Value, ...] = (distance, elevation, azimuth, roll)

    def sample(self, rng: np.random.Generator | None) -> np.ndarray:
        parts = {f"root.{key}": draw(value, rng) for key, value in zip(self.KEYS, self._parts, strict=True)}
        return written(self.pose(parts))

    def log_density(self, pose: np.ndarray) -> float:
        if abs(pose[0, 3]) > SAME or abs(pose[1, 3]) > SAME or pose[2, 3] <= 0:
            return -math.inf
        coordinates = self._coordinates(pose)
        total = 0.0
        for value, x, key in zip(self._parts, coordinates, self.KEYS, strict=True):
            total += log_density(value, x if key in ("distance", "elevation") else _turned(x, value))
        return total

    def _coordinates(self, pose: np.ndarray) -> tuple[float, float, float, float]:
        """Return distance, elevation in [-pi/2, pi/2], azimuth and roll: a z-x-z Euler triple of the rotation."""
        elevation = math.asin(min(max(-pose[2, 2], -1.0), 1.0))
        roll = math.atan2(pose[0, 2], -pose[1, 2])
        azimuth = math.atan2(pose[2, 0], pose[2, 1])
        return pose[2, 3], elevation, azimuth, roll

    def free_addresses(self) -> dict[str, Distribution]:
        pairs = zip(self.KEYS, self._parts, strict=True)
        return {f"root.{key}": value for key, value in pairs if isinstance(value, Distribution)}

    def values(self, pose: np.ndarray) -> dict[str, Any]:
        pairs = zip(self.KEYS, self._coordinates(pose), self._parts, strict=True)
        return {f"root.{k}": x if k in ("distance", "elevation") else _turned(x, v) for k, x, v in pairs}

    def pose(self, values: Mapping[str, Any]) -> np.ndarray:
        pairs = zip(self.KEYS, self._parts, strict=True)
        distance, elevation, azimuth, roll = (values.get(f"root.{key}", value) for key, value in pairs)
        return (
            rotation_z(roll) @ translation(0, 0, distance) @ rotation_x(math.pi / 2 + elevation) @ rotation_z(azimuth)
        )


def _turned(angle: float, value: Value) -> float:
    """Return an angle by whole turns as near as can be to the middle of a value's range."""
    if isinstance(value, float):
        middle = value
    else:
        low, high = value.support
        middle = 0.5 * (low + high) if math.isfinite(low) and math.isfinite(high) else value.mean()
    return float(angle + 2 * math.pi * round((middle - angle) / (2 * math.pi)))
