"""The misfit of an image: how badly solids explain it, all of it, or what one more solid changes; compiled.

The misfit of a pixel is min(r^2 / (2 sigma^2), LIMIT): minus the logarithm of a mixture of sensor noise with a broad
outlier, up to a constant, without the exponentials (Bolles and Fischler's score as made continuous in MSAC).
"""

import numpy as np

from derender.compilation.cache import njit
from derender.detection.solids.image import drawn_alone
from derender.render.blur import blur_into

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
        for i in range(width):
            r = residual(image.depth[j, i], depth[j, i], blurred[j, i])
            m = min(r * r * image.weight[j, i], LIMIT)
            out[j, i] = m
            total += m
    return total


@njit(cache=True, nogil=True)
def added_misfit(image, row, depth, misfit):
    """Return how the misfit changes when the solid `row` is added to a scene with this depth and misfit map."""
    rectangle, drawn = drawn_alone(image, row)
    return change_by(image, rectangle, drawn, depth, misfit)


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
