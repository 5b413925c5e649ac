"""Convex hulls of points in a plane without scipy, whose import takes long."""

import numpy as np

from derender.compilation.cache import njit

FLAT = 1e-10  # area over squared extent below which points count as being on a line


def convex_outline(points: np.ndarray) -> np.ndarray | None:
    """Return the (M, 2) corners of the convex hull of points (N, 2), counterclockwise; None where they are on a line.

    Two monotone chains (Andrew 1979), there and back; corners at which the way hardly turns are left out afterwards.
    """
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


def outline_planes(corners: np.ndarray) -> np.ndarray:
    """Return (M, 3) rows a, b, c of the edges' lines: a x + b y + c is the distance beyond the edge."""
    edges = np.roll(corners, -1, axis=0) - corners
    normals = np.column_stack([edges[:, 1], -edges[:, 0]]) / np.linalg.norm(edges, axis=1, keepdims=True)
    return np.column_stack([normals, -(normals * corners).sum(axis=1)])
