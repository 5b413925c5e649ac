"""States of rigid bodies and small changes of them.

A state is 13 numbers: position (3, metres), quaternion wxyz (4), velocity (3, m / s) and angular velocity (3, rad / s,
in the body's axes). A change has 12: the rotation's part is a rotation vector in the body's axes, R' = R exp(phi).
"""

import numpy as np

from derender.scene.pose import from_quaternion, quaternion

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
    states = np.zeros((*poses.shape[:-2], STATE))
    states[..., :3] = poses[..., :3, 3]
    for index in np.ndindex(poses.shape[:-2]):
        states[(*index, slice(3, 7))] = quaternion(poses[index])
    return states


def to_poses(states: np.ndarray) -> np.ndarray:
    """Return the poses (..., 4, 4) of states (..., 13)."""
    poses = np.empty((*states.shape[:-1], 4, 4))
    for index in np.ndindex(states.shape[:-1]):
        poses[index] = from_quaternion(states[index][3:7], states[index][:3])
    return poses
