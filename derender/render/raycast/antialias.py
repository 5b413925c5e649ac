"""The antialiased depth image: the mean depth over each pixel's area, not the depth at its centre.

A pixel that one face fills has the depth of its centre (the mean differs in second order only). A pixel that an
outline, a crease or a limb may cross is *mixed*: it is cut into pieces that see one face each (`pieces`), and these are
integrated (`integral`). Which pixels are mixed follows from the bounds of `convex.prepare_solid`: two of them may cross
in a pixel if their difference at its centre is less than their range over it.
"""

import math

import numpy as np

from derender.compilation.cache import njit
from derender.render.raycast.canvas import (
    FACE_BITS,
    NOTHING,
    QUADRIC,
    curved_inverse_depth,
    insert_solid,
    prepare,
    sort_solids,
    whole_pixel,
)
from derender.render.raycast.convex import DISCRIMINANT, FACES, discriminant, inverse_depth
from derender.render.raycast.integral import integrate
from derender.scene.solids import BOX, PLANE


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _which_face(prepared, column, row):
    """The face that the ray enters a prepared solid by: the least upper bound (QUADRIC for a curved one)."""
    upper, face = 1e300, QUADRIC
    for f in range(int(prepared[0])):
        p = FACES + 3 * f
        bound = prepared[p] + prepared[p + 1] * column + prepared[p + 2] * row
        if bound < upper:
            upper, face = bound, f
    if prepared[2] != 0.0 and prepared[3] > 0.0 and curved_inverse_depth(prepared, column, row) < upper:
        face = QUADRIC
    return face


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _crossing(a, b, c, row, reach):
    """The interval of columns at which |a + b i + c row| <= reach."""
    value = a + c * row
    if b == 0.0:
        return (-1e9, 1e9) if abs(value) <= reach else (1e9, -1e9)
    first, second = (-reach - value) / b, (reach - value) / b
    first, second = min(first, second), max(first, second)
    return min(max(first, -1e9), 1e9), min(max(second, -1e9), 1e9)


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _draw_faces(k, prepared, row, first, end, inverse, code, mixed):
    """Draw one row of a solid with flat faces only and mark where two of its bounds may cross inside a pixel."""
    front, faces = int(prepared[0]), int(prepared[0] + prepared[1])
    low, high = float(first), float(end - 1)  # columns in which the whole pixel may be inside
    outer_low, outer_high = low, high
    for f in range(front):
        p = FACES + 3 * f
        for g in range(front, faces + 1):  # the last one: inverse depth 0, in front of the camera
            a, b, c = prepared[p], prepared[p + 1], prepared[p + 2]
            if g < faces:
                q = FACES + 3 * g
                a, b, c = a - prepared[q], b - prepared[q + 1], c - prepared[q + 2]
            reach = 0.5 * (abs(b) + abs(c))
            value = a + c * row
            if abs(b) < 1e-300:
                if value < -reach:
                    return
                if value < reach:
                    high = low - 1.0
                continue
            outer, inner = (-reach - value) / b, (reach - value) / b
            if b > 0.0:
                outer_low, low = max(outer_low, outer), max(low, inner)
            else:
                outer_high, high = min(outer_high, outer), min(high, inner)
    begin, stop = int(math.ceil(outer_low - 1e-9)), int(math.floor(outer_high + 1e-9)) + 1
    begin, stop = max(begin, first), min(stop, end)
    if begin >= stop:
        return
    pure_begin = min(max(int(math.ceil(min(low, 1e9))), begin), stop)
    pure_end = max(min(int(math.floor(max(high, -1e9))) + 1, stop), pure_begin)
    mixed[row, begin:pure_begin] = 1
    mixed[row, pure_end:stop] = 1
    for f in range(1, front):
        for g in range(f):
            p, q = FACES + 3 * f, FACES + 3 * g
            b, c = prepared[p + 1] - prepared[q + 1], prepared[p + 2] - prepared[q + 2]
            left, right = _crossing(prepared[p] - prepared[q], b, c, row, 0.5 * (abs(b) + abs(c)))
            for column in range(max(begin, int(math.ceil(left))), min(stop, int(math.floor(right)) + 1)):
                mixed[row, column] = 1
    base = k << FACE_BITS
    for column in range(begin, stop):
        # outside [pure_begin, pure_end) the centre may lie outside the solid, but there the samples decide
        value, face = 1e300, 0
        for f in range(front):
            p = FACES + 3 * f
            bound = prepared[p] + prepared[p + 1] * column + prepared[p + 2] * row
            if bound < value:
                value, face = bound, f
        if value > inverse[row, column] and (
            pure_begin <= column < pure_end or inverse_depth(prepared, column, row) > 0.0
        ):
            inverse[row, column] = value
            code[row, column] = base + face


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _corner(prepared, column, row):
    """-1 where the ray misses, otherwise the face it enters by."""
    return _which_face(prepared, column, row) if inverse_depth(prepared, column, row) > 0.0 else -1


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _draw_curved(k, prepared, row, first, end, inverse, code, mixed):
    """Draw one row of a sphere or cylinder; mixed where its corners disagree or the outline is within two pixels."""
    base = k << FACE_BITS
    q = DISCRIMINANT
    above, below = _corner(prepared, first - 0.5, row - 0.5), _corner(prepared, first - 0.5, row + 0.5)
    s = row - prepared[5]
    for column in range(first, end):
        next_above = _corner(prepared, column + 0.5, row - 0.5)
        next_below = _corner(prepared, column + 0.5, row + 0.5)
        t = column - prepared[4]
        value = discriminant(prepared, t, s)
        slope = abs(prepared[q + 1] + 2.0 * prepared[q + 3] * t + prepared[q + 4] * s) + abs(
            prepared[q + 2] + 2.0 * prepared[q + 5] * s + prepared[q + 4] * t
        )
        if above != below or above != next_above or above != next_below or -0.6 * slope < value < 2.0 * slope:
            mixed[row, column] = 1
        w = inverse_depth(prepared, column, row)
        if w > inverse[row, column]:
            inverse[row, column] = w
            code[row, column] = base + _which_face(prepared, column, row)
        above, below = next_above, next_below


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _draw_mixed(canvas, wall, window):
    """Divide and integrate the mixed pixels of a window: write their depths, parts and borders.

    Arrays are handed on one by one: a whole canvas costs more to pass than most pixels to divide.
    """
    pieces, prepared, rectangle, order = canvas.pieces, canvas.prepared, canvas.rectangle, canvas.order
    lines, line_counts, mixed, depth = canvas.lines, canvas.line_counts, canvas.mixed, canvas.depth
    part_range, border_range = canvas.part_range, canvas.border_range
    part_code, parts, border_code, borders = canvas.part_code, canvas.parts, canvas.border_code, canvas.borders
    width = depth.shape[1]
    part, border = canvas.used[0], canvas.used[1]
    for row in range(window[2], window[3]):
        for column in range(window[0], window[1]):
            if mixed[row, column] == 0:
                continue
            pixel, begin = row * width + column, part
            part_range[pixel, 0], border_range[pixel, 0] = part, border
            whole_pixel(pieces, 0, wall)
            count = 1
            for n in range(order.shape[0]):
                k = order[n]
                if rectangle[k, 0] <= column < rectangle[k, 1] and rectangle[k, 2] <= row < rectangle[k, 3]:
                    count = insert_solid(pieces, prepared, lines, line_counts, k, float(column), float(row), count)
            depth[row, column], part, border = integrate(
                pieces, prepared, part_code, parts, border_code, borders, count, float(column), float(row), begin, part,
                border
            )  # fmt: skip
            part_range[pixel, 1], border_range[pixel, 1] = part, border
    canvas.used[0], canvas.used[1] = part, border


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _differs(code, mixed, row, column, label):
    """Has a pixel without an outline another label?"""
    return mixed[row, column] != 1 and code[row, column] >> FACE_BITS != label


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _mark_labels(code, mixed, window, around):
    """Mark pixels between which only the label changes: solids that cut into each other show in no outline.

    Marks are 2 and follow from pixels with and without an outline alone, so each can be made by itself. around : the
    window of what has been drawn, in which neighbours count.
    """
    for row in range(window[2], window[3]):
        for column in range(window[0], window[1]):
            if mixed[row, column] == 1:
                continue
            here = code[row, column] >> FACE_BITS
            if (
                (column > around[0] and _differs(code, mixed, row, column - 1, here))
                or (column + 1 < around[1] and _differs(code, mixed, row, column + 1, here))
                or (row > around[2] and _differs(code, mixed, row - 1, column, here))
                or (row + 1 < around[3] and _differs(code, mixed, row + 1, column, here))
            ):
                mixed[row, column] = 2


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _draw_window(canvas, kinds, background, window, around):
    """Draw the prepared solids inside a window, within the window `around` of all that has been drawn."""
    inverse, code, mixed = canvas.inverse, canvas.code, canvas.mixed
    c0, c1, r0, r1 = window[0], window[1], window[2], window[3]
    for row in range(r0, r1):
        inverse[row, c0:c1] = 0.0
        code[row, c0:c1] = NOTHING
        mixed[row, c0:c1] = 0
        for k in range(kinds.shape[0]):
            rectangle = canvas.rectangle[k]
            if row < rectangle[2] or row >= rectangle[3]:
                continue
            first, end = max(rectangle[0], c0), min(rectangle[1], c1)
            if first >= end:
                continue
            if kinds[k] == BOX or kinds[k] == PLANE:
                _draw_faces(k, canvas.prepared[k], row, first, end, inverse, code, mixed)
            else:
                _draw_curved(k, canvas.prepared[k], row, first, end, inverse, code, mixed)
    wall = 1.0 / background
    for row in range(r0, r1):
        for column in range(c0, c1):
            if inverse[row, column] <= wall:
                code[row, column] = NOTHING
    _mark_labels(code, mixed, window, around)
    for row in range(r0, r1):
        for column in range(c0, c1):
            if mixed[row, column] == 0:
                seen = code[row, column] != NOTHING
                canvas.depth[row, column] = 1.0 / inverse[row, column] if seen else background
    _draw_mixed(canvas, wall, window)


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _include(rectangle, margin, window, dirty):
    """Enlarge `dirty` by a rectangle with a margin, as far as it lies in the window."""
    if rectangle[0] < rectangle[1] and rectangle[2] < rectangle[3]:
        dirty[0] = max(min(dirty[0], rectangle[0] - margin), window[0])
        dirty[1] = min(max(dirty[1], rectangle[1] + margin), window[1])
        dirty[2] = max(min(dirty[2], rectangle[2] - margin), window[2])
        dirty[3] = min(max(dirty[3], rectangle[3] + margin), window[3])


