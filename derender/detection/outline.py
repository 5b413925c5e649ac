"""The ends of points along axes, and their convex outline in a plane: without scipy, for its import takes long."""

from typing import Any

import numpy as np

FLAT = 1e-10  # area over squared extent below which points count as being on a line


def convex_outline(points: Any) -> Any:
    """Return the (M, 2) corners of the convex hull of points (N, 2), counterclockwise; None where they are on a line.

    Quickhull finds candidates: the point farthest beyond an edge, and what lies beyond the two edges to it. Of points
    on one side of a polygon it takes some that rounding alone puts beyond an edge, and in a wrong order, so an edge
    would face inwards: a monotone chain (Andrew 1979) through the candidates leaves those out.
    """
    if len(points) < 3:
        return None
    left, right = points[np.lexsort(points.T)[[0, -1]]]
    found = np.array([left, *_beyond(points, left, right), right, *_beyond(points, right, left)])
    found = found[np.lexsort(found.T[::-1])]
    flat = FLAT * np.ptp(points, axis=0).max() ** 2
    corners = np.array([*_chain(found, flat)[:-1], *_chain(found[::-1], flat)[:-1]])
    x, y = (corners - corners[0]).T
    area = 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1))
    return corners if area > flat else None


def _beyond(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> list[np.ndarray]:
    """Return the corners strictly to the left of the way from one corner to another."""
    along, away = end - start, points - start
    height = along[0] * away[:, 1] - along[1] * away[:, 0]
    points = points[height > 0.0]
    if len(points) == 0:
        return []
    corner = points[np.argmax(height[height > 0.0])]
    return [*_beyond(points, start, corner), corner, *_beyond(points, corner, end)]


def _chain(points: np.ndarray, flat: float) -> list[np.ndarray]:
    """Return those of points in order along an axis at which the way turns left by more than an area `flat`."""
    chain: list[np.ndarray] = []
    for point in points:
        while len(chain) > 1:
            (ax, ay), (bx, by) = chain[-1] - chain[-2], point - chain[-1]
            if ax * by - ay * bx > flat:
                break
            chain.pop()
        chain.append(point)
    return chain


def outline_planes(corners: np.ndarray) -> np.ndarray:
    """Return (M, 3) rows a, b, c of the edges' lines: a x + b y + c is the distance beyond the edge."""
    edges = np.roll(corners, -1, axis=0) - corners
    normals = np.column_stack([edges[:, 1], -edges[:, 0]]) / np.linalg.norm(edges, axis=1, keepdims=True)
    return np.column_stack([normals, -(normals * corners).sum(axis=1)])


def ends_of(values: np.ndarray, share: float) -> np.ndarray:
    """Return (2, ...) the quantiles `share` and 1 - `share` of values (N, ...), share < .5, along the first axis.

    As numpy.quantile, at a fifth of its time for the few hundred points of a patch.
    """
    last = len(values) - 1
    below, part = divmod(share * last, 1.0)
    low = int(below)
    after = min(low + 1, last)
    ordered = np.partition(values, sorted({low, after, last - after, last - low}), axis=0)
    low_end = ordered[low] + part * (ordered[after] - ordered[low])
    return np.stack([low_end, ordered[last - low] + part * (ordered[last - after] - ordered[last - low])])
