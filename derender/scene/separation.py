"""How far two solids are apart, or how deep they interpenetrate: what keeps objects without an edge off each other.

The separation of two convex solids is the maximum over unit vectors n of s(n), the gap between their shadows on n;
positive it is their distance, negative minus the depth to which one must be pushed to be free of the other.

A plane is a surface without an inside: solids on either face are free of it (Eq. 3 has both faces). A mesh counts as
its oriented box. Spheres are exact, by signed distances; so are boxes, by the fifteen separating axes when they overlap
(Gottschalk 1996) and by alternating projection when they do not; with a cylinder, whose rim has no finite set of axes,
the best STARTS of the obvious axes are refined by a search over directions: right to 0.1 mm, mostly to 1e-6 m.
"""

import math

import numpy as np

from derender.compilation.cache import njit
from derender.scene.solids import CYLINDER, PLANE, SPHERE, Solids

PROJECTIONS = 300  # of alternating projection, at most; polyhedra need a handful
FLAT_AXES = 15  # that may part two boxes: three faces of either, and nine products of their edges
ROUND_AXES = 9  # directions that may free a round side besides, see `round_axis`
STARTS = 5  # of the search over directions with a cylinder: gaps have several local maxima
CONVERGED = 1e-10  # metres between the upper and the lower bound of a distance
FIRST_STEP, LAST_STEP = 0.3, 1e-6  # radians of the search: the sectors that STARTS leave; 1e-7 m on a solid of 10 cm
POINT = 1e-9  # metres: a shorter axis has no direction


@njit(cache=True, nogil=True, borrows=True)
def reach(kind, pose, size, x, y, z):
    """Return how far a solid reaches from its centre along the unit vector (x, y, z): its support function."""
    if kind == SPHERE:
        return 0.5 * size[0]
    a = pose[0, 0] * x + pose[1, 0] * y + pose[2, 0] * z
    b = pose[0, 1] * x + pose[1, 1] * y + pose[2, 1] * z
    c = pose[0, 2] * x + pose[1, 2] * y + pose[2, 2] * z
    if kind == CYLINDER:
        return 0.5 * (math.sqrt(a * a + b * b) * size[0] + abs(c) * size[2])
    return 0.5 * (abs(a) * size[0] + abs(b) * size[1] + abs(c) * size[2])


@njit(cache=True, nogil=True, borrows=True)
def gap_along(kind_a, pose_a, size_a, kind_b, pose_b, size_b, x, y, z):
    """Return the gap between two shadows on the axis (x, y, z) of any length; -inf for an axis of none."""
    length = math.sqrt(x * x + y * y + z * z)
    if length < POINT:
        return -math.inf
    x, y, z = x / length, y / length, z / length
    apart = x * (pose_b[0, 3] - pose_a[0, 3]) + y * (pose_b[1, 3] - pose_a[1, 3]) + z * (pose_b[2, 3] - pose_a[2, 3])
    return abs(apart) - reach(kind_a, pose_a, size_a, x, y, z) - reach(kind_b, pose_b, size_b, x, y, z)


@njit(cache=True, nogil=True, borrows=True)
def nearest_point(kind, pose, size, x, y, z):
    """Return the point of a solid (not a plane) nearest to the point (x, y, z): itself if it lies inside."""
    x, y, z = x - pose[0, 3], y - pose[1, 3], z - pose[2, 3]
    a = pose[0, 0] * x + pose[1, 0] * y + pose[2, 0] * z
    b = pose[0, 1] * x + pose[1, 1] * y + pose[2, 1] * z
    c = pose[0, 2] * x + pose[1, 2] * y + pose[2, 2] * z
    if kind == SPHERE:
        scale = min(1.0, 0.5 * size[0] / max(math.sqrt(a * a + b * b + c * c), 1e-300))
        a, b, c = scale * a, scale * b, scale * c
    else:
        c = min(max(c, -0.5 * size[2]), 0.5 * size[2])
        if kind == CYLINDER:
            scale = min(1.0, 0.5 * size[0] / max(math.sqrt(a * a + b * b), 1e-300))
            a, b = scale * a, scale * b
        else:
            a = min(max(a, -0.5 * size[0]), 0.5 * size[0])
            b = min(max(b, -0.5 * size[1]), 0.5 * size[1])
    return (
        pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c + pose[0, 3],
        pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c + pose[1, 3],
        pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * c + pose[2, 3],
    )


@njit(cache=True, nogil=True, borrows=True)
def signed_distance(kind, pose, size, x, y, z):
    """Return the distance of a point from a solid's surface, negative inside; exact."""
    x, y, z = x - pose[0, 3], y - pose[1, 3], z - pose[2, 3]
    a = abs(pose[0, 0] * x + pose[1, 0] * y + pose[2, 0] * z)
    b = abs(pose[0, 1] * x + pose[1, 1] * y + pose[2, 1] * z)
    c = abs(pose[0, 2] * x + pose[1, 2] * y + pose[2, 2] * z)
    if kind == SPHERE:
        return math.sqrt(a * a + b * b + c * c) - 0.5 * size[0]
    c -= 0.5 * size[2]
    if kind == CYLINDER:
        a, b = math.sqrt(a * a + b * b) - 0.5 * size[0], -math.inf
    else:
        a, b = a - 0.5 * size[0], b - 0.5 * size[1]
    inside = min(0.0, max(a, b, c))
    a, b, c = max(a, 0.0), max(b, 0.0), max(c, 0.0)
    return inside + math.sqrt(a * a + b * b + c * c)