@njit(cache=True, nogil=True)
def draw_antialiased(canvas, kinds, poses, sizes, background, window):
    """Draw the antialiased depth image inside a window of pixels.

    What the canvas shows already is kept: of the same window only the pixels are drawn, `canvas.dirty`, in which a
    solid that has moved or grown since was or is, and their neighbours, whose marks it may change. The result is the
    same to the last bit. `forget` makes it draw everything, as a change of kinds or background requires.

    canvas : Canvas, written. kinds : (N,) int32, poses : (N, 4, 4), sizes : (N, 3) float64, as in Solids.
    background : depth in metres of a wall behind everything: what hits nothing, or lies beyond, has this depth.
    window : (4,) int64, first column, end column, first row, end row. Outside it nothing changes.
    """
    dirty, last, rectangle = canvas.dirty, canvas.drawn_window, canvas.rectangle
    all_of_it = canvas.used[0] > canvas.parts.shape[0] // 2 or canvas.used[1] > canvas.borders.shape[0] // 2
    for n in range(4):
        all_of_it = all_of_it or last[n] != window[n]
    dirty[0], dirty[1], dirty[2], dirty[3] = window[1], window[0], window[3], window[2]
    for k in range(kinds.shape[0]):
        changed = all_of_it or not (
            np.array_equal(canvas.drawn_pose[k], poses[k]) and np.array_equal(canvas.drawn_size[k], sizes[k])
        )
        if changed:
            _include(rectangle[k], 1, window, dirty)  # where it was
            prepare(canvas, k, kinds, poses, sizes)
            _include(rectangle[k], 1, window, dirty)
            canvas.drawn_pose[k] = poses[k]
            canvas.drawn_size[k] = sizes[k]
    sort_solids(canvas, kinds, poses)
    if all_of_it:
        canvas.used[:] = 0
        for n in range(4):
            last[n] = dirty[n] = window[n]
    if dirty[0] < dirty[1] and dirty[2] < dirty[3]:
        _draw_window(canvas, kinds, background, dirty, window)
    else:
        dirty[:] = 0
