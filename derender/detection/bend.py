"""How a floor bends, or a sensor bends it: low-order in the image, by millimetres, and no thing that stands on it.

A real sensor's depths are off by a slow bias (1 to 9 mm on planes before consumer sensors), and bins and carpets are no
planes. Without it a floor's noise seems to be that large, and what is lower is lost in it.
"""

import numpy as np

from derender.detection.floor import back_project
from derender.results.fit import SENSOR_PER_DEPTH, SENSOR_PER_SQUARE

ROUNDS, WITHIN = 6, 3.0  # of leaving out what is no floor, and beyond how many standard deviations that is
ORDERS = 2, 4  # of the polynomial: a sensor's bias and a carpet; a bin, whose floor rises towards all its walls
BETTER = 0.8  # of the scatter that is left about a surface worth taking, instead of about the one before it
FEWEST = 100  # pixels of the floor: fewer tell no bend
STEEPEST = 0.15  # sine of the angle between ray and floor below which the bend is taken along the ray no further
MOST = 3.0  # standard deviations of consumer sensors that a bend amounts to at most


def bend_of(depth, floor, camera):
    """Return (H, W) metres to add to a depth image so that its floor is a plane; zeros where it is one as it is.

    The floor's height over its plane is taken as a polynomial of rows and columns, fitted robustly to its inliers, of a
    higher order where that leaves clearly less, and no more anywhere than it is among them.

    depth : (H, W) float64 metres, NaN = no return. floor : Floor.
    """
    none = np.zeros(depth.shape)
    if floor.inliers.sum() < FEWEST:
        return none
    normal = floor.pose[:3, 2]
    seen = ((back_project(depth, camera) - floor.pose[:3, 3]) @ normal)[floor.inliers]
    row, column = (np.linspace(-1.0, 1.0, count) for count in depth.shape)
    y, x = np.meshgrid(row, column, indexing="ij")
    bend, before = none, scatter(seen)
    for order in ORDERS:
        terms = np.stack([x**i * y**j for i in range(order + 1) for j in range(order + 1 - i)], axis=-1)
        numbers, after = robust_fit(terms[floor.inliers], seen)
        if after > BETTER * before:
            continue
        surface = terms @ numbers
        fitted = surface[floor.inliers][np.abs(surface[floor.inliers] - seen) < WITHIN * after]
        bend, before = np.clip(surface, fitted.min(), fitted.max()), after
    most = MOST * sensor_deviation(float(np.median(depth[floor.inliers])))
    slope = -(back_project(np.ones_like(depth), camera) @ normal)
    return np.clip(bend, -most, most) / np.maximum(slope, STEEPEST)


def robust_fit(terms, seen):
    """Return (the numbers by which terms (N, K) explain most of what is seen (N,), metres that the rest scatters)."""
    kept = np.abs(seen) < WITHIN * scatter(seen)
    for _ in range(ROUNDS):
        numbers = np.linalg.lstsq(terms[kept], seen[kept], rcond=None)[0]
        residual = seen - terms @ numbers
        after = scatter(residual)
        kept = np.abs(residual) < WITHIN * after
    return numbers, after


def sensor_deviation(depth):
    """Return the standard deviation in metres of what consumer depth cameras are off by at a depth, bias included."""
    return (SENSOR_PER_DEPTH * depth + SENSOR_PER_SQUARE * depth**2) / 3.0


def scatter(residual):
    """Return the standard deviation of residuals about zero, from the median of their sizes."""
    return 1.4826 * float(np.median(np.abs(residual))) + 1e-9
