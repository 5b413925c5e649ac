"""Exact volumes of intersections of convex solids.

A solid is a list of half-spaces n . x <= d. The intersection of two solids is the two lists together; its volume is a
third of the sum over its faces of (distance of the face's plane from an origin) times (area of the face), by the
divergence theorem. Each face is a large square in its plane, clipped by every other half-space. That is exact for boxes
and convex polyhedra, needs no interior point, and does not mind faces that coincide.

Cylinders are prisms with 64 sides and spheres polyhedra with 256 faces, of the solid's own volume: their intersections
are right to about half a percent (two spheres: exact).

Also points on the surfaces of solids, and exact distances to those surfaces.
"""

from collections.abc import Mapping
from functools import lru_cache
from math import pi, sqrt, tan
from typing import Any

import numpy as np

from derender.compilation.cache import njit
from derender.scene.shapes.kinds import CORNERS

PRISM_SIDES = 64
SPHERE_FACES = 256


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
        return float(_convex_volume(_recentred(half_spaces(solid), centre), _reach(solid)))
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
    planes = _recentred(np.vstack([half_spaces(a), half_spaces(b)]), centre_a)
    return max(0.0, float(_convex_volume(planes, reach_a + reach_b)))


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


def _recentred(planes: np.ndarray, centre: np.ndarray) -> np.ndarray:
    moved = planes.copy()
    moved[:, 3] -= planes[:, :3] @ centre
    return moved


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
    return (4 / 3 * pi / _convex_volume(planes, 2.0)) ** (1 / 3)


def _hull_half_spaces(vertices: np.ndarray) -> np.ndarray:
    from scipy.spatial import ConvexHull

    equations = ConvexHull(vertices).equations
    return np.column_stack([equations[:, :3], -equations[:, 3]])


@njit(cache=True, nogil=True)
def _convex_volume(planes, reach):
    """Return the volume of the intersection of half-spaces that lies within `reach` of the origin's surroundings.

    planes : (M, 4) float64, n . x <= d; the intersection is bounded and inside the ball of radius `reach`.
    reach : float, metres.
    """
    count = planes.shape[0]
    tolerance = 1e-12 * reach
    polygon = np.zeros((count + 8, 2))
    clipped = np.zeros((count + 8, 2))
    total = 0.0
    for i in range(count):
        nx, ny, nz, offset = planes[i, 0], planes[i, 1], planes[i, 2], planes[i, 3]
        repeated = False
        for j in range(i):
            # A face of one solid that coincides with one of the other counts once.
            if (
                abs(nx - planes[j, 0]) + abs(ny - planes[j, 1]) + abs(nz - planes[j, 2]) < 1e-9
                and abs(offset - planes[j, 3]) < tolerance
            ):
                repeated = True
                break
        if repeated or offset > reach or offset < -reach:
            continue
        # Two axes in the plane.
        if abs(nx) < 0.6:
            ax, ay, az = 1.0, 0.0, 0.0
        else:
            ax, ay, az = 0.0, 1.0, 0.0
        ux, uy, uz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
        length = np.sqrt(ux * ux + uy * uy + uz * uz)
        ux, uy, uz = ux / length, uy / length, uz / length
        vx, vy, vz = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
        size = 4
        polygon[0, 0], polygon[0, 1] = -reach, -reach
        polygon[1, 0], polygon[1, 1] = reach, -reach
        polygon[2, 0], polygon[2, 1] = reach, reach
        polygon[3, 0], polygon[3, 1] = -reach, reach
        for j in range(count):
            if j == i:
                continue
            mx, my, mz = planes[j, 0], planes[j, 1], planes[j, 2]
            a = mx * ux + my * uy + mz * uz
            b = mx * vx + my * vy + mz * vz
            c = planes[j, 3] - offset * (mx * nx + my * ny + mz * nz)
            kept = 0
            for k in range(size):
                following = k + 1 if k + 1 < size else 0
                here = a * polygon[k, 0] + b * polygon[k, 1] - c
                there = a * polygon[following, 0] + b * polygon[following, 1] - c
                if here <= tolerance:
                    clipped[kept, 0], clipped[kept, 1] = polygon[k, 0], polygon[k, 1]
                    kept += 1
                if (here <= tolerance) != (there <= tolerance):
                    along = here / (here - there)
                    clipped[kept, 0] = polygon[k, 0] + along * (polygon[following, 0] - polygon[k, 0])
                    clipped[kept, 1] = polygon[k, 1] + along * (polygon[following, 1] - polygon[k, 1])
                    kept += 1
            size = kept
            polygon, clipped = clipped, polygon
            if size < 3:
                break
        if size < 3:
            continue
        area = 0.0
        for k in range(size):
            following = k + 1 if k + 1 < size else 0
            area += polygon[k, 0] * polygon[following, 1] - polygon[following, 0] * polygon[k, 1]
        total += offset * 0.5 * area
    return total / 3.0


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
