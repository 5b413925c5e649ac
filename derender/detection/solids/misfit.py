"""The misfit of an image: how badly solids explain it, all of it, or what one more solid changes; compiled.

The misfit of a pixel is min(r^2 / (2 sigma^2), LIMIT): minus the logarithm of a mixture of sensor noise with a broad
outlier, up to a constant, without the exponentials (Bolles and Fischler's score as made continuous in MSAC).
"""

import numpy as np

from derender.compilation.cache import njit
from derender.detection.solids.image import KIND, bounding_rectangle, hit, in_axes

LIMIT = 8.0
AS_SEEN = 1e-8  # metres
WALL = 10.0  # metres: what lies beyond counts as this deep where the blur mixes it with what is nearer


@njit(cache=True, nogil=True)
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
def blur_into(taps, depth, i0, i1, j0, j1, out):
    """Blur pixels i0..i1 of rows j0..j1 (ends excluded), the edges of `depth` replicated, into out (j1-j0, i1-i0)."""
    height, width = depth.shape
    radius = taps.size - 1
    top, bottom = max(j0 - radius, 0), min(j1 + radius, height)
    rows = np.empty((bottom - top, i1 - i0))
    for j in range(top, bottom):
        for i in range(i0, i1):
            value = taps[0] * depth[j, i]
            for k in range(1, radius + 1):
                value += taps[k] * (depth[j, max(i - k, 0)] + depth[j, min(i + k, width - 1)])
            rows[j - top, i - i0] = value
    for j in range(j0, j1):
        for i in range(i1 - i0):
            value = taps[0] * rows[j - top, i]
            for k in range(1, radius + 1):
                value += taps[k] * (rows[max(j - k, 0) - top, i] + rows[min(j + k, height - 1) - top, i])
            out[j - j0, i] = value


@njit(cache=True, nogil=True)
def added_misfit(image, row, depth, misfit):
    """Return how the misfit changes when the solid `row` is added to a scene with this depth and misfit map."""
    if image.taps.size > 1:
        return added_misfit_blurred(image, row, depth, misfit)
    height, width = image.depth.shape
    kind = int(row[KIND])
    i0, i1, j0, j1 = bounding_rectangle(row, image.projection, height, width)
    ox, oy, oz = in_axes(row, image.origin[0] - row[10], image.origin[1] - row[11], image.origin[2] - row[12])
    total = 0.0
    for j in range(j0, j1):
        for i in range(i0, i1):
            weight = image.weight[j, i]
            if weight == 0.0:
                continue
            dx, dy, dz = in_axes(row, image.direction[j, i, 0], image.direction[j, i, 1], image.direction[j, i, 2])
            t = hit(kind, row, ox, oy, oz, dx, dy, dz)
            if t < depth[j, i]:
                r = image.depth[j, i] - t
                total += min(r * r * weight, LIMIT) - misfit[j, i]
    return total


@njit(cache=True, nogil=True)
def added_misfit_blurred(image, row, depth, misfit):
    """The same for a blurred image: the solid changes the pixels that it covers and those within the blur's reach."""
    height, width = image.depth.shape
    radius = image.taps.size - 1
    kind = int(row[KIND])
    i0, i1, j0, j1 = bounding_rectangle(row, image.projection, height, width)
    if i0 >= i1 or j0 >= j1:
        return 0.0
    # the window: what the rectangle's neighbourhood is blurred from
    left, right = max(i0 - 2 * radius, 0), min(i1 + 2 * radius, width)
    top, bottom = max(j0 - 2 * radius, 0), min(j1 + 2 * radius, height)
    window = np.empty((bottom - top, right - left))
    ox, oy, oz = in_axes(row, image.origin[0] - row[10], image.origin[1] - row[11], image.origin[2] - row[12])
    for j in range(top, bottom):
        for i in range(left, right):
            z = depth[j, i]
            if i0 <= i < i1 and j0 <= j < j1:
                dx, dy, dz = in_axes(row, image.direction[j, i, 0], image.direction[j, i, 1], image.direction[j, i, 2])
                z = min(z, hit(kind, row, ox, oy, oz, dx, dy, dz))
            window[j - top, i - left] = min(z, WALL)
    return change_within(image, window, left, top, i0, i1, j0, j1, misfit)


@njit(cache=True, nogil=True)
def change_within(image, window, left, top, i0, i1, j0, j1, misfit):
    """Return how the misfit changes when something is drawn into pixels i0..i1, j0..j1 (ends excluded).

    window : depth, not blurred, with what was drawn, of these pixels and all that they are blurred with; its first
    pixel is (left, top).
    """
    height, width = image.depth.shape
    radius = image.taps.size - 1
    i0, i1, j0, j1 = max(i0 - radius, 0), min(i1 + radius, width), max(j0 - radius, 0), min(j1 + radius, height)
    blurred = np.empty((j1 - j0, i1 - i0))
    blur_into(image.taps, window, i0 - left, i1 - left, j0 - top, j1 - top, blurred)
    total = 0.0
    for j in range(j0, j1):
        for i in range(i0, i1):
            weight = image.weight[j, i]
            if weight > 0.0:
                r = residual(image.depth[j, i], window[j - top, i - left], blurred[j - j0, i - i0])
                total += min(r * r * weight, LIMIT) - misfit[j, i]
    return total
