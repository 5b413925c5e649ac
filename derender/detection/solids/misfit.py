"""The misfit of an image: how badly solids explain it, all of it, or what one more solid changes; compiled.

The misfit of a pixel is min(r^2 / (2 sigma^2), LIMIT): minus the logarithm of a mixture of sensor noise with a broad
outlier, up to a constant, without the exponentials (Bolles and Fischler's score as made continuous in MSAC).
"""

import numpy as np

from derender.compilation.cache import njit
from derender.detection.solids.image import FAR, KIND, bounding_rectangle, hit, in_axes
from derender.scene.solids import BOX

LIMIT = 8.0
AS_SEEN = 1e-8  # metres
NEAREST = 1e6  # 1 / metres: nothing is nearer
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
def blur_into(taps, depth, i0, i1, j0, j1, out):
    """Blur pixels i0..i1 of rows j0..j1 (ends excluded), the edges of `depth` replicated, into out (j1-j0, i1-i0)."""
    height, width = depth.shape
    radius, count = taps.size - 1, i1 - i0
    top, bottom = max(j0 - radius, 0), min(j1 + radius, height)
    rows, line = np.empty((bottom - top, count)), np.empty(count + 2 * radius)
    for j in range(top, bottom):
        for n in range(line.size):
            line[n] = depth[j, min(max(i0 - radius + n, 0), width - 1)]
        weigh(taps[0], line[radius : radius + count], line[radius : radius + count], 0.0, rows[j - top])
        for k in range(1, radius + 1):
            weigh(taps[k], line[radius - k : radius - k + count], line[radius + k : radius + k + count], 1.0,
                  rows[j - top])  # fmt: skip
    for j in range(j0, j1):
        weigh(taps[0], rows[j - top], rows[j - top], 0.0, out[j - j0])
        for k in range(1, radius + 1):
            weigh(taps[k], rows[max(j - k, 0) - top], rows[min(j + k, height - 1) - top], 1.0, out[j - j0])


@njit(cache=True, nogil=True, borrows=True)
def weigh(tap, one, other, kept, out):
    """Write kept * out plus `tap` times two rows (n,), or the one where they are the same row, into out (n,)."""
    share = tap if kept > 0.0 else 0.5 * tap
    if kept == 0.0:
        for n in range(out.size):
            out[n] = share * (one[n] + other[n])
    else:
        for n in range(out.size):
            out[n] += share * (one[n] + other[n])


@njit(cache=True, nogil=True, borrows=True)
def box_faces(image, row, i0, faces):
    """Write the inverse depths of a box's faces as affine functions of the pixel (i0 + n, j): a + b n + c j.

    faces : (9, 3) of a, b, c; the first three are what the box's inverse depth is the least of, the others what it has
    to be at least. NEAREST and 1 / FAR stand for faces that do not count.
    """
    for axis in range(3):
        ux, uy, uz = row[1 + axis], row[4 + axis], row[7 + axis]
        offset = ux * (image.origin[0] - row[10]) + uy * (image.origin[1] - row[11]) + uz * (image.origin[2] - row[12])
        here, along, down = image.direction[0, 0], image.direction[0, 1], image.direction[1, 0]
        a = ux * here[0] + uy * here[1] + uz * here[2]
        b = ux * (along[0] - here[0]) + uy * (along[1] - here[1]) + uz * (along[2] - here[2])
        c = ux * (down[0] - here[0]) + uy * (down[1] - here[1]) + uz * (down[2] - here[2])
        a += b * i0
        half = 0.5 * row[13 + axis]
        faces[axis, 0], faces[axis, 1], faces[axis, 2] = NEAREST, 0.0, 0.0
        for side in range(2):
            away = (half if side == 0 else -half) - offset
            if abs(away) < 1e-12:
                away = 1e-12
            front = (offset > half and side == 0) or (offset < -half and side == 1)
            k = axis if front else 3 + 2 * axis + side
            faces[k, 0], faces[k, 1], faces[k, 2] = a / away, b / away, c / away
            if front:
                k = 3 + 2 * axis + side
                faces[k, 0], faces[k, 1], faces[k, 2] = 1.0 / FAR, 0.0, 0.0


