"""Rigid poses as (4, 4) float64 arrays, child to parent. Quaternions are wxyz, angles radians, lengths metres."""

import math
from typing import Any

import numpy as np

from derender.compilation.cache import njit


def translation(x: float, y: float, z: float) -> np.ndarray:
    """Return the (4, 4) pose that shifts by (x, y, z) metres."""
    pose = np.eye(4)
    pose[0, 3], pose[1, 3], pose[2, 3] = x, y, z
    return pose


def rotation_x(angle: float) -> np.ndarray:
    """Return the (4, 4) right-handed rotation about x by `angle` radians."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0, 0, 0], [0, cosine, -sine, 0], [0, sine, cosine, 0], [0, 0, 0, 1.0]])


def rotation_y(angle: float) -> np.ndarray:
    """Return the (4, 4) right-handed rotation about y by `angle` radians."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, 0, sine, 0], [0, 1.0, 0, 0], [-sine, 0, cosine, 0], [0, 0, 0, 1.0]])


def rotation_z(angle: float) -> np.ndarray:
    """Return the (4, 4) right-handed rotation about z by `angle` radians."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, -sine, 0, 0], [sine, cosine, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]])


def from_axes(axes: Any, origin: Any = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the (4, 4) pose of a frame whose three axes and origin are given in the parent's coordinates."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.transpose(axes), origin
    return pose


def upright_frame(up: np.ndarray, along: Any = (1.0, 0.0, 0.0), origin: Any = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the (4, 4) pose of a frame whose z is the unit vector `up`, and x as near `along` as that lets it be."""
    x = along - np.dot(along, up) * up
    x /= np.linalg.norm(x)
    # up times x: np.cross took twice as long as all the rest
    y = up[1] * x[2] - up[2] * x[1], up[2] * x[0] - up[0] * x[2], up[0] * x[1] - up[1] * x[0]
    return from_axes((x, y, up), origin)


