"""Draw and score a rectangle of the image: the one piece of work that full and incremental evaluation share."""

import numpy as np

from derender.kernel_cache import njit
from derender.kernel_call import call_for_nothing, call_for_two_numbers
from derender.model.solids import MESH
from derender.vision.raycast.lane_names import LANES
from derender.vision.raycast.rows import fill, invert, raise_solid, raise_to_image
from derender.vision.raycast.state import (
    BACKGROUND,
    BLUR,
    DEPTH,
    HEIGHT,
    MESHES,
    PAD,
    RATE,
    SCORE,
    WIDTH,
)


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
    call_for_nothing(settings[BLUR], images[DEPTH + half], images[SCORE + half], strip, taps, left, right, top, bottom,
                     height)
    return call_for_two_numbers(settings[RATE], parameters, images, half, left, right, top, bottom, height)
