"""Outlines in a plane. Figure 2: the offsets at which two touch, exactly; and the convex hull of points.

Every outline is a rounded rectangle about its centre: a rectangle (a, b, 0), a disc (0, 0, r), a segment (a, 0, 0),
a point (0, 0, 0). All are symmetric about their centres, so the offsets of a child at angle theta that touch the
parent are the Minkowski sum of the two: a zonogon with the generators a e_x, b e_y, c R e_x, d R e_y, grown by a disc
of the two radii. `reach` gives half its x-range and `upper` its upper boundary; the lower one is its mirror image.

Compiled code calls these functions as they are; Python takes them interpreted (`compilation.cache.interpreted`). Their
last arguments are the two outlines' `sides`.
"""

import math
from typing import TYPE_CHECKING

import numpy as np

from derender.compilation.cache import njit

if TYPE_CHECKING:
    from derender.scene.shapes.base import Outline

# A generator this much steeper than long is vertical: cos(pi/2) is 6e-17 and not 0 in floating point.
VERTICAL = 1e-12


@njit(cache=True, nogil=True)
def reach(theta, a, b, c, d, radius):
    """Return half the length of the x-range [-reach, reach] of touching offsets, in metres.

    Parameters: `theta` child's angle; `a`, `b` full sides of the parent; `c`, `d` of the child; `radius` sum of radii.
    """
    return 0.5 * (a + c * abs(math.cos(theta)) + d * abs(math.sin(theta))) + radius


@njit(cache=True, nogil=True)
def upper(x, theta, a, b, c, d, radius):
    """Return the largest touching y-offset at the x-offset `x` (clipped into the range); the smallest is -upper(-x).

    The boundary is walked from the left in order of falling slope: an arc of the disc, an edge, an arc, an edge, ...
    """
    cosine, sine = math.cos(theta), math.sin(theta)
    # The two slanted generators, pointing right; b is vertical, and a has slope zero.
    width_1, rise_1 = c * cosine, c * sine
    if width_1 < 0.0:
        width_1, rise_1 = -width_1, -rise_1
    width_2, rise_2 = -d * sine, d * cosine
    if width_2 < 0.0:
        width_2, rise_2 = -width_2, -rise_2
    height = b
    if width_1 <= VERTICAL * abs(rise_1):
        height, width_1, rise_1 = height + abs(rise_1), 0.0, 0.0
    if width_2 <= VERTICAL * abs(rise_2):
        height, width_2, rise_2 = height + abs(rise_2), 0.0, 0.0
    # One of the two rises and the other falls (they are perpendicular), so a lies between them.
    if rise_1 < rise_2:
        width_1, rise_1, width_2, rise_2 = width_2, rise_2, width_1, rise_1
    left = -0.5 * (a + width_1 + width_2)
    y = 0.5 * (height - rise_1 - rise_2)
    offset = min(max(x, left - radius), -left + radius) - left
    # `offset` is measured from the vertex walked to; the arc about it ends where the next edge's normal points.
    for width, rise in ((width_1, rise_1), (a, 0.0), (width_2, rise_2)):
        length = math.hypot(width, rise)
        if length > 0.0:
            normal_x, normal_y = -rise / length, width / length
            if offset <= radius * normal_x:
                return y + math.sqrt(max(radius * radius - offset * offset, 0.0))
            if offset <= radius * normal_x + width:
                return y + radius * normal_y + rise * (offset - radius * normal_x) / width
            offset -= width
            y += rise
    return y + math.sqrt(max(radius * radius - offset * offset, 0.0))


def sides(parent: "Outline", child: "Outline") -> tuple[float, float, float, float, float]:
    """Return (a, b, c, d, radius) of the outlines (a, b, radius) of two bounded faces."""
    return parent[0], parent[1], child[0], child[1], parent[2] + child[2]


@njit(cache=True, nogil=True)
def offset_from_uv(u, v, theta, a, b, c, d, radius):
    """Return the offset (x, y) in metres that (u, v) in [0, 1]^2 stand for."""
    x = (2.0 * u - 1.0) * reach(theta, a, b, c, d, radius)
    low, high = -upper(-x, theta, a, b, c, d, radius), upper(x, theta, a, b, c, d, radius)
    return x, low + v * (high - low)