def inverse(pose: np.ndarray) -> np.ndarray:
    """Return the inverse of a (..., 4, 4) rigid pose (its rotation transposed, not a general matrix inverse)."""
    pose = np.asarray(pose, dtype=float)
    result = np.zeros_like(pose)
    transposed = np.swapaxes(pose[..., :3, :3], -1, -2)
    result[..., :3, :3] = transposed
    result[..., :3, 3] = -(transposed @ pose[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def from_quaternion(quat_wxyz: Any, position: Any = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the (4, 4) pose of a (4,) quaternion (w, x, y, z), normalised first, and a (3,) position.

    Raises ValueError for a quaternion of zero length.
    """
    quat = [float(part) for part in quat_wxyz]
    length = math.sqrt(sum(part * part for part in quat))
    if not 0.0 < length < math.inf:
        raise ValueError("a quaternion needs a finite length above zero")
    return from_axes(np.reshape(rotation_numbers(*(part / length for part in quat)), (3, 3)).T, position)


def rotation_numbers(w: float, x: float, y: float, z: float) -> tuple[float, ...]:
    """Return the nine numbers, row by row, of a unit quaternion's rotation: plain Python that numba compiles too."""
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


def quaternion(pose: np.ndarray) -> np.ndarray:
    """Return the (4,) unit quaternion (w, x, y, z), w >= 0, of a (4, 4) pose or (3, 3) rotation."""
    return np.array(quaternion_numbers(np.asarray(pose, dtype=float)))


def quaternion_numbers(r: np.ndarray) -> tuple[float, float, float, float]:
    """Return the same as four numbers: plain Python that numba compiles too.

    The largest of the four components is found first (Shepperd 1978), so no rotation loses precision.
    """
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    w, x, y, z = 1 + trace, 1 + 2 * r[0, 0] - trace, 1 + 2 * r[1, 1] - trace, 1 + 2 * r[2, 2] - trace
    if w >= x and w >= y and w >= z:
        x, y, z = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    elif x >= y and x >= z:
        w, y, z = r[2, 1] - r[1, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]
    elif y >= z:
        w, x, z = r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], r[1, 2] + r[2, 1]
    else:
        w, x, y = r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    norm = math.copysign(math.sqrt(w * w + x * x + y * y + z * z), w)
    return w / norm, x / norm, y / norm, z / norm


def from_rotation_vector(vector: Any) -> np.ndarray:
    """Return the (4, 4) rotation about `vector` (3,) by its length in radians (Rodrigues' formula)."""
    x, y, z = (float(part) for part in vector)
    angle = math.sqrt(x * x + y * y + z * z)
    half = 0.5 * angle
    scale = math.sin(half) / angle if angle > 0.0 else 0.5
    return from_quaternion((math.cos(half), scale * x, scale * y, scale * z))


def moved(pose: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return a (4, 4) pose after a shift and a turn (6,) about its origin, both in the parent's axes."""
    result = pose.copy()
    result[:3, :3] = from_rotation_vector(change[3:])[:3, :3] @ pose[:3, :3]
    result[:3, 3] += change[:3]
    return result


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """Return the (3,) rotation vector, of length at most pi, of a (4, 4) pose or (3, 3) rotation."""
    quat = quaternion(rotation)
    sine = math.sqrt(quat[1] ** 2 + quat[2] ** 2 + quat[3] ** 2)
    scale = 2.0 * math.atan2(sine, quat[0]) / sine if sine > 0.0 else 2.0
    return scale * quat[1:]


def twist_exp(v: list[float] | np.ndarray, w: list[float] | np.ndarray) -> np.ndarray:
    """Return the (4, 4) exponential of the twist with linear part `v` (3,) and angular part `w` (3,).

    The rotation is that of `w`; the shift is V v with V = I + (1 - cos a)/a^2 [w] + (a - sin a)/a^3 [w]^2, a = |w|.
    """
    v, w = np.asarray(v, dtype=float), np.asarray(w, dtype=float)
    pose = from_rotation_vector(w)
    angle = math.sqrt(w @ w)
    if angle < 1e-4:  # the series' next terms are below 1e-17 here; the closed form would cancel
        first, second = 0.5 - angle**2 / 24, 1 / 6 - angle**2 / 120
    else:
        first, second = (1 - math.cos(angle)) / angle**2, (angle - math.sin(angle)) / angle**3
    turned = np.cross(w, v)
    pose[:3, 3] = v + first * turned + second * np.cross(w, turned)
    return pose


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Return a (4, 4) rotation drawn uniformly (Haar measure): a normalised normal quaternion."""
    return from_quaternion(rng.standard_normal(4))


def rotation_angle(first: np.ndarray, second: np.ndarray) -> float:
    """Return the angle in [0, pi] of the rotation from `first` to `second`, both (4, 4) or (3, 3)."""
    relative = np.asarray(first)[:3, :3].T @ np.asarray(second)[:3, :3]
    return float(np.linalg.norm(rotation_vector(relative)))


@njit(cache=True, nogil=True, borrows=True)
def compose(first, second, out):
    """Write the product of two rigid (4, 4) poses into `out`, which must be another array."""
    for i in range(3):
        for j in range(3):
            out[i, j] = first[i, 0] * second[0, j] + first[i, 1] * second[1, j] + first[i, 2] * second[2, j]
        out[i, 3] = first[i, 0] * second[0, 3] + first[i, 1] * second[1, 3] + first[i, 2] * second[2, 3] + first[i, 3]
    out[3, 0], out[3, 1], out[3, 2], out[3, 3] = 0.0, 0.0, 0.0, 1.0


@njit(cache=True, nogil=True, borrows=True)
def copy_placed(pose, size, to_pose, to_size):
    """Write where a solid is, (4, 4), and its extents (3,), without what numba compiles for assigning arrays."""
    for i in range(4):
        for j in range(4):
            to_pose[i, j] = pose[i, j]
    for i in range(3):
        to_size[i] = size[i]
