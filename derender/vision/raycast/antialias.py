"""The antialiased depth image: the mean depth over each pixel's area, not the depth at its centre.

A pixel that one face fills has the depth of its centre (the mean differs in second order only). A pixel that an
outline or a crease may cross is *mixed*. If one straight line divides it, both parts are integrated exactly (area times
depth at the centroid); otherwise (corners, curved solids) it is sampled at SAMPLES points of a rank-1 lattice, whose
projections on any
direction are nearly evenly spaced, so that an edge that sweeps over the pixel changes the image almost continuously
(a 4 x 4 grid moves in quarters under an upright edge). Which pixels are mixed follows from the bounds of
`convex.prepare_solid`: two of them may cross in a pixel if their difference at its centre is less than their range
over it.
"""

import math
from typing import NamedTuple

import numpy as np

from derender.kernel_cache import njit
from derender.model.solids import BOX, MESH, PLANE
from derender.vision.raycast.convex import DISCRIMINANT, FACES, PREPARED, QUADRIC_B, inverse_depth, prepare_solid

SAMPLES = 64
GENERATOR = 19  # of the lattice: spreads the projections on every direction
QUADRIC = 3  # the "face" number of a curved surface; 0, 1, 2 are the front faces in the order of `prepared`
FACE_BITS = 24
FACE_MASK = (1 << FACE_BITS) - 1
NOTHING = -1
SPLIT = -2  # the first of a mixed pixel's codes, if a straight line divides it: then `split` holds the parts


class Canvas(NamedTuple):
    """Arrays of one antialiased rendering, made by `new_canvas` and written by `draw_antialiased`.

    Attributes
    ----------
    camera : (4,) float64 fx, fy, cx, cy. offsets : (SAMPLES, 2) float64, sample points about the pixel's centre.
    prepared : (N, PREPARED), rectangle : (N, 4) int64, of every solid; the rectangle one pixel wider than its centres'.
    inverse : (H, W) float64, inverse depth at pixel centres. code : (H, W) int64, what is seen there:
        (solid << FACE_BITS) + face, or NOTHING. mixed : (H, W) uint8, 1 where a pixel is sampled.
    depth : (H, W) float64, the antialiased image in metres.
    mixed_pixels : (H * W,) int32, row * W + column of the mixed ones. samples : (H * W, SAMPLES) int64, their codes;
        or SPLIT and the codes of two parts, whose area and centroid (share, x, y) are in split : (H * W, 2, 3).
    count : (1,) int64, how many there are.
    """

    camera: np.ndarray
    offsets: np.ndarray
    prepared: np.ndarray
    rectangle: np.ndarray
    inverse: np.ndarray
    code: np.ndarray
    mixed: np.ndarray
    depth: np.ndarray
    mixed_pixels: np.ndarray
    samples: np.ndarray
    split: np.ndarray
    count: np.ndarray


def new_canvas(camera, solids: int) -> Canvas:
    """Allocate a Canvas for a Camera and this many solids."""
    height, width = camera.height, camera.width
    k = np.arange(SAMPLES)
    offsets = np.stack([(k + 0.5) / SAMPLES, (k * GENERATOR / SAMPLES + 0.5 / SAMPLES) % 1.0], axis=1) - 0.5
    return Canvas(
        np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64),
        offsets,
        np.zeros((solids, PREPARED)),
        np.zeros((solids, 4), np.int64),
        np.zeros((height, width)),
        np.zeros((height, width), np.int64),
        np.zeros((height, width), np.uint8),
        np.zeros((height, width)),
        np.zeros(height * width, np.int32),
        np.zeros((height * width, SAMPLES), np.int64),
        np.zeros((height * width, 2, 3)),
        np.zeros(1, np.int64),
    )


