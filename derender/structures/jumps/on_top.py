"""Where a box stands on the opposite face of another's foot: as numbers that are zero where their axes agree."""

import math

import numpy as np

from derender.scene.pose import from_rotation_vector, inverse, quaternion, rotation_vector, rotation_z
from derender.scene.shapes.base import box_face


def opposite(face: str) -> str:
    """Return the name of the opposite face."""
    return ("-" if face[0] == "+" else "+") + face[1]


def _frames(foot: str, low, high):
    """Return the lower's top face and the upper's foot as frames in their own axes."""
    return box_face(opposite(foot), low).frame, box_face(foot, high).frame


def on_top(foot, low, high, place):
    """Return the (4, 4) pose of the upper box in the lower's axes: aligned at place zero."""
    x, y, gap, theta, *tilt = place
    top, bottom = _frames(foot, low, high)
    shift = np.eye(4)
    shift[:3, 3] = x, y, gap
    turn = rotation_z(theta) @ from_rotation_vector((*tilt, 0.0))
    return top @ shift @ turn @ _straight(foot) @ inverse(bottom)


def _straight(foot):
    """Return the rotation between the two faces at which the boxes' axes agree: FLIP, turned about the normal."""
    top, bottom = _frames(foot, np.ones(3), np.ones(3))
    straight = np.eye(4)
    straight[:3, :3] = np.round(top[:3, :3].T @ bottom[:3, :3])
    return straight


def read_on_top(foot, low, high, relative):
    """Return `place` of the upper box's (4, 4) pose in the lower's axes: the inverse of `on_top`."""
    top, bottom = _frames(foot, low, high)
    meeting = inverse(top) @ relative @ bottom @ inverse(_straight(foot))
    w, _, _, z = quaternion(meeting)
    theta = math.remainder(2.0 * math.atan2(z, w), math.tau)
    tilt = rotation_vector(rotation_z(-theta)[:3, :3] @ meeting[:3, :3])
    x, y, gap = (float(part) for part in meeting[:3, 3])
    return x, y, gap, theta, float(tilt[0]), float(tilt[1])


def twist(rotation, k):
    """Return the angle, without sign, of a rotation's twist about the axis k."""
    i, j = (k + 1) % 3, (k + 2) % 3
    return abs(math.atan2(rotation[j, i] - rotation[i, j], rotation[i, i] + rotation[j, j]))
