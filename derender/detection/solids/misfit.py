"""The misfit of an image: how badly solids explain it, all of it, or what one more solid changes; compiled.

The misfit of a pixel is min(r^2 / (2 sigma^2), LIMIT): minus the logarithm of a mixture of sensor noise with a broad
outlier, up to a constant, without the exponentials (Bolles and Fischler's score as made continuous in MSAC).
"""

import numpy as np

from derender.compilation.cache import njit
from derender.detection.solids.image import drawn_alone, prepare_row
from derender.render.blur import blur_into
from derender.render.raycast.convex import PREPARED
from derender.render.raycast.lane_names import (
    LANES,
    accumulate,
    load,
    load_rounded,
    minimum,
    multiply,
    reciprocal,
    splat,
    subtract,
    sum_lanes,
    where_at_least,
    zero_sum,
)
from derender.render.raycast.region import fill, raise_solid

LIMIT = 8.0
AS_SEEN = 1e-8  # metres
WALL = 10.0  # metres: what lies beyond counts as this deep where the blur mixes it with what is nearer


@njit(cache=True, nogil=True, borrows=True)
def residual(seen, drawn, blurred):
    """Return what is seen less what is drawn; a background that was taken as it is seen is not blurred again."""
    return 0.0 if abs(seen - drawn) < AS_SEEN else seen - blurred


@njit(cache=True, nogil=True)
def misfit_map(image, depth, out):
    """Fill out (H, W) with each pixel's misfit against the model depth, blurred, and return the sum."""
    height, width = depth.shape
    blurred = depth
    if image.taps.size > 1:
        blurred = np.empty((height, width))
        blur_into(image.taps, np.minimum(depth, WALL), 0, width, 0, height, blurred)
    total = 0.0
    for j in range(height):
        total += misfit_of_row(image.depth[j], image.weight[j], depth[j], blurred[j], out[j])
    return total


@njit(cache=True, nogil=True, fastmath={"reassoc"}, borrows=True)
def misfit_of_row(seen, weight, drawn, blurred, out):
    """Write the misfit of pixels (n,) and return its sum."""
    total = 0.0
    for n in range(seen.size):
        r = residual(seen[n], drawn[n], blurred[n])
        m = min(r * r * weight[n], LIMIT)
        out[n] = m
        total += m
    return total


@njit(cache=True, nogil=True)
def added_misfit(image, row, depth, misfit):
    """Return how the misfit changes when the solid `row` is added to a scene with this depth and misfit map."""
    return added_misfit_by(image, row, depth, misfit, new_canvas(image))


@njit(cache=True, nogil=True)
def new_canvas(image):
    """Return what a solid is drawn into: (H, P) float32, lanes beside the image included, of no use where that is
    blurred; and what `prepare_row` writes."""
    height, width = image.depth.shape
    drawn = np.empty((height, width + 2 * LANES), np.float32)
    return drawn, np.empty((4, 4)), np.empty(PREPARED), np.empty(4, np.int64)


