"""Outlines of what is seen: ends along axes, feet, axes of surfaces of revolution."""

import numpy as np


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


STEEP = 0.3  # horizontal part of a normal that tells the axis
FEWEST = 20  # points with such normals
MISSED = 0.2  # of the radius by which a normal may miss the axis
# Share of the normals that meet it, those of a mug's handle do not, times that of the circle's square that as much as
# is seen may fill: from the side half of it shows, in all of its width.
ROUND = 0.45
SPREAD = 0.04  # least over greatest eigenvalue of the equations: of fewer directions the axis is not told
DIRECTIONS = 8  # in which what is seen is measured
ROUNDS = 10
SLOPING = 0.25  # level part of a normal: what slopes less is noise of a level surface
BELT = 0.25  # of the height that is seen: the lowest two belts of it tell how the foot goes on
WIDEST = 0.9  # quantile of the distances from the axis that is taken for a belt's radius: the inside of a cup is nearer


def foot_radius(points: np.ndarray, centre: np.ndarray, bottom: float) -> float:
    """Return the radius at a height `bottom` of what widens downwards about an upright axis, as the lowest two belts of
    its points (K, 3) do: noise hides where it meets its support. 0 of what does not widen."""
    low, high = np.quantile(points[:, 2], [0.005, 0.995])
    away, belt = np.linalg.norm(points[:, :2] - centre, axis=1), BELT * (high - low)
    lowest, next_one = (np.abs(points[:, 2] - low - (k + 0.5) * belt) < 0.5 * belt for k in (0, 1))
    if min(lowest.sum(), next_one.sum()) < FEWEST or bottom > low:
        return 0.0
    radius, above = (float(np.quantile(away[part], WIDEST)) for part in (lowest, next_one))
    return radius + (radius - above) * (low + 0.5 * belt - bottom) / belt if radius > above else 0.0


def vertical_axis(points: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Return (centre (2,), greatest radius) of the upright surface of revolution through points; None: it is none.

    What is hidden of a bottle is as what is seen. The normals meet the axis, inside and outside of a bowl alike: of an
    upright one through c their horizontal parts (n_x, n_y) at p satisfy n_x (p_y - c_y) = n_y (p_x - c_x), which is
    linear in c (Pottmann and Wallner, Computational Line Geometry, 2001). Faces of a box miss any such axis, and
    handles miss that of the rest: iteratively reweighted least squares leave them out.

    points, normal : (K, 3), metres and unit vectors, z up; a normal that is not known is zero.
    """
    flat = np.hypot(normal[:, 0], normal[:, 1])
    steep = flat > STEEP
    if steep.sum() < FEWEST:
        return None
    place = points[steep, :2]
    way = normal[steep, :2] / flat[steep, None]
    across = np.column_stack([-way[:, 1], way[:, 0]])
    offset = (across * place).sum(axis=1)
    weight, centre, radius = np.ones(len(place)), np.zeros(2), 0.0
    for _ in range(ROUNDS):
        equations = across.T @ (across * weight[:, None])
        least, most = np.linalg.eigvalsh(equations)
        if least < SPREAD * most:
            return None
        centre = np.linalg.solve(equations, across.T @ (weight * offset))
        miss = np.abs(offset - across @ centre)
        near = np.linalg.norm(place - centre, axis=1)
        radius = float(np.quantile(near[miss <= np.median(miss)], 0.98))
        weight = 1.0 / (1.0 + (miss / (0.5 * MISSED * radius)) ** 2)
    along = np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    seen = np.ptp(points[:, :2] @ np.array([np.cos(along), np.sin(along)]), axis=0).max()
    if np.mean(miss < MISSED * radius) * min(1.0, 0.5 * seen / radius) ** 2 < ROUND:
        return None
    return centre, radius


def sloping_foot(points: np.ndarray, normal: np.ndarray, bottom: float, reach: float) -> np.ndarray:
    """Return (L, 2) where the foot of a surface that slopes down goes on to a height `bottom`: noise hides where it
    meets what it stands on.

    points, normal : (K, 3), z up; a normal that is not known is zero. reach : metres over it within which a foot lies.
    """
    height, flat = points[:, 2] - bottom, np.hypot(normal[:, 0], normal[:, 1])
    foot = (height > 0.0) & (height < reach) & (normal[:, 2] > 0.0) & (flat > SLOPING)
    onward = normal[foot, :2] * (height * normal[:, 2])[foot, None] / flat[foot, None] ** 2
    return points[foot, :2] + onward
