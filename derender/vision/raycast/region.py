"""Draw and score a rectangle of the image: the one piece of work that full and incremental evaluation share."""

import numpy as np
from numba import njit

from derender.model.solids import MESH
from derender.vision.raycast.filter import blur_column, blur_row
from derender.vision.raycast.lanes import LANES
from derender.vision.raycast.rows import fill, invert, raise_solid, raise_to_image
from derender.vision.raycast.score import score_row_gaussian, score_row_robust
from derender.vision.raycast.state import (
    BACKGROUND,
    DEPTH,
    GAUSSIAN,
    HEIGHT,
    LIKELIHOOD,
    MESHES,
    PAD,
    RADIUS,
    RING,
    WIDTH,
)


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def score_region(settings, parameters, taps, images, rows, half, region):
    """Blur and score a half in a region (columns a multiple of LANES).

    Returns the sum of its new scores and of the scores that the current half had there before.
    """
    height, radius = settings[HEIGHT], settings[RADIUS]
    left, right, top, bottom = region[0], region[1], region[2], region[3]
    depth, ring = images[DEPTH + half], rows[RING:]
    mask = ring.shape[0] - 1
    last = min(bottom + radius, height)
    new, old = 0.0, 0.0
    output = top
    for row in range(max(top - radius, 0), last):
        blur_row(depth, row, ring, row & mask, left, right, PAD, taps, radius)
        while output < bottom and (output + radius <= row or row == last - 1):
            blur_column(ring, output, height, rows, left, right, PAD, taps, radius)
            if settings[LIKELIHOOD] == GAUSSIAN:
                row_new, row_old = score_row_gaussian(images, rows, half, output, left, right)
            else:
                row_new, row_old = score_row_robust(parameters, images, rows, half, output, height, left, right)
            new += row_new
            old += row_old
            output += 1
    return new, old
