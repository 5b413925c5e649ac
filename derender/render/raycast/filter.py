"""Blur a region: down strips sixteen pixels wide, the rows around the present one held in registers.

Each row of a strip is blurred along itself and pushed into a window; the window's weighted sum is the blurred pixel.
There is one kernel for each usual radius, its taps unrolled, and a plain one for wide blurs. All take

    source, result : (>= height, P) float32; `source` holds replicated edges left and right, rows beyond the image are
        replicated here.
    strip : (>= height, LANES) float32, scratch. taps : (radius + 1,) float32.
    left, right (a multiple of LANES apart), top, bottom : what to write of `result`. height : of the image.
"""

from derender.compilation.cache import Kernel, njit
from derender.render.raycast.lane_names import (
    LANES,
    add,
    blur_along_row,
    blur_window,
    load,
    multiply,
    multiply_add,
    new_window,
    push,
    splat,
    store,
)


def _make_blur(radius: int) -> Kernel:
    """Compile the blur of one radius."""

    @njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
    def blur_strips(source, result, strip, taps, left, right, top, bottom, height):
        for column in range(left, right, LANES):
            first = max(top - radius, 0)
            latest = blur_along_row(source, first, column, taps, radius)
            window = new_window(latest, radius)
            for row in range(first + 1, top + radius):
                if row < height:
                    latest = blur_along_row(source, row, column, taps, radius)
                window = push(window, latest)
            for row in range(top, bottom):
                if row + radius < height:
                    latest = blur_along_row(source, row + radius, column, taps, radius)
                window = push(window, latest)
                store(result, row, column, blur_window(window, taps))

    return blur_strips


_UNROLLED = {radius: _make_blur(radius) for radius in (1, 2, 3, 5, 6)}


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _blur_nothing(source, result, strip, taps, left, right, top, bottom, height):
    for row in range(top, bottom):
        for column in range(left, right, LANES):
            store(result, row, column, load(source, row, column))


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _blur_wide(source, result, strip, taps, left, right, top, bottom, height):
    radius = taps.shape[0] - 1
    for column in range(left, right, LANES):
        for row in range(max(top - radius, 0), min(bottom + radius, height)):
            value = multiply(splat(taps[0]), load(source, row, column))
            for k in range(1, radius + 1):
                sides = add(load(source, row, column - k), load(source, row, column + k))
                value = multiply_add(splat(taps[k]), sides, value)
            store(strip, row, 0, value)
        for row in range(top, bottom):
            value = multiply(splat(taps[0]), load(strip, row, 0))
            for k in range(1, radius + 1):
                sides = add(load(strip, max(row - k, 0), 0), load(strip, min(row + k, height - 1), 0))
                value = multiply_add(splat(taps[k]), sides, value)
            store(result, row, column, value)


def blur_for(radius: int) -> Kernel:
    """Return the kernel for a blur that reaches so many pixels."""
    return _UNROLLED.get(radius, _blur_wide) if radius else _blur_nothing
