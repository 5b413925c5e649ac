"""How a floor bends, or a sensor bends it: low-order in the image, by millimetres, and no thing that stands on it.

A real sensor's depths are off by a slow bias (1 to 9 mm on planes before consumer sensors), and bins and carpets are no
planes. Without it a floor's noise seems to be that large, and what is lower is lost in it.
"""

import numpy as np

from derender.detection.floor import back_project
from derender.results.fit import SENSOR_PER_DEPTH, SENSOR_PER_SQUARE

ROUNDS, WITHIN = 6, 3.0  # of leaving out what is no floor, and beyond how many standard deviations that is
BETTER = 0.8  # of the scatter about the plane that is left about a surface worth taking
STEEPEST = 0.15  # sine of the angle between ray and floor below which the bend is taken along the ray no further
MOST = 3.0  # standard deviations of consumer sensors that a bend amounts to at most


def bend_of(depth, floor, camera):
    """Return (H, W) metres to add to a depth image so that its floor is a plane; zeros where it is one as it is.

    The floor's height over its plane is taken as quadratic in rows and columns, fitted robustly to its inliers, and no
    more anywhere than it is among them.

    depth : (H, W) float64 metres, NaN = no return. floor : Floor.
    """
    none = np.zeros(depth.shape)
    if floor.inliers.sum() < 100:
        return none
    normal = floor.pose[:3, 2]
    height = (back_project(depth, camera) - floor.pose[:3, 3]) @ normal
    row, column = (np.linspace(-1.0, 1.0, count) for count in depth.shape)
    y, x = np.meshgrid(row, column, indexing="ij")
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    there, seen = terms[floor.inliers], height[floor.inliers]
    before = scatter(seen)
    kept, after = np.abs(seen) < WITHIN * before, before
    for _ in range(ROUNDS):
        if kept.sum() < 50:
            return none
        numbers = np.linalg.lstsq(there[kept], seen[kept], rcond=None)[0]
        residual = seen - there @ numbers
        after = scatter(residual)
        kept = np.abs(residual) < WITHIN * after
    if after > BETTER * before:
        return none
    fitted = there[kept] @ numbers
    most = MOST * sensor_deviation(float(np.median(depth[floor.inliers])))
    bend = np.clip(np.clip(terms @ numbers, fitted.min(), fitted.max()), -most, most)
    slope = -(back_project(np.ones_like(depth), camera) @ normal)
    return bend / np.maximum(slope, STEEPEST)


def sensor_deviation(depth):
    """Return the standard deviation in metres of what consumer depth cameras are off by at a depth, bias included."""
    return (SENSOR_PER_DEPTH * depth + SENSOR_PER_SQUARE * depth**2) / 3.0


def scatter(residual):
    """Return the standard deviation of residuals about zero, from the median of their sizes."""
    return 1.4826 * float(np.median(np.abs(residual))) + 1e-9
