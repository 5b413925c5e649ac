"""The antialiased depth image: the mean depth over each pixel's area, not the depth at its centre.

A pixel that one face fills has the depth of its centre (the mean differs in second order only). A pixel that an
outline, a crease or a limb may cross is *mixed*: it is cut into pieces that see one face each (`canvas`), and these are
integrated. Which pixels are mixed follows from the bounds of `convex.prepare_solid`: two of them may cross
in a pixel if their difference at its centre is less than their range over it.

A flat face is represented by the centroid of its piece, since depth mostly varies by a per cent over a pixel, so that
its curvature does not count; where a face is seen so nearly edge on that it varies more, by the middles of the sides of
triangles (exact for quadratic functions). Near the limb of a curved one depth goes like the root of the distance, its
derivative like one over it: there lines across the limb are integrated in the root itself, by Gauss and Legendre, from
the limb's own place.
"""

import math

import numpy as np

from derender.compilation.cache import njit
from derender.render.raycast.canvas import (
    FACE_BITS,
    FACE_MASK,
    NOTHING,
    QUADRIC,
    curved_inverse_depth,
    extent,
    insert_solid,
    prepare,
    sort_solids,
    whole_pixel,
)
from derender.render.raycast.convex import DISCRIMINANT, FACES, LINES, discriminant, inverse_depth
from derender.scene.solids import BOX, PLANE

