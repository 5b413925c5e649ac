"""Points on the surfaces of solids, and exact distances to those surfaces."""

from collections.abc import Mapping
from math import pi, sqrt
from typing import Any

import numpy as np

POINTS = 1000


def surface_points(solid: Mapping[str, Any]) -> np.ndarray:
    """Return about POINTS points spread evenly over a solid's surface, always the same ones.

    Returns
    -------
    (N, 3) float64, in the frame of the solid's pose, metres.
    """
    pose, size = np.asarray(solid["pose"], float), np.asarray(solid["size"], float)
    if solid.get("vertices") is not None:
        local = _hull_points(np.asarray(solid["vertices"], float), POINTS)
    elif solid["type"] == "sphere":
        local = _fibonacci_sphere(POINTS) * 0.5 * size[0]
    elif solid["type"] == "cylinder":
        local = _cylinder_points(0.5 * size[0], size[2], POINTS)
    else:
        local = _box_points(size, POINTS)
    return local @ pose[:3, :3].T + pose[:3, 3]


def distance_to_surface(points: np.ndarray, solid: Mapping[str, Any]) -> np.ndarray:
    """Return the distance of each point to the nearest point of a solid's surface, inside or out.

    Closed forms for boxes, cylinders and spheres; a hull given by its `vertices` is sampled by 20,000 points.

    Parameters
    ----------
    points : (N, 3) float64, in the frame of the solid's pose.

    Returns
    -------
    (N,) float64, metres, never negative.
    """
    pose, size = np.asarray(solid["pose"], float), np.asarray(solid["size"], float)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    if solid.get("vertices") is not None:
        from scipy.spatial import cKDTree

        tree = cKDTree(_hull_points(np.asarray(solid["vertices"], float), 20_000))
        return np.asarray(tree.query(local)[0])
    if solid["type"] == "sphere":
        return np.abs(np.linalg.norm(local, axis=1) - 0.5 * size[0])
    if solid["type"] == "cylinder":
        beyond = np.column_stack(
            [np.hypot(local[:, 0], local[:, 1]) - 0.5 * size[0], np.abs(local[:, 2]) - 0.5 * size[2]]
        )
    else:
        beyond = np.abs(local) - 0.5 * size
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    inside = np.minimum(beyond.max(axis=1), 0)
    return np.abs(outside + inside)


def _box_points(size: np.ndarray, count: int) -> np.ndarray:
    area = 2 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0])
    step = sqrt(area / count)
    points = []
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        # Cells of about step x step, one point in the middle of each.
        numbers = [max(1, round(size[k] / step)) for k in (first, second)]
        a, b = np.meshgrid(
            *[((np.arange(n) + 0.5) / n - 0.5) * size[k] for n, k in zip(numbers, (first, second), strict=True)]
        )
        for sign in (-0.5, 0.5):
            face = np.full((a.size, 3), sign * size[axis])
            face[:, first], face[:, second] = a.ravel(), b.ravel()
            points.append(face)
    return np.vstack(points)


def _fibonacci_sphere(count: int) -> np.ndarray:
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = pi * (1 + sqrt(5)) * index
    radius = np.sqrt(1 - z * z)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


def _cylinder_points(radius: float, height: float, count: int) -> np.ndarray:
    cap_share = radius / (2 * (radius + height))
    caps = max(1, round(count * cap_share))
    index = np.arange(caps) + 0.5
    r, angle = radius * np.sqrt(index / caps), pi * (1 + sqrt(5)) * index
    cap = np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(caps, 0.5 * height)])
    sides = max(1, count - 2 * caps)
    index = np.arange(sides) + 0.5
    angle = pi * (1 + sqrt(5)) * index
    side = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), (index / sides - 0.5) * height])
    return np.vstack([cap, side, cap * [1, 1, -1]])


def _hull_points(vertices: np.ndarray, count: int) -> np.ndarray:
    """Return points on the hull of `vertices`, each triangle by its area; the same every time."""
    from scipy.spatial import ConvexHull

    triangles = vertices[ConvexHull(vertices).simplices]
    area = 0.5 * np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    # A low-discrepancy walk over the surface: which triangle, and where in it.
    index = np.arange(count) + 0.5
    which = np.minimum(np.searchsorted(np.cumsum(area) / area.sum(), index / count), len(area) - 1)
    a, b = (index * 0.7548776662466927) % 1, (index * 0.5698402909980532) % 1
    flip = a + b > 1
    a, b = np.where(flip, 1 - a, a)[:, None], np.where(flip, 1 - b, b)[:, None]
    chosen = triangles[which]
    return chosen[:, 0] * (1 - a - b) + chosen[:, 1] * a + chosen[:, 2] * b
