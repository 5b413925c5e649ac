"""States of rigid bodies and small changes of them; how a body may move that lies flush on a plane.

A state is 13 numbers: position (3, metres), quaternion wxyz (4), velocity (3, m / s) and angular velocity (3, rad / s,
in the body's axes). A change has 12: the rotation's part is a rotation vector in the body's axes, R' = R exp(phi).

A tracked pose is off by a millimetre and a degree. The engine would drop a box from there or throw it up, and friction
would act only now and then: so what is seen to lie on a plane begins flush with it, and stays so under changes.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from derender.physics.bodies import Body
from derender.scene.pose import inverse

STATE, CHANGE = 13, 12


def rotations(states: np.ndarray) -> Rotation:
    """Return the rotations of states (..., 13) in a row."""
    return Rotation.from_quat(np.roll(states[..., 3:7], -1, axis=-1).reshape(-1, 4))


def written(turns: Rotation, states: np.ndarray) -> np.ndarray:
    """Write rotations in a row into states (..., 13), and return these."""
    states[..., 3:7] = np.roll(turns.as_quat(), 1, axis=-1).reshape(*states.shape[:-1], 4)
    return states


def moved(states: np.ndarray, changes: np.ndarray) -> np.ndarray:
    """Return the states (..., 13) after changes (..., 12)."""
    result = states.copy()
    result[..., :3] += changes[..., :3]
    result[..., 7:] += changes[..., 6:]
    return written(rotations(states) * Rotation.from_rotvec(changes[..., 3:6].reshape(-1, 3)), result)


def difference(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the changes (..., 12) that lead from states `first` to `second` (..., 13)."""
    turn = (rotations(first).inv() * rotations(second)).as_rotvec().reshape(*second.shape[:-1], 3)
    return np.concatenate([second[..., :3] - first[..., :3], turn, second[..., 7:] - first[..., 7:]], axis=-1)


def from_poses(poses: np.ndarray) -> np.ndarray:
    """Return states (..., 13) at rest at poses (..., 4, 4)."""
    states = np.zeros((*poses.shape[:-2], STATE))
    states[..., :3] = poses[..., :3, 3]
    return written(Rotation.from_matrix(poses[..., :3, :3].reshape(-1, 3, 3)), states)


def unturned(states: np.ndarray) -> np.ndarray:
    """Return states (..., 13) of balls whose own axes are those of the frame: nothing tells how a ball is turned, and
    a spin about axes that nobody knows would be none."""
    result = states.copy()
    result[..., 10:] = rotations(states).apply(states[..., 10:].reshape(-1, 3)).reshape(states[..., 10:].shape)
    result[..., 3:7] = 1.0, 0.0, 0.0, 0.0
    return result


def to_poses(states: np.ndarray) -> np.ndarray:
    """Return the poses (..., 4, 4) of states (..., 13)."""
    poses = np.tile(np.eye(4), (*states.shape[:-1], 1, 1))
    poses[..., :3, 3] = states[..., :3]
    poses[..., :3, :3] = rotations(states).as_matrix().reshape(*states.shape[:-1], 3, 3)
    return poses


# A body lies on a plane where for so many frames no corner of its lower face is off by more than this: metres, and
# radians between that face and the plane. Tracking is off by half as much.
LEVEL_FRAMES, OFF_METRES, OFF_RADIANS = 3, 0.005, 0.07
FREE = np.eye(CHANGE)
FREE_BALL = np.delete(FREE, [3, 4, 5], axis=1)  # see `unturned`


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
    result = moved(state, np.concatenate([np.zeros(3), turn, np.zeros(6)]))
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
