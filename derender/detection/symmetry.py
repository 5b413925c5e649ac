"""The vertical axis of a surface of revolution, told by its normals: what is hidden of a bottle is as what is seen.

The normals of a surface of revolution meet its axis, inside and outside of a bowl alike. Of an upright axis through c
the horizontal parts (n_x, n_y) of the normals at p satisfy n_x (p_y - c_y) = n_y (p_x - c_x), which is linear in c
(Pottmann and Wallner, Computational Line Geometry, 2001, of rotational surfaces in general). Faces of a box miss any
such axis, and handles miss that of the rest: iteratively reweighted least squares leave them out.
"""

import numpy as np

STEEP = 0.3  # horizontal part of a normal that tells the axis
FEWEST = 20  # points with such normals
MISSED = 0.2  # of the radius by which a normal may miss the axis
ROUND = 0.7  # share of the normals that meet it
SPREAD = 0.04  # least over greatest eigenvalue of the equations: of fewer directions the axis is not told
ROUNDS = 10
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
    if np.mean(miss < MISSED * radius) < ROUND:
        return None
    return centre, radius
