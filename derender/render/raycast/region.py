"""Draw and score a rectangle of the image: the one piece of work that full and incremental evaluation share.

A proposal's rectangles are those of what moved, before and after; where they would touch, one that holds both.
"""

import numpy as np

from derender.compilation.cache import njit
from derender.compilation.call import call_for_nothing, call_for_two_numbers
from derender.render.raycast.lane_names import LANES
from derender.render.raycast.rows import fill, invert, raise_solid, raise_to_image
from derender.render.raycast.state import (
    BACKGROUND,
    BLUR,
    DEPTH,
    HEIGHT,
    MARGIN,
    MESHES,
    PAD,
    RATE,
    REGIONS,
    SCORE,
    WIDTH,
)
from derender.scene.solids import MESH

DRAWN, SCORED = 0, 1  # of a region: the columns and rows that are drawn, and the wider ones that the blur reaches


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def draw_region(settings, parameters, images, kind, prepared, rectangle, half, region):
    """Draw the clean depth of a half in columns region[0]:region[1] (a multiple of LANES) and rows [2]:[3].

    The nearest surface, or the wall at the likelihood's `background` depth where that is nearer.
    """
    left, right, top, bottom = region[0], region[1], region[2], region[3]
    image = images[DEPTH + half]
    fill(image, left, right, top, bottom, PAD, np.float32(1.0 / parameters[BACKGROUND]))
    for k in range(kind.shape[1]):
        r0, r1, r2, r3 = rectangle[half, k, 0], rectangle[half, k, 1], rectangle[half, k, 2], rectangle[half, k, 3]
        if r0 < right and r1 > left and r2 < bottom and r3 > top:
            first, end, start, stop = max(r0, left), min(r1, right), max(r2, top), min(r3, bottom)
            if kind[0, k] == MESH:
                raise_to_image(image, first, end, start, stop, PAD, images[MESHES + 2 * kind[2, k] + half])
            else:
                first = left + (first - left) // LANES * LANES  # so that rounding up stays inside the region
                raise_solid(image, first, end, start, stop, PAD, prepared[half, k], (r0 + r1) // 2)
    invert(image, left, right, top, bottom, PAD, settings[WIDTH])


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def score_region(settings, parameters, taps, images, strip, half, region):
    """Blur and score a half in a region (columns a multiple of LANES).

    Returns the sum of its new scores and of the scores that the current half had there before (after the first, full
    scoring of a scene the second is not meaningful: the current half itself was written).
    """
    height = settings[HEIGHT]
    left, right, top, bottom = region[0] + PAD, region[1] + PAD, region[2], region[3]
    call_for_nothing(
        settings[BLUR], images[DEPTH + half], images[SCORE + half], strip, taps, left, right, top, bottom, height
    )
    return call_for_two_numbers(settings[RATE], parameters, images, half, left, right, top, bottom, height)


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def whole_image(settings, region):
    """Make a region the whole image."""
    region[0], region[1] = 0, (settings[WIDTH] + LANES - 1) // LANES * LANES
    region[2], region[3] = 0, settings[HEIGHT]


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _touch(a, b):
    return a[0] < b[1] and b[0] < a[1] and a[2] < b[3] and b[2] < a[3]


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def add_region(settings, regions, rectangle):
    """Add a rectangle to the proposal's regions, swallowing those whose scored regions it touches.

    A drawn region's columns are padded to a multiple of LANES, and so are those of its scored region, which is all that
    the blur can reach from it.
    """
    left, right, top, bottom = rectangle[0], rectangle[1], rectangle[2], rectangle[3]
    if left >= right:
        return
    width, height, margin = settings[WIDTH], settings[HEIGHT], settings[MARGIN]
    count, k = settings[REGIONS], -1
    while k < count:
        if k >= 0:
            if not _touch(regions[SCORED, k], regions[SCORED, count]):
                k += 1
                continue
            left, right = min(left, regions[DRAWN, k, 0]), min(max(right, regions[DRAWN, k, 1]), width)
            top, bottom = min(top, regions[DRAWN, k, 2]), max(bottom, regions[DRAWN, k, 3])
            count -= 1
            for i in range(4):
                regions[DRAWN, k, i], regions[SCORED, k, i] = regions[DRAWN, count, i], regions[SCORED, count, i]
        drawn, scored = regions[DRAWN, count], regions[SCORED, count]
        drawn[0], drawn[1] = left, left + (right - left + LANES - 1) // LANES * LANES
        drawn[2], drawn[3] = top, bottom
        first, end = max(left - margin, 0), min(right + margin, width)
        scored[0], scored[1] = first, first + (end - first + LANES - 1) // LANES * LANES
        scored[2], scored[3] = max(top - margin, 0), min(bottom + margin, height)
        k = 0
    settings[REGIONS] = count + 1
