"""Exact volumes of intersections of convex solids.

A solid is a list of half-spaces n . x <= d. The intersection of two solids is the two lists together; Qhull finds its
corners about the middle of the largest ball inside, and their volume. That is exact for boxes and convex polyhedra.

Cylinders are prisms with 64 sides and spheres polyhedra with 256 faces, of the solid's own volume: their intersections
are right to about half a percent (two spheres: exact).

Also points on the surfaces of solids, and exact distances to those surfaces.
"""

from collections.abc import Mapping
from functools import lru_cache
from math import pi, sqrt, tan
from typing import Any

import numpy as np

from derender.scene.shapes.kinds import CORNERS

PRISM_SIDES = 64
SPHERE_FACES = 256
FLAT = 1e-7  # of the solids' extent: an intersection that holds no larger ball has no volume


def half_spaces(solid: Mapping[str, Any]) -> np.ndarray:
    """Return the half-spaces n . x <= d of a solid, in the frame of its pose.

    solid : with `type`, `size` (3,) metres and `pose` (4, 4); `vertices` (V, 3) in object axes, if there, are those of
        its convex hull. A type without its own form here counts as its oriented box.

    Returns (M, 4) float64, rows (n_x, n_y, n_z, d).
    """
    size = np.asarray(solid["size"], float)
    pose = np.asarray(solid["pose"], float)
    rotation, centre = pose[:3, :3], pose[:3, 3]
    if solid.get("vertices") is not None:
        local = _hull_half_spaces(np.asarray(solid["vertices"], float))
        normals, offsets = local[:, :3] @ rotation.T, local[:, 3]
    elif solid["type"] == "sphere":
        # The same directions whatever the sphere's rotation, so that equal spheres are equal polyhedra.
        normals = _fibonacci_sphere(SPHERE_FACES)
        offsets = np.full(len(normals), 0.5 * size[0] * _sphere_scale())
    elif solid["type"] == "cylinder":
        apothem = 0.5 * size[0] * sqrt(pi / (PRISM_SIDES * tan(pi / PRISM_SIDES)))
        axis = rotation[:, 2]
        # Seen from the camera, not from the object, for the same reason: its turn about z is not to be seen.
        reference = np.eye(3)[0 if abs(axis[0]) < 0.9 else 1]
        first = np.cross(axis, reference)
        first /= np.linalg.norm(first)
        angle = 2 * pi * np.arange(PRISM_SIDES)[:, None] / PRISM_SIDES
        sides = np.cos(angle) * first + np.sin(angle) * np.cross(axis, first)
        normals = np.vstack([axis, -axis, sides])
        offsets = np.r_[0.5 * size[2], 0.5 * size[2], np.full(PRISM_SIDES, apothem)]
    else:
        normals = np.vstack([rotation.T, -rotation.T])
        offsets = np.r_[0.5 * size, 0.5 * size]
    return np.column_stack([normals, offsets + normals @ centre])


def volume_of(solid: Mapping[str, Any]) -> float:
    """Return the volume of a solid in cubic metres."""
    size = np.asarray(solid["size"], float)
    if solid.get("vertices") is not None:
        centre = np.asarray(solid["pose"], float)[:3, 3]
        return _convex_volume(half_spaces(solid), centre, _reach(solid))
    factor = {"sphere": pi / 6, "cylinder": pi / 4}.get(solid["type"], 1.0)
    return factor * float(np.prod(size))


def intersection_volume(a: Mapping[str, Any], b: Mapping[str, Any]) -> float:
    """Return the volume that two solids share, in cubic metres."""
    centre_a, centre_b = (np.asarray(solid["pose"], float)[:3, 3] for solid in (a, b))
    distance = float(np.linalg.norm(centre_a - centre_b))
    reach_a, reach_b = _reach(a), _reach(b)
    if distance >= reach_a + reach_b:
        return 0.0
    if a["type"] == b["type"] == "sphere":
        return _lens_volume(0.5 * float(a["size"][0]), 0.5 * float(b["size"][0]), distance)
    return _convex_volume(np.vstack([half_spaces(a), half_spaces(b)]), centre_a, reach_a + reach_b)


def intersection_over_union(a: Mapping[str, Any], b: Mapping[str, Any]) -> float:
    """Return the volume that two solids share over the volume that they fill together, in [0, 1]."""
    shared = intersection_volume(a, b)
    union = volume_of(a) + volume_of(b) - shared
    return min(1.0, shared / union) if union > 0 else 0.0


def _reach(solid: Mapping[str, Any]) -> float:
    """Return the radius of a ball about the solid's origin that holds it."""
    if solid.get("vertices") is not None:
        return float(np.linalg.norm(np.asarray(solid["vertices"], float), axis=1).max())
    # The polyhedron that stands for a cylinder or sphere reaches a little beyond it.
    return 0.51 * float(np.linalg.norm(np.asarray(solid["size"], float)))


def _lens_volume(radius_a: float, radius_b: float, distance: float) -> float:
    """Return the volume shared by two balls (closed form, two spherical caps)."""
    if distance <= abs(radius_a - radius_b):
        return 4 / 3 * pi * min(radius_a, radius_b) ** 3
    if distance >= radius_a + radius_b:
        return 0.0
    total = radius_a + radius_b
    return (
        pi
        * (total - distance) ** 2
        * (distance**2 + 2 * distance * total - 3 * (radius_a - radius_b) ** 2)
        / (12 * distance)
    )


@lru_cache(maxsize=1)
def _sphere_scale() -> float:
    """Return the distance of the faces at which the polyhedron has the volume of the unit ball."""
    planes = np.column_stack([_fibonacci_sphere(SPHERE_FACES), np.ones(SPHERE_FACES)])
    return (4 / 3 * pi / _convex_volume(planes, np.zeros(3), 1.0)) ** (1 / 3)


def _hull_half_spaces(vertices: np.ndarray) -> np.ndarray:
    from scipy.spatial import ConvexHull

    equations = ConvexHull(vertices).equations
    return np.column_stack([equations[:, :3], -equations[:, 3]])


def _convex_volume(planes: np.ndarray, centre: np.ndarray, reach: float) -> float:
    """Return the volume of the intersection of half-spaces (M, 4), n . x <= d, within a ball about a centre (3,)."""
    from scipy.optimize import linprog
    from scipy.spatial import ConvexHull, HalfspaceIntersection

    normals, offsets = planes[:, :3], (planes[:, 3] - planes[:, :3] @ centre) / reach
    bounds = [(None, None)] * 3 + [(0.0, None)]
    ball = linprog([0.0, 0.0, 0.0, -1.0], np.column_stack([normals, np.ones(len(planes))]), offsets, bounds=bounds)
    if not ball.success or ball.x[3] < FLAT:
        return 0.0
    corners = HalfspaceIntersection(np.column_stack([normals, -offsets]), ball.x[:3]).intersections
    return float(ConvexHull(corners).volume) * reach**3


POINTS = 1000


def surface_points(solid: Mapping[str, Any]) -> np.ndarray:
    """Return about POINTS points spread evenly over a solid's surface, always the same ones.

    Returns (N, 3) float64, in the frame of the solid's pose, metres.
    """
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
    """Return the distance of each point to the nearest point of a solid's surface, inside or out.

    Closed forms for boxes, cylinders and spheres; a hull given by its `vertices` is sampled by 20,000 points.

    points : (N, 3) float64, in the frame of the solid's pose.

    Returns (N,) float64, metres, never negative.
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