@njit(cache=True, nogil=True)
def prepare_all(canvas, kinds, poses, sizes):
    """Prepare every solid and widen its rectangle by a pixel: a solid may reach into pixels whose centres it misses."""
    height, width = canvas.depth.shape
    for k in range(kinds.shape[0]):
        rectangle = canvas.rectangle[k]
        prepare_solid(kinds[k], poses[k], sizes[k], canvas.camera, width, height, canvas.prepared[k], rectangle)
        if rectangle[0] < rectangle[1]:
            rectangle[0], rectangle[1] = max(rectangle[0] - 1, 0), min(rectangle[1] + 1, width)
            rectangle[2], rectangle[3] = max(rectangle[2] - 1, 0), min(rectangle[3] + 1, height)


@njit(cache=True, nogil=True)
def _crossing(a, b, c, row, reach):
    """The interval of columns at which |a + b i + c row| <= reach."""
    value = a + c * row
    if b == 0.0:
        return (-1e9, 1e9) if abs(value) <= reach else (1e9, -1e9)
    first, second = (-reach - value) / b, (reach - value) / b
    first, second = min(first, second), max(first, second)
    return min(max(first, -1e9), 1e9), min(max(second, -1e9), 1e9)


@njit(cache=True, nogil=True)
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
def _corner(prepared, column, row):
    """-1 where the ray misses, otherwise the face it enters by."""
    return which_face(prepared, column, row) if inverse_depth(prepared, column, row) > 0.0 else -1


@njit(cache=True, nogil=True)
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
        value = (
            prepared[q]
            + prepared[q + 1] * t
            + prepared[q + 2] * s
            + prepared[q + 3] * t * t
            + prepared[q + 4] * t * s
            + prepared[q + 5] * s * s
        )
        slope = abs(prepared[q + 1] + 2.0 * prepared[q + 3] * t + prepared[q + 4] * s) + abs(
            prepared[q + 2] + 2.0 * prepared[q + 5] * s + prepared[q + 4] * t
        )
        if above != below or above != next_above or above != next_below or (above >= 0 and value < 2.0 * slope):
            mixed[row, column] = 1
        w = inverse_depth(prepared, column, row)
        if w > inverse[row, column]:
            inverse[row, column] = w
            code[row, column] = base + which_face(prepared, column, row)
        above, below = next_above, next_below


@njit(cache=True, nogil=True)
def _sample(k, prepared, column, row, offsets, best, codes, upper, face, lower):
    """Take one solid into the samples of a mixed pixel: upper, face, lower are scratch of SAMPLES numbers."""
    front, faces = int(prepared[0]), int(prepared[0] + prepared[1])
    base = k << FACE_BITS
    for n in range(SAMPLES):
        upper[n] = 1e300
        lower[n] = 0.0
        face[n] = 0
    for f in range(faces):
        p = FACES + 3 * f
        b, c = prepared[p + 1], prepared[p + 2]
        a = prepared[p] + b * column + c * row
        if f < front:
            for n in range(SAMPLES):
                bound = a + b * offsets[n, 0] + c * offsets[n, 1]
                smaller = bound < upper[n]
                upper[n] = bound if smaller else upper[n]
                face[n] = f if smaller else face[n]
        else:
            for n in range(SAMPLES):
                lower[n] = max(lower[n], a + b * offsets[n, 0] + c * offsets[n, 1])
    if prepared[2] != 0.0:
        q = DISCRIMINANT
        for n in range(SAMPLES):
            t, s = column + offsets[n, 0] - prepared[4], row + offsets[n, 1] - prepared[5]
            value = (
                prepared[q]
                + prepared[q + 1] * t
                + prepared[q + 2] * s
                + prepared[q + 3] * t * t
                + prepared[q + 4] * t * s
                + prepared[q + 5] * s * s
            )
            if value < 0.0:
                upper[n] = 0.0
                continue
            root = math.sqrt(value)
            middle = prepared[QUADRIC_B] + prepared[QUADRIC_B + 1] * t + prepared[QUADRIC_B + 2] * s
            lower[n] = max(lower[n], (middle - root) / prepared[3])
            if prepared[3] > 0.0 and (middle + root) / prepared[3] < upper[n]:
                upper[n] = (middle + root) / prepared[3]
                face[n] = QUADRIC
    for n in range(SAMPLES):
        if upper[n] >= lower[n] and upper[n] > best[n] and upper[n] < 1e299:
            best[n] = upper[n]
            codes[n] = base + face[n]


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
def _split_pixel(canvas, kinds, column, row, background, m, line, latest, candidates):
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


