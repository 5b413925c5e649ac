"""Scenes with the z axis up: other programs do not think in a camera's axes."""

from typing import TYPE_CHECKING

import numpy as np

from derender.scene import solids as kinds
from derender.scene.pose import from_axes, inverse

if TYPE_CHECKING:
    from derender.scene.graph import SceneGraph


def upright_pose(graph: "SceneGraph") -> np.ndarray:
    """Return the (4, 4) pose, camera to world, of a world whose z is up and whose origin is on the floor.

    The origin is under the middle of the solids on the first plane (without a plane: under their middle at the height
    of the lowest origin), and x is the camera's x, level.
    """
    up = -graph.down()
    right = np.array([1.0, 0.0, 0.0]) - up * up[0]
    if np.linalg.norm(right) < 1e-6:
        right = np.array([0.0, 0.0, 1.0]) - up * up[2]
    right /= np.linalg.norm(right)
    solids = graph.solids()
    extended = solids.kind != kinds.PLANE
    centres = solids.pose[extended, :3, 3]
    middle = centres.mean(axis=0) if len(centres) else np.zeros(3)
    planes = solids.pose[~extended]
    if len(planes) and abs(planes[0, :3, 2] @ up) > 0.1:
        normal = planes[0, :3, 2]
        height = normal @ (middle - planes[0, :3, 3]) / (normal @ up)
    else:
        height = max(((middle - centre) @ up for centre in centres), default=0.0)
    return inverse(from_axes(right, np.cross(up, right), up, middle - height * up))