@njit(cache=True, nogil=True)
def uv_from_offset(x, y, theta, a, b, c, d, radius):
    """Return (u, v, outside): the nearest touching (u, v), x first, and by how many metres (x, y) misses it.

    Where the range is a single point the fraction is not defined and 1/2 is returned.
    """
    half = reach(theta, a, b, c, d, radius)
    near_x = min(max(x, -half), half)
    low, high = -upper(-near_x, theta, a, b, c, d, radius), upper(near_x, theta, a, b, c, d, radius)
    near_y = min(max(y, low), high)
    u = 0.5 + 0.5 * near_x / half if half > 0.0 else 0.5
    v = (near_y - low) / (high - low) if high > low else 0.5
    return u, v, math.hypot(x - near_x, y - near_y)


@njit(cache=True, nogil=True)
def area_element(u, theta, a, b, c, d, radius):
    """Return |d(x, y) / d(u, v)| in square metres, what a jump between offsets in metres and (u, v) needs."""
    half = reach(theta, a, b, c, d, radius)
    x = (2.0 * u - 1.0) * half
    return 2.0 * half * (upper(x, theta, a, b, c, d, radius) + upper(-x, theta, a, b, c, d, radius))


MANY = 200  # points, of which it pays to leave out first those that are well inside
FLAT = 1e-10  # area over squared extent below which points count as being on a line


def convex_outline(points: np.ndarray) -> np.ndarray | None:
    """Return the (M, 2) corners of the convex hull of points (N, 2), counterclockwise; None where they are on a line.

    Without scipy, whose import takes long. Two monotone chains (Andrew 1979), there and back; corners at which the way
    hardly turns are left out afterwards.
    """
    if len(points) > MANY:
        points = points[outermost(points)]
    if len(points) < 3:
        return None
    flat = FLAT * np.ptp(points, axis=0).max() ** 2
    there = points[np.lexsort(points.T[::-1])]
    back = np.ascontiguousarray(there[::-1])
    corners = np.concatenate([chain(chain(way, 0.0), flat)[:-1] for way in (there, back)])
    x, y = (corners - corners[0]).T
    area = 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1))
    return corners if area > flat else None


@njit(cache=True, nogil=True)
def outermost(points):
    """Return (N,) bool: points (N, 2) that are not inside the octagon of those farthest in eight directions.

    The others are no corners of the hull (Akl and Toussaint 1978), and need no sorting.
    """
    ways = np.array(
        [(1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (-1.0, 1.0), (-1.0, 0.0), (-1.0, -1.0), (0.0, -1.0), (1.0, -1.0)]
    )
    farthest = np.zeros(len(ways), np.int64)
    for k in range(len(ways)):
        most = -np.inf
        for n in range(len(points)):
            far = ways[k, 0] * points[n, 0] + ways[k, 1] * points[n, 1]
            if far > most:
                farthest[k], most = n, far
    found = np.zeros(len(points), np.bool_)
    for k in range(len(ways)):
        corner, after = points[farthest[k]], points[farthest[(k + 1) % len(ways)]]
        ax, ay = after[0] - corner[0], after[1] - corner[1]
        found[farthest[k]] = True
        for n in range(len(points) if ax != 0.0 or ay != 0.0 else 0):
            found[n] |= ax * (points[n, 1] - corner[1]) - ay * (points[n, 0] - corner[0]) <= 0.0
    return found


@njit(cache=True, nogil=True)
def chain(points, flat):
    """Return those of points (N, 2) in order along an axis at which the way turns left by more than an area `flat`."""
    kept, count = np.empty(len(points), np.int64), 0
    for k in range(len(points)):
        while count > 1:
            before, last = points[kept[count - 2]], points[kept[count - 1]]
            ax, ay, bx, by = last[0] - before[0], last[1] - before[1], points[k, 0] - last[0], points[k, 1] - last[1]
            if ax * by - ay * bx > flat:
                break
            count -= 1
        kept[count] = k
        count += 1
    return points[kept[:count]]


def beyond_edges(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return (N,) how far points (N, 2) lie beyond the edge of a convex outline (M, 2) that they are farthest beyond;
    below 0 within it. Its corners are in order, anticlockwise."""
    edges = np.roll(corners, -1, axis=0) - corners
    normals = np.column_stack([edges[:, 1], -edges[:, 0]]) / np.linalg.norm(edges, axis=1, keepdims=True)
    x, y = np.ascontiguousarray(points.T)
    beyond = np.full(len(points), -np.inf)
    for (a, b), start in zip(normals.tolist(), (normals * corners).sum(axis=1).tolist(), strict=True):
        np.maximum(beyond, a * x + b * y - start, out=beyond)  # edge by edge: a sixteenth of the time of all at once
    return beyond
