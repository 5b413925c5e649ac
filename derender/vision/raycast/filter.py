"""Blur one row at a time: along the row into a ring buffer, then down the ring. Taps of usual radii are unrolled."""

from numba import njit

from derender.vision.raycast.lanes import (
    LANES,
    add,
    blur_along_column,
    blur_along_row,
    load,
    multiply,
    multiply_add,
    splat,
    store,
)


@njit(cache=True, nogil=True)
def blur_row(source, row, target, target_row, first, end, pad, taps, radius):
    """target[target_row, i + pad] = sum_k taps[|k|] source[row, i + pad + k], i from `first` to `end` by LANES."""
    if radius == 3:
        for column in range(first + pad, end + pad, LANES):
            store(target, target_row, column, blur_along_row(source, row, column, taps, 3))
    elif radius == 0:
        for column in range(first + pad, end + pad, LANES):
            store(target, target_row, column, load(source, row, column))
    elif radius == 2:
        for column in range(first + pad, end + pad, LANES):
            store(target, target_row, column, blur_along_row(source, row, column, taps, 2))
    elif radius == 5:
        for column in range(first + pad, end + pad, LANES):
            store(target, target_row, column, blur_along_row(source, row, column, taps, 5))
    elif radius == 6:
        for column in range(first + pad, end + pad, LANES):
            store(target, target_row, column, blur_along_row(source, row, column, taps, 6))
    else:
        for column in range(first + pad, end + pad, LANES):
            value = multiply(splat(taps[0]), load(source, row, column))
            for k in range(1, radius + 1):
                sides = add(load(source, row, column - k), load(source, row, column + k))
                value = multiply_add(splat(taps[k]), sides, value)
            store(target, target_row, column, value)


@njit(cache=True, nogil=True)
def blur_column(ring, row, height, target, first, end, pad, taps, radius):
    """target[0, i + pad] = sum_k taps[|k|] of image row clip(row + k), which is row j mod len(ring) of the ring."""
    if radius == 3:
        for column in range(first + pad, end + pad, LANES):
            store(target, 0, column, blur_along_column(ring, row, height, column, taps, 3))
    elif radius == 0:
        for column in range(first + pad, end + pad, LANES):
            store(target, 0, column, load(ring, row & (ring.shape[0] - 1), column))
    elif radius == 2:
        for column in range(first + pad, end + pad, LANES):
            store(target, 0, column, blur_along_column(ring, row, height, column, taps, 2))
    elif radius == 5:
        for column in range(first + pad, end + pad, LANES):
            store(target, 0, column, blur_along_column(ring, row, height, column, taps, 5))
    elif radius == 6:
        for column in range(first + pad, end + pad, LANES):
            store(target, 0, column, blur_along_column(ring, row, height, column, taps, 6))
    else:
        mask = ring.shape[0] - 1
        for column in range(first + pad, end + pad, LANES):
            value = multiply(splat(taps[0]), load(ring, row & mask, column))
            for k in range(1, radius + 1):
                above, below = max(row - k, 0) & mask, min(row + k, height - 1) & mask
                value = multiply_add(splat(taps[k]), add(load(ring, above, column), load(ring, below, column)), value)
            store(target, 0, column, value)