@njit(cache=True, nogil=True)
def _sample_pixel(canvas, kinds, column, row, background, best, upper, face, lower, codes):
    """Return the mean depth over the samples of one pixel; `codes` (SAMPLES,) says what each saw."""
    for n in range(SAMPLES):
        best[n] = 1.0 / background
        codes[n] = NOTHING
    for k in range(kinds.shape[0]):
        rectangle = canvas.rectangle[k]
        if kinds[k] != MESH and rectangle[0] <= column < rectangle[1] and rectangle[2] <= row < rectangle[3]:
            _sample(k, canvas.prepared[k], float(column), float(row), canvas.offsets, best, codes, upper, face, lower)
    total = 0.0
    for n in range(SAMPLES):
        total += 1.0 / best[n]
    return total / SAMPLES


@njit(cache=True, nogil=True)
def draw_antialiased(canvas, kinds, poses, sizes, background, window):
    """Draw the antialiased depth image inside a window of pixels.

    Parameters
    ----------
    canvas : Canvas, written. kinds : (N,) int32, poses : (N, 4, 4), sizes : (N, 3) float64, as in Solids.
    background : depth in metres of a wall behind everything: what hits nothing, or lies beyond, has this depth.
    window : (4,) int64, first column, end column, first row, end row. Outside it nothing changes, except that the list
        of mixed pixels is that of this window.
    """
    prepare_all(canvas, kinds, poses, sizes)
    inverse, code, mixed = canvas.inverse, canvas.code, canvas.mixed
    c0, c1, r0, r1 = window[0], window[1], window[2], window[3]
    for row in range(r0, r1):
        inverse[row, c0:c1] = 0.0
        code[row, c0:c1] = NOTHING
        mixed[row, c0:c1] = 0
        for k in range(kinds.shape[0]):
            rectangle = canvas.rectangle[k]
            if kinds[k] == MESH or row < rectangle[2] or row >= rectangle[3]:
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
    for row in range(r0, r1):  # where two solids cut into each other, only the labels of neighbours show it
        for column in range(c0, c1):
            here = code[row, column] >> FACE_BITS
            if mixed[row, column] == 0:
                if column + 1 < c1 and mixed[row, column + 1] == 0 and code[row, column + 1] >> FACE_BITS != here:
                    mixed[row, column] = 1
                    mixed[row, column + 1] = 1
                if row + 1 < r1 and mixed[row + 1, column] == 0 and code[row + 1, column] >> FACE_BITS != here:
                    mixed[row, column] = 1
                    mixed[row + 1, column] = 1
    best, upper, lower = np.empty(SAMPLES), np.empty(SAMPLES), np.empty(SAMPLES)
    face = np.empty(SAMPLES, np.int64)
    line, latest, candidates = np.empty(3), np.empty(3), np.empty(kinds.shape[0], np.int64)
    count = 0
    width = inverse.shape[1]
    for row in range(r0, r1):
        for column in range(c0, c1):
            if mixed[row, column] != 0:
                canvas.mixed_pixels[count] = row * width + column
                depth = _split_pixel(canvas, kinds, column, row, background, count, line, latest, candidates)
                if depth < 0.0:
                    depth = _sample_pixel(
                        canvas, kinds, column, row, background, best, upper, face, lower, canvas.samples[count]
                    )
                canvas.depth[row, column] = depth
                count += 1
            elif code[row, column] != NOTHING:
                canvas.depth[row, column] = 1.0 / inverse[row, column]
            else:
                canvas.depth[row, column] = background
    canvas.count[0] = count
