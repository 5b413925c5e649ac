"""Volumes of intersections of convex solids, points on their surfaces, and exact distances to those.

A solid is the convex hull of its corners, and a list of half-spaces n . x <= d. The intersection of two is the two
lists together; Qhull finds its corners about the middle of the largest ball inside, and their volume. That is exact for
boxes and convex polyhedra. Round solids are polyhedra of their own volume, right to about half a percent.
"""

from collections.abc import Mapping
from functools import lru_cache
from math import pi, sin, sqrt
from typing import Any

import numpy as np

from derender.scene.separation import surface_distance
from derender.scene.shapes.kinds import CORNERS
from derender.scene.solids import BOX, CYLINDER, SPHERE

PRISM_SIDES = 64
SPHERE_CORNERS = 256
FLAT = 1e-7  # of the solids' extent: an intersection that holds no larger ball has no volume


def corners_of(solid: Mapping[str, Any]) -> np.ndarray:
    """Return the corners (V, 3) of a solid, metres, in the frame of its pose.

    solid : with `type`, `size` (3,) metres and `pose` (4, 4); `vertices` (V, 3) in object axes, if there, are those of
        its convex hull. A type without its own form here counts as its oriented box.
    """
    size, pose = np.asarray(solid["size"], float), np.asarray(solid["pose"], float)
    if solid.get("vertices") is not None:
        local = np.asarray(solid["vertices"], float) @ pose[:3, :3].T
    elif solid["type"] == "sphere":
        # The same directions whatever the sphere's rotation, so that equal spheres are equal polyhedra.
        local = 0.5 * size[0] * _sphere_corners()
    elif solid["type"] == "cylinder":
        axis = pose[:3, 2]
        # Seen from the camera, not from the object, for the same reason: its turn about z is not to be seen.
        first = np.cross(axis, np.eye(3)[0 if abs(axis[0]) < 0.9 else 1])
        first /= np.linalg.norm(first)
        angle = 2 * pi * np.arange(PRISM_SIDES)[:, None] / PRISM_SIDES
        radius = 0.5 * size[0] * sqrt(2 * pi / (PRISM_SIDES * sin(2 * pi / PRISM_SIDES)))
        ring = radius * (np.cos(angle) * first + np.sin(angle) * np.cross(axis, first))
        local = np.vstack([ring + 0.5 * size[2] * axis, ring - 0.5 * size[2] * axis])
    else:
        local = CORNERS * size @ pose[:3, :3].T
    return local + pose[:3, 3]


@lru_cache(maxsize=1)
def _sphere_corners() -> np.ndarray:
    """Return the corners of a polyhedron about the origin that has the volume of the unit ball."""
    from scipy.spatial import ConvexHull

    corners = _fibonacci_sphere(SPHERE_CORNERS)
    return corners * (4 / 3 * pi / ConvexHull(corners).volume) ** (1 / 3)


def volume_of(solid: Mapping[str, Any]) -> float:
    """Return the volume of a solid in cubic metres."""
    from scipy.spatial import ConvexHull

    return float(ConvexHull(corners_of(solid)).volume)


def intersection_volume(a: Mapping[str, Any], b: Mapping[str, Any]) -> float:
    """Return the volume that two solids share, in cubic metres."""
    from scipy.optimize import linprog
    from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

    corners = [corners_of(a), corners_of(b)]
    centre = corners[0].mean(axis=0)
    reach = float(np.linalg.norm(np.vstack(corners) - centre, axis=1).max())  # so that Qhull sees lengths of about one
    (low, high), (other_low, other_high) = ((each.min(axis=0), each.max(axis=0)) for each in corners)
    if np.any(high < other_low) or np.any(other_high < low):
        return 0.0
    planes = np.vstack([ConvexHull((each - centre) / reach).equations for each in corners])  # n . x + c <= 0
    bounds = [(None, None)] * 3 + [(0.0, None)]
    ball = linprog([0.0, 0.0, 0.0, -1.0], np.column_stack([planes[:, :3], np.ones(len(planes))]), -planes[:, 3],
                   bounds=bounds)  # fmt: skip
    if not ball.success or ball.x[3] < FLAT:
        return 0.0
    try:
        shared = HalfspaceIntersection(planes, ball.x[:3])
    except QhullError:  # of faces that are all but the same: moved by rounding they are not
        shared = HalfspaceIntersection(planes, ball.x[:3], qhull_options="QJ")
    return float(ConvexHull(shared.intersections).volume) * reach**3


def intersection_over_union(a: Mapping[str, Any], b: Mapping[str, Any]) -> float:
    """Return the volume that two solids share over the volume that they fill together, in [0, 1]."""
    shared = intersection_volume(a, b)
    union = volume_of(a) + volume_of(b) - shared
    return min(1.0, shared / union) if union > 0 else 0.0


POINTS = 1000


def surface_points(solid: Mapping[str, Any]) -> np.ndarray:
    """Return (N, 3), metres in the frame of its pose, about POINTS points spread evenly over a solid's surface."""
    pose, size = np.asarray(solid["pose"], float), np.asarray(solid["size"], float)
    if solid.get("vertices") is not None:
        local = _hull_points(np.asarray(solid["vertices"], float), POINTS)
    elif solid["type"] == "sphere":
        local = _fibonacci_sphere(POINTS) * 0.5 * size[0]
    elif solid["type"] == "cylinder":
        local = _cylinder_points(0.5 * size[0], size[2], POINTS)
    else:
        local = _hull_points(CORNERS * size, POINTS)
    return local @ pose[:3, :3].T + pose[:3, 3]


def distance_to_surface(points: np.ndarray, solid: Mapping[str, Any]) -> np.ndarray:
    """Return how far (N,) points (N, 3), in the frame of its pose, are from a solid's surface, metres, inside or out.

    Closed forms for boxes, cylinders and spheres; a hull given by its `vertices` is sampled by 20,000 points.
    """
    pose, size = np.asarray(solid["pose"], float), np.asarray(solid["size"], float)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    if solid.get("vertices") is not None:
        from scipy.spatial import cKDTree

        tree = cKDTree(_hull_points(np.asarray(solid["vertices"], float), 20_000))
        return np.asarray(tree.query(local)[0])
    kind = {"sphere": SPHERE, "cylinder": CYLINDER}.get(solid["type"], BOX)
    return np.abs(surface_distance(kind, size, local))


def _fibonacci_sphere(count: int) -> np.ndarray:
    """Return unit vectors spread evenly (a Fibonacci lattice), (count, 3)."""
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
