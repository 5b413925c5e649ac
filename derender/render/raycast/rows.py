"""Draw solids into an image of inverse depth, sixteen pixels at a time: the inner loops of the engine's renderer.

Bounds are expanded about the middle column of each solid's rectangle, so that float32 loses nothing that matters
(errors below 1e-5 m), and every pixel's value is the same whichever region it was drawn in.
"""

import numpy as np

from derender.compilation.cache import njit
from derender.render.raycast.convex import DISCRIMINANT, FACES, QUADRIC_B
from derender.render.raycast.lane_names import (
    LANES,
    add,
    load,
    maximum,
    minimum,
    multiply_add,
    reciprocal,
    splat,
    square_root,
    steps_from,
    store,
    subtract,
    where_at_least,
)

FAR_BOUND = np.float32(3e38)


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _bound(prepared, face, column, row):
    """Affine bound `face` on a row: its value at `column` and its slope."""
    k = FACES + 3 * face
    slope = prepared[k + 1]
    return np.float32(prepared[k] + slope * column + prepared[k + 2] * row), np.float32(slope)


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _raise_plane(image, left, right, top, bottom, middle, pad, prepared):
    for row in range(top, bottom):
        a, b = _bound(prepared, 0, middle, row)
        start, slope = splat(a), splat(b)
        for column in range(left, right, LANES):
            value = multiply_add(slope, steps_from(column - middle), start)
            store(image, row, column + pad, maximum(value, load(image, row, column + pad)))


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _raise_box(image, left, right, top, bottom, middle, pad, prepared):
    """Three upper and five lower bounds, repeated where a box has fewer: no branch in the loop."""
    front, back = int(prepared[0]), int(prepared[1])
    second, third = min(1, front - 1), min(2, front - 1)
    seventh, eighth = front + min(3, back - 1), front + min(4, back - 1)
    for row in range(top, bottom):
        a0, b0 = _bound(prepared, 0, middle, row)
        a1, b1 = _bound(prepared, second, middle, row)
        a2, b2 = _bound(prepared, third, middle, row)
        a3, b3 = _bound(prepared, front, middle, row)
        a4, b4 = _bound(prepared, front + 1, middle, row)
        a5, b5 = _bound(prepared, front + 2, middle, row)
        a6, b6 = _bound(prepared, seventh, middle, row)
        a7, b7 = _bound(prepared, eighth, middle, row)
        for column in range(left, right, LANES):
            x = steps_from(column - middle)
            upper = minimum(
                minimum(multiply_add(splat(b0), x, splat(a0)), multiply_add(splat(b1), x, splat(a1))),
                multiply_add(splat(b2), x, splat(a2)),
            )
            lower = maximum(
                maximum(multiply_add(splat(b3), x, splat(a3)), multiply_add(splat(b4), x, splat(a4))),
                maximum(multiply_add(splat(b5), x, splat(a5)), multiply_add(splat(b6), x, splat(a6))),
            )
            lower = maximum(lower, multiply_add(splat(b7), x, splat(a7)))
            before = load(image, row, column + pad)
            store(image, row, column + pad, where_at_least(upper, maximum(lower, before), upper, before))


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _raise_quadric(image, left, right, top, bottom, middle, pad, prepared):
    """A sphere (no faces) or a cylinder (two). Everything is divided by |K|, so that the roots are centre +- root."""
    front, faces = int(prepared[0]), int(prepared[0] + prepared[1])
    a0, b0, a1, b1, a2, b2 = FAR_BOUND, np.float32(0), -FAR_BOUND, np.float32(0), -FAR_BOUND, np.float32(0)
    origin, q = int(prepared[4]), DISCRIMINANT
    outside = prepared[3] > 0.0
    scale = 1.0 / abs(prepared[3])
    square, signed = scale * scale, scale if outside else -scale
    c2, m1 = np.float32(prepared[q + 3] * square), np.float32(prepared[QUADRIC_B + 1] * signed)
    zero = splat(np.float32(0))
    for row in range(top, bottom):
        if front > 0:
            a0, b0 = _bound(prepared, 0, middle, row)
        if faces > front:
            a1, b1 = _bound(prepared, front, middle, row)
        if faces > front + 1:
            a2, b2 = _bound(prepared, front + 1, middle, row)
        s = row - prepared[5]
        c0 = np.float32((prepared[q] + (prepared[q + 2] + prepared[q + 5] * s) * s) * square)
        c1 = np.float32((prepared[q + 1] + prepared[q + 4] * s) * square)
        m0 = np.float32((prepared[QUADRIC_B] + prepared[QUADRIC_B + 2] * s) * signed)
        for column in range(left, right, LANES):
            x, t = steps_from(column - middle), steps_from(column - origin)
            discriminant = multiply_add(multiply_add(splat(c2), t, splat(c1)), t, splat(c0))
            root = square_root(maximum(discriminant, zero))
            centre = multiply_add(splat(m1), t, splat(m0))
            upper = multiply_add(splat(b0), x, splat(a0))
            lower = maximum(multiply_add(splat(b1), x, splat(a1)), multiply_add(splat(b2), x, splat(a2)))
            if outside:
                upper = minimum(upper, add(centre, root))
                lower = maximum(lower, subtract(centre, root))
            else:
                lower = maximum(lower, add(centre, root))
            before = load(image, row, column + pad)
            hit = where_at_least(upper, maximum(lower, before), upper, before)
            store(image, row, column + pad, where_at_least(discriminant, zero, hit, before))


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def raise_solid(image, left, right, top, bottom, pad, prepared, middle):
    """Raise an image of inverse depth to that of a prepared solid, columns from `left` to `right` rounded up to LANES.

    image : (H, P) float32, pixel i at column i + pad. middle : int column about which the bounds are expanded.
    """
    if prepared[2] != 0.0:
        _raise_quadric(image, left, right, top, bottom, middle, pad, prepared)
    elif prepared[1] == 0.0:
        _raise_plane(image, left, right, top, bottom, middle, pad, prepared)
    else:
        _raise_box(image, left, right, top, bottom, middle, pad, prepared)


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def raise_to_image(image, left, right, top, bottom, pad, other):
    """Raise an image of inverse depth to another (H, >= W) one without padding, columns from `left` to `right`."""
    for row in range(top, bottom):
        for column in range(left, right):
            if other[row, column] > image[row, column + pad]:
                image[row, column + pad] = other[row, column]


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def fill(image, left, right, top, bottom, pad, value):
    """Set columns from `left` to `right` (rounded up to LANES) of some rows."""
    for row in range(top, bottom):
        for column in range(left, right, LANES):
            store(image, row, column + pad, splat(value))


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def invert(image, left, right, top, bottom, pad, width):
    """Turn inverse depth into depth in a region, and replicate the image's edges where the region touches them."""
    for row in range(top, bottom):
        for column in range(left + pad, right + pad, LANES):
            store(image, row, column, reciprocal(load(image, row, column)))
        if left == 0:
            store(image, row, pad - LANES, splat(image[row, pad]))
        if right >= width:
            store(image, row, pad + width, splat(image[row, pad + width - 1]))
