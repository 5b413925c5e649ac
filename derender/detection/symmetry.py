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
