"""Pixels that one straight line divides: the exact integral of depth over each part."""

import math

from derender.kernel_cache import njit
from derender.model.solids import BOX, PLANE
from derender.vision.raycast.canvas import FACE_BITS, NOTHING, QUADRIC, SPLIT
from derender.vision.raycast.convex import DISCRIMINANT, FACES, QUADRIC_B, inverse_depth


@njit(cache=True, nogil=True)
def which_face(prepared, column, row):
    """The face that the ray enters a prepared solid by: the least upper bound (QUADRIC for a curved one)."""
    upper, face = 1e300, QUADRIC
    for f in range(int(prepared[0])):
        p = FACES + 3 * f
        bound = prepared[p] + prepared[p + 1] * column + prepared[p + 2] * row
        if bound < upper:
            upper, face = bound, f
    if prepared[2] != 0.0 and prepared[3] > 0.0:
        q, t, s = DISCRIMINANT, column - prepared[4], row - prepared[5]
        discriminant = (
            prepared[q]
            + prepared[q + 1] * t
            + prepared[q + 2] * s
            + prepared[q + 3] * t * t
            + prepared[q + 4] * t * s
            + prepared[q + 5] * s * s
        )
        middle = prepared[QUADRIC_B] + prepared[QUADRIC_B + 1] * t + prepared[QUADRIC_B + 2] * s
        if (middle + math.sqrt(max(discriminant, 0.0))) / prepared[3] < upper:
            face = QUADRIC
    return face


@njit(cache=True, nogil=True)
def _bounds_in_pixel(prepared, column, row, line):
    """Look at one flat-faced solid in one pixel: return (lines, full, least, most).

    lines : how many of its outlines and creases may pass, -1 if it is not in the pixel at all; `line` (3,) becomes the
    last of them as value at the centre and slopes. full : no outline passes. least, most : of its inverse depth there.
    """
    front, faces = int(prepared[0]), int(prepared[0] + prepared[1])
    lines, full = 0, True
    least, most = 1e300, 1e300
    for f in range(front):
        p = FACES + 3 * f
        a, b, c = prepared[p] + prepared[p + 1] * column + prepared[p + 2] * row, prepared[p + 1], prepared[p + 2]
        spread = 0.5 * (abs(b) + abs(c))
        least, most = min(least, a - spread), min(most, a + spread)
        if a < -spread:
            return -1, False, 0.0, 0.0
        if a < spread:  # the horizon
            lines, full = lines + 1, False
            line[0], line[1], line[2] = a, b, c
        for g in range(faces):
            if g == f or (g < front and g < f):
                continue
            q = FACES + 3 * g
            db, dc = b - prepared[q + 1], c - prepared[q + 2]
            value = a - (prepared[q] + prepared[q + 1] * column + prepared[q + 2] * row)
            reach = 0.5 * (abs(db) + abs(dc))
            if abs(value) < reach:
                lines += 1
                line[0], line[1], line[2] = value, db, dc
                if g >= front:
                    full = False
            elif g >= front and value < 0.0:
                return -1, False, 0.0, 0.0
    return lines, full, least, most


@njit(cache=True, nogil=True)
def _half_square(line, out):
    """Area and centroid (area, x, y) of the part of the unit square about 0 where line[0] + line[1] x + line[2] y >
    0."""
    area, sum_x, sum_y = 0.0, 0.0, 0.0
    first_x, first_y, last_x, last_y = 0.0, 0.0, 0.0, 0.0
    count = 0
    for k in range(4):
        x0, y0 = (-0.5 if k == 0 or k == 3 else 0.5), (-0.5 if k < 2 else 0.5)
        x1, y1 = (0.5 if k < 2 else -0.5), (0.5 if k == 1 or k == 2 else -0.5)
        start, end = line[0] + line[1] * x0 + line[2] * y0, line[0] + line[1] * x1 + line[2] * y1
        for stage in range(2):
            if stage == 0:
                if start <= 0.0:
                    continue
                x, y = x0, y0
            else:
                if (start > 0.0) == (end > 0.0):
                    continue
                share = start / (start - end)
                x, y = x0 + share * (x1 - x0), y0 + share * (y1 - y0)
            if count == 0:
                first_x, first_y = x, y
            else:  # fan from the first corner
                ax, ay, bx, by = last_x - first_x, last_y - first_y, x - first_x, y - first_y
                part = 0.5 * (ax * by - ay * bx)
                area += part
                sum_x += part * (first_x + (ax + bx) / 3.0)
                sum_y += part * (first_y + (ay + by) / 3.0)
            last_x, last_y = x, y
            count += 1
    out[0] = area
    out[1], out[2] = (sum_x / area, sum_y / area) if area > 1e-12 else (0.0, 0.0)


@njit(cache=True, nogil=True)
def split_pixel(canvas, kinds, column, row, background, m, line, latest, candidates):
    """Integrate a pixel that at most one straight line divides, exactly; return its mean depth, or -1 if it has
    more."""
    count, lines = 0, 0
    nearest_full = 0.0
    for k in range(kinds.shape[0]):
        rectangle = canvas.rectangle[k]
        if not (rectangle[0] <= column < rectangle[1] and rectangle[2] <= row < rectangle[3]):
            continue
        if kinds[k] != BOX and kinds[k] != PLANE:
            return -1.0
        found, full, least, _ = _bounds_in_pixel(canvas.prepared[k], float(column), float(row), latest)
        if found >= 0:
            if full:
                nearest_full = max(nearest_full, least)
            candidates[count] = k
            count += 1
    kept, full_ones = 0, 0
    for n in range(count):  # what lies wholly behind a solid that fills the pixel does not count
        k = candidates[n]
        found, full, _, most = _bounds_in_pixel(canvas.prepared[k], float(column), float(row), latest)
        if most >= nearest_full:
            candidates[kept] = k
            kept += 1
            full_ones += full
            if found > 0:
                line[:] = latest
                lines += found
    if lines > 1 or full_ones > 1:
        return -1.0
    first, second = canvas.split[m, 0], canvas.split[m, 1]
    if lines == 1:
        _half_square(line, first)
    else:
        first[0], first[1], first[2] = 1.0, 0.0, 0.0
    second[0] = 1.0 - first[0]
    if second[0] > 1e-12:
        second[1], second[2] = -first[0] * first[1] / second[0], -first[0] * first[2] / second[0]
    total = 0.0
    canvas.samples[m, 0] = SPLIT
    for part in range(2):
        share = canvas.split[m, part]
        best, code = 1.0 / background, NOTHING
        if share[0] > 1e-12:
            x, y = column + share[1], row + share[2]
            for n in range(kept):
                prepared = canvas.prepared[candidates[n]]
                value = inverse_depth(prepared, x, y)
                if value > best:
                    best, code = value, (candidates[n] << FACE_BITS) + which_face(prepared, x, y)
            total += share[0] / best
        canvas.samples[m, 1 + part] = code
    return total
