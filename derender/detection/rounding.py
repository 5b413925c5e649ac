"""Depths rounded to a step, of which noise leaves hardly anything open: a renderer's image in a file of integers.

Such an image is off by as much beside a pixel as there, all along an edge or a row, which no noise is: of 20 made
scenes rounded to a millimetre five were told wrong, three with free-form things, and of 20 rounded to 5 mm six had
solids that are not there. Noise of the step hides that, as it does in sound and pictures ("dithering"), and what an
image with it leaves open is what one under such noise does.
"""

from typing import TYPE_CHECKING

import numpy as np

from derender.detection.estimate import WIDEST
from derender.detection.floor import SUREST, share_within
from derender.detection.floors import find_floor
from derender.detection.pyramid import reduced_by, reduced_camera, single_pixels
from derender.errors import DerenderError

if TYPE_CHECKING:
    from derender.camera.intrinsics import Camera

FEWEST = 20  # different depths by which a step is told
MOST = 10  # steps that the two nearest of them are apart: of a level floor each row has one depth
SAME = 1e-6  # share of a depth by which depths that are the same differ, in single precision
REGULAR = 0.02  # root mean square, in steps, by which depths may lie beside multiples of one; of any others it is .29
HALF = 0.6  # steps by which rounding may have a depth off: a half, and a fifth of that for the floor's own error
# Share of a floor's pixels that are no farther off: all without noise, .85 under noise of .3 steps, .4 under noise of
# one. Of the first the sawtooth that rounding makes of a slope is as large as without noise, of the second .17 of it.
QUIET = 0.85
# Standard deviation of the noise in steps, times the root of how many rows are joined to one where an image is reduced:
# neighbours then share a seventh of what it is off by, if each row is off by as much all along.
DITHER = 0.7


def steps_of(depth: np.ndarray) -> np.ndarray:
    """Return (H, W) metres: the step to which each depth was rounded, be it one of depth or of disparity, or that of
    half precision; 0 where depths lie on no grid.

    depth : (H, W) metres, NaN = no return.
    """
    known = np.unique(depth[np.isfinite(depth)])
    with np.errstate(over="ignore"):
        if len(known) and (known == known.astype(np.float16)).all():
            return np.spacing(np.nan_to_num(depth).astype(np.float16)).astype(float)
    if step := grid_of(known):
        return np.full(depth.shape, step)
    return grid_of(1.0 / known[::-1]) * np.nan_to_num(depth) ** 2


def grid_of(values: np.ndarray) -> float:
    """Return the step of which all of the values (N,), which ascend, are multiples; 0: there is none."""
    least = least_step(values) if len(values) > FEWEST else 0.0
    for step in least / np.arange(1.0, MOST + 1.0) if least else ():
        if np.sqrt(np.mean((values / step - np.rint(values / step)) ** 2)) < REGULAR:
            return float(step)
    return 0.0


def least_step(values: np.ndarray) -> float:
    """Return the least step between values (N,), which ascend; 0: all are the same."""
    steps = np.diff(values)
    return float(min(steps[steps > SAME * values[1:]], default=0.0))


def dithered(rng: np.random.Generator, depth: np.ndarray, camera: "Camera") -> np.ndarray:
    """Return a depth image (H, W) with noise of DITHER steps where it is rounded and shows a floor with hardly any;
    another as it is."""
    steps = steps_of(depth)
    if not steps.any():
        return depth
    factor = reduced_by(depth, WIDEST)
    few, seen_by = single_pixels(depth, factor), reduced_camera(camera, factor)
    try:
        floor = find_floor(few, seen_by)
    except DerenderError:
        return depth
    near = np.maximum(HALF * single_pixels(np.where(steps > 0, steps, np.nan), factor), SUREST / 5)
    if share_within(few, floor, seen_by, near) <= QUIET:
        return depth
    return depth + DITHER * np.sqrt(factor) * steps * rng.standard_normal(depth.shape)