STEEP = 0.04  # share by which inverse depth may vary over a piece that its centroid stands for
FAR = 2.0  # pixels from the limb from where on a curved face is taken as flat: its derivative's error is 1 % there
TWO, THREE = math.sqrt(1.0 / 3.0), math.sqrt(0.6)  # nodes of Gauss and Legendre on [-1, 1]


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _centroid(corner, count, p):
    """Area and centroid of a piece with `count` corners."""
    first_x, first_y = corner[p, 0, 0], corner[p, 0, 1]
    area, sum_x, sum_y = 0.0, 0.0, 0.0
    for n in range(2, count):
        ax, ay = corner[p, n - 1, 0] - first_x, corner[p, n - 1, 1] - first_y
        bx, by = corner[p, n, 0] - first_x, corner[p, n, 1] - first_y
        part = 0.5 * (ax * by - ay * bx)
        area += part
        sum_x += part * (ax + bx)
        sum_y += part * (ay + by)
    if area < 1e-15:
        return 0.0, first_x, first_y
    return area, first_x + sum_x / (3.0 * area), first_y + sum_y / (3.0 * area)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _add_part(part_code, parts, at, code, share, x, y):
    if at < parts.shape[0]:
        part_code[at] = code
        parts[at, 0], parts[at, 1], parts[at, 2] = share, x, y
        return at + 1
    return at


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _merge_part(part_code, parts, begin, at, code, share, x, y):
    """Add a part to the one of the same flat face since `begin`, if there is one, at their common centroid."""
    for n in range(begin, at):
        if part_code[n] == code:
            parts[n, 0] += share
            share /= parts[n, 0]
            parts[n, 1] += share * (x - parts[n, 1])
            parts[n, 2] += share * (y - parts[n, 2])
            return at
    return _add_part(part_code, parts, at, code, share, x, y)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _steep(corner, count, plane, part_code, parts, p, code, column, row, at):
    """Integrate over a piece of a flat face that is seen nearly edge on: return (integral of depth, end of parts)."""
    total = 0.0
    for n in range(2, count):
        ax, ay = corner[p, n - 1, 0] - corner[p, 0, 0], corner[p, n - 1, 1] - corner[p, 0, 1]
        bx, by = corner[p, n, 0] - corner[p, 0, 0], corner[p, n, 1] - corner[p, 0, 1]
        share = (ax * by - ay * bx) / 6.0
        for side in range(3):
            first, second = (0.5 if side != 1 else 0.0), (0.5 if side != 0 else 0.0)
            x, y = corner[p, 0, 0] + first * ax + second * bx, corner[p, 0, 1] + first * ay + second * by
            at = _add_part(part_code, parts, at, code, share, column + x, row + y)
            total += share / (plane[p, 0] + plane[p, 1] * x + plane[p, 2] * y)
    return total, at


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _curved(corner, edges, count, across, all_prepared, part_code, parts, p, code, column, row, area, x, y, at):
    """Integrate over a piece of a curved face: return (integral of depth, end of the parts)."""
    k = code >> FACE_BITS
    prepared, q = all_prepared[k], DISCRIMINANT
    t, s = column - prepared[4], row - prepared[5]
    xx, xy, yy = prepared[q + 3], prepared[q + 4], prepared[q + 5]
    at_centre = prepared[q] + (prepared[q + 1] + xx * t + xy * s) * t + (prepared[q + 2] + yy * s) * s
    right, down = prepared[q + 1] + 2.0 * xx * t + xy * s, prepared[q + 2] + 2.0 * yy * s + xy * t
    ux, uy = right + 2.0 * xx * x + xy * y, down + 2.0 * yy * y + xy * x
    slope = math.sqrt(ux * ux + uy * uy)
    here = at_centre + (right + xx * x + xy * y) * x + (down + yy * y) * y
    if here > FAR * slope:
        at = _add_part(part_code, parts, at, code, area, column + x, row + y)
        return area / curved_inverse_depth(prepared, column + x, row + y), at
    ux, uy = ux / slope, uy / slope
    for n in range(count):  # the corners' places along the limb, sorted
        place = corner[p, n, 1] * ux - corner[p, n, 0] * uy
        m = n
        while m > 0 and across[m - 1] > place:
            across[m] = across[m - 1]
            m -= 1
        across[m] = place
    round_limb = prepared[0] + prepared[1] == 0.0  # a sphere's: a cylinder's is straight, and a line of its outline
    total, whole = 0.0, 0.0
    for n in range(1, count):
        width = across[n] - across[n - 1]
        if width < 1e-7:
            continue
        for first in range(2):
            place = across[n - 1] + width * (0.5 + (first - 0.5) * TWO)
            low, high, edge = 1e300, -1e300, NOTHING
            before = count - 1
            for m in range(count):
                x0, y0 = corner[p, before, 0], corner[p, before, 1]
                x1, y1 = corner[p, m, 0], corner[p, m, 1]
                start, end = y0 * ux - x0 * uy - place, y1 * ux - x1 * uy - place
                if (start > 0.0) != (end > 0.0):
                    share = start / (start - end)
                    along = (x0 + share * (x1 - x0)) * ux + (y0 + share * (y1 - y0)) * uy
                    if along < low:
                        low, edge = along, edges[p, before]
                    high = max(high, along)
                before = m
            if low >= high:
                continue
            # the discriminant along the line, and its rising root
            px, py = -uy * place, ux * place
            constant = at_centre + (right + xx * px + xy * py) * px + (down + yy * py) * py
            linear = (right + 2.0 * xx * px + xy * py) * ux + (down + 2.0 * yy * py + xy * px) * uy
            square = xx * ux * ux + xy * ux * uy + yy * uy * uy
            inner = linear * linear - 4.0 * constant * square
            root = low - 2.0 * FAR
            if inner > 0.0 and linear + math.sqrt(inner) > 0.0:
                root = max(root, -2.0 * constant / (linear + math.sqrt(inner)))
            if round_limb and edge >= 0 and (edge >> 1) // LINES == k and abs(root - low) < 0.25:
                low = root  # the chord stands for the limb
            low = max(low, root)
            if low >= high:
                continue
            begin, end = math.sqrt(low - root), math.sqrt(high - root)
            for second in range(3):
                v = 0.5 * (begin + end) + 0.5 * (end - begin) * (second - 1.0) * THREE
                along = root + v * v
                weight = (8.0 if second == 1 else 5.0) / 18.0 * (end - begin) * 2.0 * v * 0.5 * width
                i, j = column + px + along * ux, row + py + along * uy
                at = _add_part(part_code, parts, at, code, weight, i, j)
                total += weight / curved_inverse_depth(prepared, i, j)
                whole += weight
    if whole <= 0.0:
        return area / curved_inverse_depth(prepared, column + x, row + y), at
    return area * total / whole, at


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def integrate(pieces, prepared, part_code, parts, border_code, borders, count, column, row, begin, part, border):
    """Integrate depth over a pixel that is cut into `count` pieces; write its parts and borders.

    column, row : its middle. begin, part, border : where the pixel's parts begin, and where new ones and borders go.
    Return (integral of depth, end of parts, end of borders).
    """
    corner, edges, corners, plane = pieces.corner, pieces.edge, pieces.corners, pieces.plane
    codes, across = pieces.code, pieces.across
    at = part
    total = 0.0
    for p in range(count):
        code = codes[p]
        if corners[p] < 3:
            continue
        area, x, y = _centroid(corner, corners[p], p)
        if area <= 0.0:
            continue
        if code == NOTHING:
            total += area / plane[p, 0]
        elif code & FACE_MASK == QUADRIC:
            depth, at = _curved(
                corner, edges, corners[p], across, prepared, part_code, parts, p, code, column, row, area, x, y, at
            )
            total += depth
        else:
            value = plane[p, 0] + plane[p, 1] * x + plane[p, 2] * y
            if abs(plane[p, 1]) + abs(plane[p, 2]) > STEEP * value:
                least, most = extent(corner, corners[p], p, 0.0, plane[p, 1], plane[p, 2])
                if most - least > STEEP * value:
                    depth, at = _steep(corner, corners[p], plane, part_code, parts, p, code, column, row, at)
                    total += depth
                    area = 0.0
            if area > 0.0:
                total += area / value
                at = _merge_part(part_code, parts, begin, at, code, area, column + x, row + y)
        last = corners[p] - 1
        for n in range(last + 1):
            edge = edges[p, n]
            if edge >= 0 and border < borders.shape[0]:
                following = n + 1 if n < last else 0
                border_code[border, 0], border_code[border, 1] = edge, code
                borders[border, 0] = column + corner[p, n, 0]
                borders[border, 1] = row + corner[p, n, 1]
                borders[border, 2] = column + corner[p, following, 0]
                borders[border, 3] = row + corner[p, following, 1]
                border += 1
    return total, at, border


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
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


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _crossing(a, b, c, row, reach):
    """The interval of columns at which |a + b i + c row| <= reach."""
    value = a + c * row
    if b == 0.0:
        return (-1e9, 1e9) if abs(value) <= reach else (1e9, -1e9)
    first, second = (-reach - value) / b, (reach - value) / b
    first, second = min(first, second), max(first, second)
    return min(max(first, -1e9), 1e9), min(max(second, -1e9), 1e9)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
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


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _corner(prepared, column, row):
    """-1 where the ray misses, otherwise the face it enters by."""
    return _which_face(prepared, column, row) if inverse_depth(prepared, column, row) > 0.0 else -1


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
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


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
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


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _differs(code, mixed, row, column, label):
    """Has a pixel without an outline another label?"""
    return mixed[row, column] != 1 and code[row, column] >> FACE_BITS != label


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
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


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
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


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
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
    same to the last bit. A canvas whose `drawn_window` is empty draws everything, as other kinds or background require.

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