@njit(cache=True, nogil=True, borrows=True)
def added_misfit_by(image, row, depth, misfit, canvas):
    """As `added_misfit`; canvas : see `new_canvas`, what is in it does not matter."""
    if image.taps.size > 1:
        return added_misfit_blurred(image, row, depth, misfit)
    drawn, pose, prepared, rectangle = canvas
    prepare_row(image, row, pose, prepared, rectangle)
    left, right, top, bottom = rectangle[0], rectangle[1], rectangle[2], rectangle[3]
    if left >= right:
        return 0.0
    fill(drawn, left, right, top, bottom, 0, np.float32(0))
    raise_solid(drawn, left, right, top, bottom, 0, prepared, (left + right) // 2)
    return change_in_lanes(image.depth, image.weight, depth, misfit, drawn, left, right, top, bottom)


@njit(cache=True, nogil=True)
def added_misfit_blurred(image, row, depth, misfit):
    """As `added_misfit`, of an image with a blur."""
    rectangle, drawn = drawn_alone(image, row)
    return change_by(image, rectangle, drawn, depth, misfit)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def change_in_lanes(seen, weight, depth, misfit, drawn, left, right, top, bottom):
    """As `change_of_row` of all rows of a rectangle; drawn : (H, P) float32."""
    width, total, rest = seen.shape[1], zero_sum(), 0.0
    limit, none = splat(np.float32(LIMIT)), splat(np.float32(0))
    least = splat(np.float32(1e-30))
    for row in range(top, bottom):
        column = left
        while column < right and column + LANES <= width:
            z = reciprocal(load(drawn, row, column))  # NaN where nothing is drawn
            weights = load_rounded(weight, row, column)
            r = subtract(load_rounded(seen, row, column), z)
            change = subtract(minimum(multiply(multiply(r, r), weights), limit), load_rounded(misfit, row, column))
            nearer = subtract(load_rounded(depth, row, column), z)
            change = where_at_least(nearer, least, change, none)
            total = accumulate(total, where_at_least(weights, least, change, none))
            column += LANES
        while column < right:  # the image ends
            if drawn[row, column] > 0.0:
                z = 1.0 / drawn[row, column]
                r = seen[row, column] - z
                if z < depth[row, column] and weight[row, column] > 0.0:
                    rest += min(r * r * weight[row, column], LIMIT) - misfit[row, column]
            column += 1
    return sum_lanes(total) + rest


@njit(cache=True, nogil=True)
def added_misfits(image, rows, depth, misfit):
    """Return (K,) what `added_misfit` does for each of the solids `rows` (K, ROW) alone."""
    found = np.empty(len(rows))
    for k in range(len(rows)):
        found[k] = added_misfit(image, rows[k], depth, misfit)
    return found


@njit(cache=True, nogil=True, error_model="numpy")  # where nothing is drawn the inverse depth is 0
def change_by(image, rectangle, drawn, depth, misfit):
    """Return how the misfit changes when what was drawn alone is added to a scene with this depth and misfit map."""
    height, width = image.depth.shape
    i0, i1, j0, j1 = rectangle
    total = 0.0
    if i0 >= i1:
        return total
    radius = image.taps.size - 1
    if radius == 0:
        for j in range(j0, j1):
            total += change_of_row(image.depth[j, i0:i1], image.weight[j, i0:i1], depth[j, i0:i1], drawn[j - j0],
                                   misfit[j, i0:i1])  # fmt: skip
        return total
    # It changes the pixels that it covers and those within the blur's reach; the window is what these are blurred from.
    left, right = max(i0 - 2 * radius, 0), min(i1 + 2 * radius, width)
    top, bottom = max(j0 - 2 * radius, 0), min(j1 + 2 * radius, height)
    window = np.minimum(depth[top:bottom, left:right], WALL)
    for j in range(j0, j1):
        part, inverse = window[j - top, i0 - left : i1 - left], drawn[j - j0]
        for n in range(part.size):
            part[n] = min(part[n], 1.0 / inverse[n])
    i0, i1, j0, j1 = max(i0 - radius, 0), min(i1 + radius, width), max(j0 - radius, 0), min(j1 + radius, height)
    blurred = np.empty((j1 - j0, i1 - i0))
    blur_into(image.taps, window, i0 - left, i1 - left, j0 - top, j1 - top, blurred)
    for j in range(j0, j1):
        clear = window[j - top, i0 - left : i1 - left]
        total += change_of_blurred(image.depth[j, i0:i1], image.weight[j, i0:i1], clear, blurred[j - j0],
                                   misfit[j, i0:i1])  # fmt: skip
    return total


@njit(cache=True, nogil=True, fastmath={"reassoc"}, error_model="numpy", borrows=True)
def change_of_row(seen, weight, depth, drawn, misfit):
    """Return how the misfit of pixels (n,) changes where inverse depths are drawn that are nearer than before."""
    total = 0.0
    for n in range(drawn.size):
        z = 1.0 / drawn[n]
        r = seen[n] - z
        change = min(r * r * weight[n], LIMIT) - misfit[n]
        total += change if z < depth[n] and weight[n] > 0.0 else 0.0
    return total


@njit(cache=True, nogil=True, fastmath={"reassoc"}, borrows=True)
def change_of_blurred(seen, weight, drawn, blurred, misfit):
    """Return how the misfit of pixels (n,) changes with what is drawn in them, blurred."""
    total = 0.0
    for n in range(seen.size):
        r = residual(seen[n], drawn[n], blurred[n])
        change = min(r * r * weight[n], LIMIT) - misfit[n]
        total += change if weight[n] > 0.0 else 0.0
    return total
