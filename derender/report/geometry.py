"""Solids as triangles, for viewers and exports, and the scene turned upright: z up, as other programs have it."""

import numpy as np

from derender.scene import solids as kinds
from derender.scene.graph import SceneGraph
from derender.scene.pose import inverse, upright_frame
from derender.scene.shapes.kinds import box_mesh
from derender.scene.solids import Solids

SECTIONS = 48


def revolved(profile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of a profile (K, 2) of (radius, z), foot and tip on the axis, turned about z."""
    angle = 2 * np.pi * np.arange(SECTIONS) / SECTIONS
    rings = [np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(SECTIONS, z)]) for r, z in profile[1:-1]]
    vertices = np.vstack([*rings, [[0, 0, profile[0, 1]], [0, 0, profile[-1, 1]]]])
    i, last, foot = np.arange(SECTIONS), (len(rings) - 1) * SECTIONS, len(rings) * SECTIONS
    j = (i + 1) % SECTIONS
    triangles = [(j, i, np.full_like(i, foot)), (i + last, j + last, np.full_like(i, foot + 1))]
    for row in range(0, last, SECTIONS):
        up = row + SECTIONS
        triangles += [(i + row, j + row, j + up), (i + row, j + up, i + up)]
    return vertices, np.hstack(triangles).T.astype(np.int32)


POLAR = np.linspace(-0.5 * np.pi, 0.5 * np.pi, SECTIONS // 2 + 1)
PROFILES = {  # of solids of size 1
    kinds.CYLINDER: np.array([[0, -0.5], [0.5, -0.5], [0.5, 0.5], [0, 0.5]]),
    kinds.SPHERE: 0.5 * np.column_stack([np.cos(POLAR), np.sin(POLAR)]),
}


def solid_mesh(solids: Solids, index: int, points: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3), metres, and triangles (T, 3), counter-clockwise from outside, of a solid in its own axes.

    Of a plane they are a square, see `plane_patch`.
    """
    kind, size = int(solids.kind[index]), solids.size[index]
    if kind == kinds.PLANE:
        patch, half = plane_patch(solids, index, points)
        square = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
        offset = (patch[:3, 3] - solids.pose[index, :3, 3]) @ solids.pose[index, :3, :3]
        return square + offset, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    if kind in PROFILES:
        vertices, triangles = revolved(PROFILES[kind])
        return vertices * size, triangles
    if kind == kinds.MESH:
        vertices, triangles = solids.meshes[int(solids.mesh[index])]
        return vertices * (size / np.ptp(vertices, axis=0)), triangles
    return box_mesh(size)


def plane_patch(solids: Solids, index: int, points: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """Return the pose (4, 4) of the middle of a plane's square that is under the whole scene, and half its side.

    points : (P, 3) float64 that the square should reach under, in the solids' frame; default: the other solids.
    """
    pose = solids.pose[index].copy()
    others = solids.pose[solids.kind != kinds.PLANE, :3, 3]
    sizes = solids.size[solids.kind != kinds.PLANE]
    seen = others if points is None or not len(points) else np.vstack([others, points])
    if not len(seen):
        return pose, 0.5
    local = (seen - pose[:3, 3]) @ pose[:3, :3]
    middle = 0.5 * (local[:, :2].min(axis=0) + local[:, :2].max(axis=0))
    half = float(np.max(np.abs(local[:, :2] - middle))) + (float(sizes.max()) if len(sizes) else 0.0)
    pose[:3, 3] += pose[:3, :2] @ middle
    return pose, max(half, 0.05)


def upright_pose(graph: SceneGraph) -> np.ndarray:
    """Return the (4, 4) pose, camera to world, of a world whose z is up and whose origin is on the floor.

    The origin is under the middle of the solids on the first plane (without a plane: under their middle at the height
    of the lowest origin), and x is the camera's x, level.
    """
    up = -graph.down()
    along = [1.0, 0.0, 0.0] if np.hypot(up[1], up[2]) > 1e-6 else [0.0, 0.0, 1.0]
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
    return inverse(upright_frame(up, along, middle - height * up))