@njit(cache=True, nogil=True, borrows=True)
def _distance(kind_a, pose_a, size_a, kind_b, pose_b, size_b, best):
    """Return the distance of two separated solids, at least `best`: alternating projection finds the nearest points.

    Every iterate gives an upper bound, the length, and a lower one, the gap along it; it stops where they meet.
    """
    x, y, z = nearest_point(kind_b, pose_b, size_b, pose_a[0, 3], pose_a[1, 3], pose_a[2, 3])
    for _ in range(PROJECTIONS):
        p, q, r = nearest_point(kind_a, pose_a, size_a, x, y, z)
        length = math.sqrt((x - p) ** 2 + (y - q) ** 2 + (z - r) ** 2)
        best = max(best, gap_along(kind_a, pose_a, size_a, kind_b, pose_b, size_b, x - p, y - q, z - r))
        if length - best < CONVERGED:
            break
        x, y, z = nearest_point(kind_b, pose_b, size_b, p, q, r)
    return best


@njit(cache=True, nogil=True, borrows=True)
def _refined(kind_a, pose_a, size_a, kind_b, pose_b, size_b, x, y, z, best):
    """Return the greatest gap near the direction (x, y, z): a pattern search whose step grows or is halved."""
    length = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / length, y / length, z / length
    step = FIRST_STEP
    while step > LAST_STEP:
        # Two directions square to n and to each other.
        if abs(x) < 0.6:
            u, v, w = 0.0, z, -y
        else:
            u, v, w = -z, 0.0, x
        length = math.sqrt(u * u + v * v + w * w)
        u, v, w = u / length, v / length, w / length
        p, q, r = y * w - z * v, z * u - x * w, x * v - y * u
        found = False
        for k in range(8):
            cosine, sine = step * math.cos(0.25 * math.pi * k), step * math.sin(0.25 * math.pi * k)
            nx, ny, nz = x + cosine * u + sine * p, y + cosine * v + sine * q, z + cosine * w + sine * r
            value = gap_along(kind_a, pose_a, size_a, kind_b, pose_b, size_b, nx, ny, nz)
            if value > best:
                length = math.sqrt(nx * nx + ny * ny + nz * nz)
                best, x, y, z, found = value, nx / length, ny / length, nz / length, True
                break
        if not found:
            step *= 0.5
    return best


@njit(cache=True, nogil=True, borrows=True)
def flat_axis(k, pose_a, pose_b):
    """Return the axis number k of FLAT_AXES that may part two boxes: normals of either's faces, products of edges."""
    if k < 3:
        return pose_a[0, k], pose_a[1, k], pose_a[2, k]
    if k < 6:
        return pose_b[0, k - 3], pose_b[1, k - 3], pose_b[2, k - 3]
    i, j = (k - 6) // 3, (k - 6) % 3
    return (pose_a[1, i] * pose_b[2, j] - pose_a[2, i] * pose_b[1, j],
            pose_a[2, i] * pose_b[0, j] - pose_a[0, i] * pose_b[2, j],
            pose_a[0, i] * pose_b[1, j] - pose_a[1, i] * pose_b[0, j])  # fmt: skip


@njit(cache=True, nogil=True, borrows=True)
def round_axis(k, kind_a, pose_a, size_a, kind_b, pose_b, size_b):
    """Return the direction number k of nine that may free a round side, of any length.

    Between the centres, and from either's to the other's nearest point, each as it is and square to either's axis.
    """
    if k < 3:
        x, y, z = pose_b[0, 3] - pose_a[0, 3], pose_b[1, 3] - pose_a[1, 3], pose_b[2, 3] - pose_a[2, 3]
    elif k < 6:
        p, q, r = nearest_point(kind_b, pose_b, size_b, pose_a[0, 3], pose_a[1, 3], pose_a[2, 3])
        x, y, z = p - pose_a[0, 3], q - pose_a[1, 3], r - pose_a[2, 3]
    else:
        p, q, r = nearest_point(kind_a, pose_a, size_a, pose_b[0, 3], pose_b[1, 3], pose_b[2, 3])
        x, y, z = p - pose_b[0, 3], q - pose_b[1, 3], r - pose_b[2, 3]
    if k % 3 > 0:
        axis = pose_a if k % 3 == 1 else pose_b
        along = x * axis[0, 2] + y * axis[1, 2] + z * axis[2, 2]
        x, y, z = x - along * axis[0, 2], y - along * axis[1, 2], z - along * axis[2, 2]
    return x, y, z


