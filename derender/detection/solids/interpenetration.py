"""How deep two solids interpenetrate, by separating axes: compiled, on the rows of image.py.

Each solid answers with its support function; the axes tried are the face normals of both, their cross products, and the
directions that separate round solids.  The depth is exact for boxes and spheres and never too small for cylinders
against boxes, where it is off by less than a millimetre unless an edge meets the rounded side.
"""

import numpy as np

from derender.compilation.cache import njit
from derender.scene.solids import BOX, SPHERE


@njit(cache=True, nogil=True, borrows=True)
def reach(row, x, y, z):
    """Return how far the solid reaches from its centre along the unit vector (x, y, z)."""
    kind = int(row[0])
    if kind == SPHERE:
        return 0.5 * row[13]
    a = row[1] * x + row[4] * y + row[7] * z
    b = row[2] * x + row[5] * y + row[8] * z
    c = row[3] * x + row[6] * y + row[9] * z
    if kind == BOX:
        return 0.5 * (abs(a) * row[13] + abs(b) * row[14] + abs(c) * row[15])
    return 0.5 * (np.sqrt(a * a + b * b) * row[13] + abs(c) * row[15])


@njit(cache=True, nogil=True, borrows=True)
def overlap_along(p, q, x, y, z):
    """Return the overlap of two solids' shadows on an axis of any length (a great number for a zero axis)."""
    length = np.sqrt(x * x + y * y + z * z)
    if length < 1e-6:
        return 1e9
    x, y, z = x / length, y / length, z / length
    gap = abs(x * (q[10] - p[10]) + y * (q[11] - p[11]) + z * (q[12] - p[12]))
    return reach(p, x, y, z) + reach(q, x, y, z) - gap


@njit(cache=True, nogil=True, borrows=True)
def clamp_direction(box, x, y, z):
    """Return the vector from the nearest point of the solid's oriented box to the point (x, y, z)."""
    ex, ey, ez = x - box[10], y - box[11], z - box[12]
    rx, ry, rz = ex, ey, ez
    for axis in range(3):
        ax, ay, az = box[1 + axis], box[4 + axis], box[7 + axis]
        along = ex * ax + ey * ay + ez * az
        half = 0.5 * box[13 + axis]
        along = min(max(along, -half), half)
        rx -= along * ax
        ry -= along * ay
        rz -= along * az
    return rx, ry, rz


@njit(cache=True, nogil=True, borrows=True)
def penetration(p, q):
    """Return the depth in metres by which two solids overlap; negative: a lower bound of minus their distance."""
    return penetration_beyond(p, q, 0.0)


@njit(cache=True, nogil=True, borrows=True)
def penetration_beyond(p, q, enough):
    """As `penetration`, but no more than that it is not deeper than `enough` where one axis tells that."""
    dx, dy, dz = q[10] - p[10], q[11] - p[11], q[12] - p[12]
    far = 0.25 * ((np.sqrt(p[13] ** 2 + p[14] ** 2 + p[15] ** 2) + np.sqrt(q[13] ** 2 + q[14] ** 2 + q[15] ** 2)) ** 2)
    if dx * dx + dy * dy + dz * dz > far:
        return -0.01
    return least_overlap(p, q, enough)


@njit(cache=True, nogil=True, borrows=True)
def gap_between(p, q):
    """Return the distance in metres between two solids as far as one of their axes tells; negative: they overlap."""
    return -least_overlap(p, q, -np.inf)


@njit(cache=True, nogil=True, borrows=True)
def least_overlap(p, q, enough):
    """Return the least overlap of two solids along the directions that may part them, or the first up to `enough`."""
    dx, dy, dz = q[10] - p[10], q[11] - p[11], q[12] - p[12]
    best = overlap_along(p, q, dx, dy, dz)
    for axis in range(3):
        best = min(best, overlap_along(p, q, p[1 + axis], p[4 + axis], p[7 + axis]))
        if best <= enough:
            return best
        best = min(best, overlap_along(p, q, q[1 + axis], q[4 + axis], q[7 + axis]))
        if best <= enough:
            return best
    both_upright = abs(p[9]) == 1.0 and abs(q[9]) == 1.0
    for i in range(0 if both_upright else 3):  # of two upright ones these are their axes
        for j in range(3):
            x = p[4 + i] * q[7 + j] - p[7 + i] * q[4 + j]
            y = p[7 + i] * q[1 + j] - p[1 + i] * q[7 + j]
            z = p[1 + i] * q[4 + j] - p[4 + i] * q[1 + j]
            best = min(best, overlap_along(p, q, x, y, z))
            if best <= enough:
                return best
    for side in range(2):
        one, other = (p, q) if side == 0 else (q, p)
        if int(one[0]) != BOX:
            x, y, z = clamp_direction(other, one[10], one[11], one[12])
            best = min(best, overlap_along(p, q, x, y, z))
            along = dx * one[3] + dy * one[6] + dz * one[9]
            best = min(best, overlap_along(p, q, dx - along * one[3], dy - along * one[6], dz - along * one[9]))
            along = x * one[3] + y * one[6] + z * one[9]
            best = min(best, overlap_along(p, q, x - along * one[3], y - along * one[6], z - along * one[9]))
    return best


@njit(cache=True, nogil=True, borrows=True)
def lowest(row):
    """Return the height of the solid's lowest point over the floor."""
    return row[12] - reach(row, 0.0, 0.0, 1.0)


@njit(cache=True, nogil=True, borrows=True)
def highest(row):
    """Return the height of the solid's highest point over the floor."""
    return row[12] + reach(row, 0.0, 0.0, 1.0)
