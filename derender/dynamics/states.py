"""States of rigid bodies and small changes of them.

A state is 13 numbers: position (3, metres), quaternion wxyz (4), velocity (3, m / s) and angular velocity (3, rad / s,
in the body's axes). A change has 12: the rotation's part is a rotation vector in the body's axes, R' = R exp(phi).
"""

import numpy as np

STATE, CHANGE = 13, 12


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the quaternion product of two arrays (..., 4), wxyz."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def exponential(vector: np.ndarray) -> np.ndarray:
    """Return the quaternions (..., 4) of rotation vectors (..., 3)."""
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * vector], axis=-1)


def turned_by(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (..., 3) in the first body's axes from quaternions `first` to `second` (..., 4)."""
    conjugate = first * np.array([1.0, -1.0, -1.0, -1.0])
    change = product(conjugate, second)
    change = np.where(change[..., :1] < 0, -change, change)
    sine = np.linalg.norm(change[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, change[..., :1])
    return np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0) * change[..., 1:]


def moved(states: np.ndarray, changes: np.ndarray) -> np.ndarray:
    """Return the states (..., 13) after changes (..., 12)."""
    result = states.copy()
    result[..., :3] += changes[..., :3]
    quaternions = product(states[..., 3:7], exponential(changes[..., 3:6]))
    result[..., 3:7] = quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)
    result[..., 7:] += changes[..., 6:]
    return result


def difference(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the changes (..., 12) that lead from states `first` to `second` (..., 13)."""
    turn = turned_by(first[..., 3:7], second[..., 3:7])
    return np.concatenate([second[..., :3] - first[..., :3], turn, second[..., 7:] - first[..., 7:]], axis=-1)


def from_poses(poses: np.ndarray) -> np.ndarray:
    """Return states (..., 13) at rest at poses (..., 4, 4)."""
    rotation = poses[..., :3, :3]
    trace = np.trace(rotation, axis1=-2, axis2=-1)
    diagonal = np.diagonal(rotation, axis1=-2, axis2=-1)
    # All four of Shepperd's (1978) solutions, of which the one with the greatest divisor is exact.
    r = np.moveaxis(rotation, (-2, -1), (0, 1))
    squares = np.stack([1 + trace, *(1 + 2 * diagonal[..., k] - trace for k in range(3))], axis=-1)
    candidates = np.stack(
        [
            np.stack([squares[..., 0], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]], axis=-1),
            np.stack([r[2, 1] - r[1, 2], squares[..., 1], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]], axis=-1),
            np.stack([r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], squares[..., 2], r[1, 2] + r[2, 1]], axis=-1),
            np.stack([r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], squares[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(squares, axis=-1)[..., None, None]
    quaternions = np.take_along_axis(candidates, best, axis=-2)[..., 0, :]
    states = np.zeros((*poses.shape[:-2], STATE))
    states[..., :3] = poses[..., :3, 3]
    states[..., 3:7] = quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)
    return states


def to_poses(states: np.ndarray) -> np.ndarray:
    """Return the poses (..., 4, 4) of states (..., 13)."""
    w, x, y, z = np.moveaxis(states[..., 3:7], -1, 0)
    poses = np.zeros((*states.shape[:-1], 4, 4))
    poses[..., 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=-1)
    poses[..., 1, :3] = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=-1)
    poses[..., 2, :3] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    poses[..., :3, 3] = states[..., :3]
    poses[..., 3, 3] = 1.0
    return poses