@njit(cache=True, nogil=True, borrows=True)
def _from_plane(plane, kind, pose, size):
    """Return how far a solid is from a plane, given by its pose."""
    x, y, z = plane[0, 2], plane[1, 2], plane[2, 2]
    height = x * (pose[0, 3] - plane[0, 3]) + y * (pose[1, 3] - plane[1, 3]) + z * (pose[2, 3] - plane[2, 3])
    return abs(height) - reach(kind, pose, size, x, y, z)


@njit(cache=True, nogil=True)
def separation_of(kind_a, pose_a, size_a, kind_b, pose_b, size_b):
    """Return the separation in metres of two solids: kinds, poses (4, 4), full extents (3,). Two planes: inf."""
    if kind_a == PLANE:
        return math.inf if kind_b == PLANE else _from_plane(pose_a, kind_b, pose_b, size_b)
    if kind_b == PLANE:
        return _from_plane(pose_b, kind_a, pose_a, size_a)
    if kind_a == SPHERE:
        away = signed_distance(kind_b, pose_b, size_b, pose_a[0, 3], pose_a[1, 3], pose_a[2, 3])
        return away - 0.5 * size_a[0]
    if kind_b == SPHERE:
        away = signed_distance(kind_a, pose_a, size_a, pose_b[0, 3], pose_b[1, 3], pose_b[2, 3])
        return away - 0.5 * size_b[0]
    best = -math.inf
    round_side = kind_a == CYLINDER or kind_b == CYLINDER
    count = FLAT_AXES + ROUND_AXES if round_side else FLAT_AXES
    gaps, axes = np.empty(count), np.empty((count, 3))
    for k in range(count):
        if k < FLAT_AXES:
            x, y, z = flat_axis(k, pose_a, pose_b)
        else:
            x, y, z = round_axis(k - FLAT_AXES, kind_a, pose_a, size_a, kind_b, pose_b, size_b)
        gaps[k] = gap_along(kind_a, pose_a, size_a, kind_b, pose_b, size_b, x, y, z)
        axes[k, 0], axes[k, 1], axes[k, 2] = x, y, z
        best = max(best, gaps[k])
    if best <= 0.0 and round_side:
        for _ in range(STARTS):
            k = np.argmax(gaps)
            if gaps[k] == -math.inf:
                break
            x, y, z = axes[k, 0], axes[k, 1], axes[k, 2]
            best = max(best, _refined(kind_a, pose_a, size_a, kind_b, pose_b, size_b, x, y, z, gaps[k]))
            gaps[k] = -math.inf
            if best > 0.0:
                break
    if best > 0.0:
        best = _distance(kind_a, pose_a, size_a, kind_b, pose_b, size_b, best)
    return best


@njit(cache=True, nogil=True)
def rest_residual(kind_a, pose_a, size_a, kind_b, pose_b, size_b, x, y, z):
    """Return how far solid a is from resting on solid b, metres: up is the unit vector (x, y, z).

    The root of the sum of squares of the step between the bottom of a and the top of b, and of their distance: where
    the step is none but a does not lie over b, they are apart.
    """
    rise = x * (pose_a[0, 3] - pose_b[0, 3]) + y * (pose_a[1, 3] - pose_b[1, 3]) + z * (pose_a[2, 3] - pose_b[2, 3])
    step = rise - reach(kind_a, pose_a, size_a, x, y, z) - reach(kind_b, pose_b, size_b, x, y, z)
    apart = max(0.0, separation_of(kind_a, pose_a, size_a, kind_b, pose_b, size_b))
    return math.sqrt(step * step + apart * apart)


@njit(cache=True, nogil=True)
def penetration_of(kind_a, pose_a, size_a, kind_b, pose_b, size_b):
    """Return the depth in metres by which two solids interpenetrate, 0 where they do not, far ones at once."""
    if kind_a != PLANE and kind_b != PLANE:
        x, y, z = pose_b[0, 3] - pose_a[0, 3], pose_b[1, 3] - pose_a[1, 3], pose_b[2, 3] - pose_a[2, 3]
        first = math.sqrt(size_a[0] ** 2 + size_a[1] ** 2 + size_a[2] ** 2)
        second = math.sqrt(size_b[0] ** 2 + size_b[1] ** 2 + size_b[2] ** 2)
        if 4.0 * (x * x + y * y + z * z) >= (first + second) ** 2:
            return 0.0
    return max(0.0, -separation_of(kind_a, pose_a, size_a, kind_b, pose_b, size_b))


def surface_distance(kind: int, size: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the distances (K,) of points (K, 3), in a solid's own axes, to its surface; negative inside.

    What is no ball and no cylinder counts as its box.
    """
    beyond = np.abs(points) - 0.5 * size
    if kind == SPHERE:
        return np.linalg.norm(points, axis=1) - 0.5 * size[0]
    if kind == CYLINDER:
        beyond = np.column_stack([np.hypot(points[:, 0], points[:, 1]) - 0.5 * size[0], beyond[:, 2]])
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)


def separation(solids: Solids, first: int, second: int) -> float:
    """Return the separation in metres of two solids by index: their distance, or minus their depth."""
    kind, pose, size = solids.kind, solids.pose, solids.size
    return separation_of(int(kind[first]), pose[first], size[first], int(kind[second]), pose[second], size[second])
