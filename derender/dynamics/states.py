"""States of rigid bodies and small changes of them; how a body may move that lies flush on a plane.

A state is 13 numbers: position (3, metres), quaternion wxyz (4), velocity (3, m / s) and angular velocity (3, rad / s,
in the body's axes). A change has 12: the rotation's part is a rotation vector in the body's axes, R' = R exp(phi).

A tracked pose is off by a millimetre and a degree. The engine would drop a box from there or throw it up, and friction
would act only now and then: so what is seen to lie on a plane begins flush with it, and stays so under changes.
"""

import numpy as np

from derender.physics.bodies import Body
from derender.scene.pose import from_quaternion, inverse, quaternion

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


# A body lies on a plane where for so many frames no corner of its lower face is off by more than this: metres, and
# radians between that face and the plane. Tracking is off by half as much.
LEVEL_FRAMES, OFF_METRES, OFF_RADIANS = 3, 0.005, 0.07
FREE = np.eye(CHANGE)


def flush(body: Body, plane: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return the state (13,) flush with a plane and not leaving it, and by how much it was off: metres and radians.

    body : box, cylinder or mesh by its box; nothing else has a face to lie on.
    plane : (4, 4), its frame, z along its normal.
    """
    normal, pose = plane[:3, 2], to_poses(state)
    along = normal @ pose[:3, :3]  # the normal in the body's axes
    axis = int(np.argmax(np.abs(along)))
    if body.kind == "cylinder":
        axis = 2
    wanted = np.zeros(3)
    wanted[axis] = np.sign(along[axis])
    cross = np.cross(wanted, along)  # turns the face's normal to the plane's, in the body's axes
    angle = float(np.arctan2(np.linalg.norm(cross), along @ wanted))
    turn = cross * (angle / max(float(np.linalg.norm(cross)), 1e-12))
    result = state.copy()
    result[3:7] = product(state[3:7], exponential(turn))
    height = float((inverse(plane) @ pose)[2, 3])
    off = height - body.size[axis] / 2
    result[:3] -= off * normal
    result[7:10] -= (state[7:10] @ normal) * normal
    result[10:] = (state[10:] @ wanted) * wanted
    return result, abs(off), angle


def ways_of(plane: np.ndarray, state: np.ndarray) -> np.ndarray:
    """Return the changes (12, 6) under which a flush state (13,) stays flush: two shifts, a turn, and their rates."""
    turn = to_poses(state)[:3, :3].T @ plane[:3, 2]
    ways = np.zeros((CHANGE, 6))
    for part, column in ((0, 0), (6, 3)):
        ways[part : part + 3, column : column + 2] = plane[:3, :2]
        ways[part + 3 : part + 6, column + 2] = turn
    return ways


def plane_under(body: Body, planes: list[np.ndarray], states: np.ndarray) -> np.ndarray | None:
    """Return the plane (4, 4) on which a body lies in its next states (T, 13), or None."""
    if body.kind not in ("box", "cylinder", "mesh") or len(states) < LEVEL_FRAMES:
        return None
    for plane in planes:
        off = [flush(body, plane, state)[1:] for state in states[:LEVEL_FRAMES]]
        if np.all(np.array(off) < [OFF_METRES, OFF_RADIANS]):
            return plane
    return None