@njit(cache=True, nogil=True, error_model="numpy")  # a check for zero in the loop would keep it from being vectorised
def box_depths(faces, j, out):
    """Write the depths of a box in a row of the image, FAR where it is not hit, into out (n,). faces : `box_faces`."""
    a0, a1, a2 = faces[0, 0] + faces[0, 2] * j, faces[1, 0] + faces[1, 2] * j, faces[2, 0] + faces[2, 2] * j
    a3, a4, a5 = faces[3, 0] + faces[3, 2] * j, faces[4, 0] + faces[4, 2] * j, faces[5, 0] + faces[5, 2] * j
    a6, a7, a8 = faces[6, 0] + faces[6, 2] * j, faces[7, 0] + faces[7, 2] * j, faces[8, 0] + faces[8, 2] * j
    b0, b1, b2, b3, b4, b5 = faces[0, 1], faces[1, 1], faces[2, 1], faces[3, 1], faces[4, 1], faces[5, 1]
    b6, b7, b8 = faces[6, 1], faces[7, 1], faces[8, 1]
    for n in range(out.size):
        x = float(n)
        upper = min(min(a0 + b0 * x, a1 + b1 * x), a2 + b2 * x)
        lower = max(max(max(a3 + b3 * x, a4 + b4 * x), max(a5 + b5 * x, a6 + b6 * x)), max(a7 + b7 * x, a8 + b8 * x))
        depth = 1.0 / upper
        out[n] = depth if upper >= lower else FAR


@njit(cache=True, nogil=True, borrows=True)
def depths_of(image, row, i0, j, faces, out):
    """Write the depths of a solid in pixels i0.. of a row of the image, FAR where it is not hit, into out (n,)."""
    kind = int(row[KIND])
    if kind == BOX:
        box_depths(faces, j, out)
        return
    ox, oy, oz = in_axes(row, image.origin[0] - row[10], image.origin[1] - row[11], image.origin[2] - row[12])
    for n in range(out.size):
        ray = image.direction[j, i0 + n]
        dx, dy, dz = in_axes(row, ray[0], ray[1], ray[2])
        out[n] = hit(kind, row, ox, oy, oz, dx, dy, dz)


@njit(cache=True, nogil=True)
def added_misfit(image, row, depth, misfit):
    """Return how the misfit changes when the solid `row` is added to a scene with this depth and misfit map."""
    height, width = image.depth.shape
    i0, i1, j0, j1 = bounding_rectangle(row, image.projection, height, width)
    if i0 >= i1 or j0 >= j1:
        return 0.0
    drawn, faces = np.empty(i1 - i0), np.empty((9, 3))
    if int(row[KIND]) == BOX:
        box_faces(image, row, i0, faces)
    if image.taps.size > 1:  # the solid changes the pixels that it covers and those within the blur's reach
        radius = image.taps.size - 1
        left, right = max(i0 - 2 * radius, 0), min(i1 + 2 * radius, width)
        top, bottom = max(j0 - 2 * radius, 0), min(j1 + 2 * radius, height)
        window = np.minimum(depth[top:bottom, left:right], WALL)  # what the rectangle's neighbourhood is blurred from
        for j in range(j0, j1):
            depths_of(image, row, i0, j, faces, drawn)
            part = window[j - top, i0 - left : i1 - left]
            for n in range(drawn.size):
                part[n] = min(part[n], drawn[n])
        return change_within(image, window, left, top, i0, i1, j0, j1, misfit)
    total = 0.0
    for j in range(j0, j1):
        depths_of(image, row, i0, j, faces, drawn)
        total += change_of_row(image.depth[j, i0:i1], image.weight[j, i0:i1], depth[j, i0:i1], drawn, misfit[j, i0:i1])
    return total


@njit(cache=True, nogil=True)
def added_misfits(image, rows, depth, misfit):
    """Return (K,) what `added_misfit` does for each of the solids `rows` (K, ROW) alone."""
    found = np.empty(len(rows))
    for k in range(len(rows)):
        found[k] = added_misfit(image, rows[k], depth, misfit)
    return found


@njit(cache=True, nogil=True, fastmath={"reassoc"}, borrows=True)
def change_of_row(seen, weight, depth, drawn, misfit):
    """Return how the misfit of pixels (n,) changes where what is drawn is nearer than the depth before."""
    total = 0.0
    for n in range(drawn.size):
        r = seen[n] - drawn[n]
        change = min(r * r * weight[n], LIMIT) - misfit[n]
        total += change if drawn[n] < depth[n] and weight[n] > 0.0 else 0.0
    return total


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
        drawn = window[j - top, i0 - left : i1 - left]
        total += change_of_blurred(image.depth[j, i0:i1], image.weight[j, i0:i1], drawn, blurred[j - j0],
                                   misfit[j, i0:i1])  # fmt: skip
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
