"""Solids as triangles, for viewers and exports, and the scene turned upright: z up, as other programs have it."""

from typing import TYPE_CHECKING

import numpy as np

from derender.scene import solids as kinds
from derender.scene.pose import from_axes, inverse
from derender.scene.shapes.box import box_mesh
from derender.scene.solids import Solids

SECTIONS = 48


def cylinder_mesh(size: np.ndarray, sections: int = SECTIONS) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of a cylinder along z about the origin."""
    angle = 2 * np.pi * np.arange(sections) / sections
    ring = np.column_stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), np.zeros(sections)])
    vertices = np.vstack([ring - [0, 0, 0.5], ring + [0, 0, 0.5], [[0, 0, -0.5], [0, 0, 0.5]]])
    i = np.arange(sections)
    j = (i + 1) % sections
    n = sections
    triangles = np.vstack(
        [
            np.column_stack([i, j, j + n]),
            np.column_stack([i, j + n, i + n]),
            np.column_stack([j, i, np.full(n, 2 * n)]),
            np.column_stack([i + n, j + n, np.full(n, 2 * n + 1)]),
        ]
    )
    return vertices * size, triangles.astype(np.int32)


def sphere_mesh(size: np.ndarray, sections: int = SECTIONS) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of a sphere about the origin, by circles of latitude."""
    rows = sections // 2
    polar = np.pi * np.arange(1, rows) / rows
    angle = 2 * np.pi * np.arange(sections) / sections
    p, a = np.meshgrid(polar, angle, indexing="ij")
    ring = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1).reshape(-1, 3)
    vertices = 0.5 * np.vstack([ring, [[0, 0, 1], [0, 0, -1]]])
    top, bottom = len(ring), len(ring) + 1
    triangles = []
    i = np.arange(sections)
    j = (i + 1) % sections
    for row in range(rows - 2):
        upper, lower = row * sections, (row + 1) * sections
        triangles += [
            np.column_stack([upper + i, lower + i, lower + j]),
            np.column_stack([upper + i, lower + j, upper + j]),
        ]
    triangles.append(np.column_stack([np.full(sections, top), i, j]))
    last = (rows - 2) * sections
    triangles.append(np.column_stack([np.full(sections, bottom), last + j, last + i]))
    return vertices * size, np.vstack(triangles).astype(np.int32)


def plane_mesh(extent: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of a square of the plane z = 0, `extent` metres from its middle to its sides."""
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float) * extent
    return vertices, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


def solid_mesh(solids: Solids, index: int, plane_extent: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return one solid as triangles in its own axes.

    Returns
    -------
    vertices : (V, 3) float64, metres.
    triangles : (T, 3) int32, counter-clockwise seen from outside.
    """
    kind, size = int(solids.kind[index]), solids.size[index]
    if kind == kinds.PLANE:
        return plane_mesh(plane_extent)
    if kind == kinds.SPHERE:
        return sphere_mesh(size)
    if kind == kinds.CYLINDER:
        return cylinder_mesh(size)
    if kind == kinds.MESH:
        vertices, triangles = solids.meshes[int(solids.mesh[index])]
        return vertices * (size / np.ptp(vertices, axis=0)), triangles
    return box_mesh(size)


def plane_patch(solids: Solids, index: int, points: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """Return where a square of a plane lies that is under the whole scene, and how large it is.

    points : (P, 3) float64 that the square should reach under, in the solids' frame; default: the other solids.

    Returns pose (4, 4) float64 of the middle of the square, half width in metres.
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
