"""What the antialiased renderer draws on: rows of inverse depth, codes of faces; pixels cut into pieces of one face.

One piece, the whole pixel, sees nothing at first. Solids are put in one after the other, each as cells: a face inside
the outline. Of every piece what lies in the cell and behind the face goes over to it; the rest of the piece stays, in
convex pieces again. All this is clipping by lines, since inverse depth is affine over a flat face. Where a curved face
and another cut into each other the line is that of the affine function nearest to their difference.
"""

import math
from typing import NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.compilation.cache import njit
from derender.render.raycast.convex import (
    FACES,
    LINE,
    LINES,
    PREPARED,
    QUADRIC_B,
    discriminant,
    draw_outline,
    prepare_solid,
)
from derender.scene.solids import PLANE

FACE_BITS = 24
FACE_MASK = (1 << FACE_BITS) - 1
QUADRIC = FACE_MASK  # the "face" number of a curved surface; others count the front faces in the order of `prepared`
NOTHING = -1
PIECES: int = 512  # of one pixel at most
CORNERS: int = 24  # of one piece at most
ROOM = 6  # parts and borders to a pixel, on average, that there is room for
SPARE = 1 << 14  # and so many more


class Pieces(NamedTuple):
    """Scratch for one pixel cut into convex polygons, in pixels from its centre.

    edge : (PIECES, CORNERS) int64, what the edge from this corner to the next is: -1, or twice the number of a line of
        an outline, one more on its outer side.
    lines : (LINES, 3) float64, edges : (LINES, 2) int64, the lines that bound what is put in, and their edges inside
        and outside.
    """

    corner: np.ndarray  # (PIECES, CORNERS, 2) float64, corners in order
    edge: np.ndarray
    corners: np.ndarray  # (PIECES,) int64
    code: np.ndarray  # (PIECES,) int64
    plane: np.ndarray  # (PIECES, 3) float64, inverse depth at the centre and its slopes, of flat ones
    lines: np.ndarray
    edges: np.ndarray
    across: np.ndarray  # (CORNERS,) float64, of a quadrature


class Canvas(NamedTuple):
    """Arrays of one antialiased rendering, made by `new_canvas` and written by `draw_antialiased`.

    prepared : (N, PREPARED), rectangle : (N, 4) int64, of every solid; the rectangle one pixel wider than its centres'.
    mixed : (H, W) uint8, not 0 where a pixel is divided: 1 for an outline or crease, 2 for a neighbour of another
        label.
    part_range, border_range : (H * W, 2) int64, first and end of each mixed pixel's parts and borders.
    used : (2,) int64, how many parts and borders are taken; those of pixels drawn again since are among them.
    drawn_pose : (N, 4, 4), drawn_size : (N, 3) float64, drawn_window : (4,) int64, of what was drawn last; an empty
        window if nothing was.
    part_code : (P,) int64, parts : (P, 3) float64, share of the pixel and the image point (column, row) that stands for
        it. What sees nothing is left out.
    """

    camera: np.ndarray  # (4,) float64 fx, fy, cx, cy
    prepared: np.ndarray
    rectangle: np.ndarray
    lines: np.ndarray  # (N LINES, LINE) float64, outlines, LINES of each solid
    line_counts: np.ndarray  # (N, 2) int64, see `draw_outline`
    order: np.ndarray  # (N,) int64, the solids from near to far, planes last: what is hidden then cuts nothing
    inverse: np.ndarray  # (H, W) float64, inverse depth at pixel centres
    code: np.ndarray  # (H, W) int64, what is seen there: (solid << FACE_BITS) + face, or NOTHING
    mixed: np.ndarray
    depth: np.ndarray  # (H, W) float64, the antialiased image in metres
    part_range: np.ndarray
    border_range: np.ndarray
    used: np.ndarray
    drawn_pose: np.ndarray
    drawn_size: np.ndarray
    drawn_window: np.ndarray
    dirty: np.ndarray  # (4,) int64, the pixels that the last drawing drew
    part_code: np.ndarray
    parts: np.ndarray
    border_code: np.ndarray  # (B, 2) int64, the edge (see Pieces) and the code of the piece that it bounds
    borders: np.ndarray  # (B, 4) float64, column and row of its ends
    pieces: Pieces


def new_canvas(camera: Camera, solids: int) -> Canvas:
    """Allocate a Canvas for a Camera and this many solids, none of them a mesh."""
    height, width = camera.height, camera.width
    pixels = height * width
    room = ROOM * pixels + SPARE
    pieces = Pieces(
        np.zeros((PIECES, CORNERS, 2)),
        np.zeros((PIECES, CORNERS), np.int64),
        np.zeros(PIECES, np.int64),
        np.zeros(PIECES, np.int64),
        np.zeros((PIECES, 3)),
        np.zeros((LINES, 3)),
        np.zeros((LINES, 2), np.int64),
        np.zeros(CORNERS),
    )
    return Canvas(
        np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64),
        np.zeros((solids, PREPARED)),
        np.zeros((solids, 4), np.int64),
        np.zeros((solids * LINES, LINE)),
        np.zeros((solids, 2), np.int64),
        np.arange(solids),
        np.zeros((height, width)),
        np.zeros((height, width), np.int64),
        np.zeros((height, width), np.uint8),
        np.zeros((height, width)),
        np.zeros((pixels, 2), np.int64),
        np.zeros((pixels, 2), np.int64),
        np.zeros(2, np.int64),
        np.zeros((solids, 4, 4)),
        np.zeros((solids, 3)),
        np.zeros(4, np.int64),
        np.zeros(4, np.int64),
        np.zeros(room, np.int64),
        np.zeros((room, 3)),
        np.zeros((room, 2), np.int64),
        np.zeros((room, 4)),
        pieces,
    )


@njit(cache=True, nogil=True, borrows=True)
def prepare(canvas, k, kinds, poses, sizes):
    """Prepare solid k: bounds, outline, and rectangle, a pixel wider: it may reach pixels whose centres it misses."""
    height, width = canvas.depth.shape
    rectangle = canvas.rectangle[k]
    prepare_solid(kinds[k], poses[k], sizes[k], canvas.camera, width, height, canvas.prepared[k], rectangle)
    if rectangle[0] < rectangle[1]:
        rectangle[0], rectangle[1] = max(rectangle[0] - 1, 0), min(rectangle[1] + 1, width)
        rectangle[2], rectangle[3] = max(rectangle[2] - 1, 0), min(rectangle[3] + 1, height)
        lines = canvas.lines[k * LINES : (k + 1) * LINES]
        draw_outline(kinds[k], poses[k], sizes[k], canvas.camera, lines, canvas.line_counts[k])


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _farther(kinds, poses, first, second):
    """Does the first solid come after the second?"""
    return kinds[first] == PLANE or poses[first, 2, 3] > poses[second, 2, 3]


@njit(cache=True, nogil=True, borrows=True)
def sort_solids(canvas, kinds, poses):
    """Write the solids' order."""
    for k in range(kinds.shape[0]):
        n = k
        while n > 0 and kinds[k] != PLANE and _farther(kinds, poses, canvas.order[n - 1], k):
            canvas.order[n] = canvas.order[n - 1]
            n -= 1
        canvas.order[n] = k


FIRST, SECOND, CELL = PIECES - 1, PIECES - 2, PIECES - 3  # rows for what is left of a piece, and for the cell's face
THIN = 1e-9  # pixels: a line that cuts off less does not cut
EQUAL = 1e-12  # of inverse depths, 1/metres: what is nearer by less is not nearer
ROUGH = 0.03  # share of the largest difference that the chords of an outline may feign


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def curved_inverse_depth(prepared, column, row):
    """Inverse depth of the near side of a sphere or endless cylinder; at its limb where the ray misses."""
    t, s = column - prepared[4], row - prepared[5]
    middle = prepared[QUADRIC_B] + prepared[QUADRIC_B + 1] * t + prepared[QUADRIC_B + 2] * s
    return (middle + math.sqrt(max(discriminant(prepared, t, s), 0.0))) / prepared[3]


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _value(code, plane, prepared, slot, column, row, x, y):
    """Inverse depth of the face of a piece, or of the cell, at an offset from the pixel's centre."""
    here = code[slot]
    if here != NOTHING and here & FACE_MASK == QUADRIC:
        return curved_inverse_depth(prepared[here >> FACE_BITS], column + x, row + y)
    return plane[slot, 0] + plane[slot, 1] * x + plane[slot, 2] * y


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def whole_pixel(pieces, slot, wall):
    """Make a piece the whole pixel, seeing a wall at this inverse depth."""
    for n in range(4):
        pieces.corner[slot, n, 0] = -0.5 if n == 0 or n == 3 else 0.5
        pieces.corner[slot, n, 1] = -0.5 if n < 2 else 0.5
        pieces.edge[slot, n] = NOTHING
    pieces.corners[slot] = 4
    pieces.code[slot] = NOTHING
    pieces.plane[slot, 0], pieces.plane[slot, 1], pieces.plane[slot, 2] = wall, 0.0, 0.0


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def extent(corner, count, slot, a, b, c):
    """Least and greatest value of a + b x + c y over a piece with `count` corners."""
    least, most = 1e300, -1e300
    for n in range(count):
        value = a + b * corner[slot, n, 0] + c * corner[slot, n, 1]
        least, most = min(least, value), max(most, value)
    return least, most


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _put(corner, edges, slot, count, x, y, edge):
    if count < CORNERS:
        corner[slot, count, 0], corner[slot, count, 1] = x, y
        edges[slot, count] = edge
        return count + 1
    return count


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _divide(corner, edges, corners, source, inside, outside, a, b, c, inner_edge, outer_edge):
    """Cut a piece where a + b x + c y = 0; the positive part becomes piece `inside`, the other `outside`."""
    last = corners[source] - 1
    before_x, before_y = corner[source, last, 0], corner[source, last, 1]
    before, edge = a + b * before_x + c * before_y, edges[source, last]
    kept, left = 0, 0
    for n in range(last + 1):
        x, y = corner[source, n, 0], corner[source, n, 1]
        value = a + b * x + c * y
        if (value > 0.0) != (before > 0.0):
            share = before / (before - value)
            u, v = before_x + share * (x - before_x), before_y + share * (y - before_y)
            entering = value > 0.0
            kept = _put(corner, edges, inside, kept, u, v, edge if entering else inner_edge)
            left = _put(corner, edges, outside, left, u, v, outer_edge if entering else edge)
        following = edges[source, n]
        if value > 0.0:
            kept = _put(corner, edges, inside, kept, x, y, following)
        else:
            left = _put(corner, edges, outside, left, x, y, following)
        before_x, before_y, before, edge = x, y, value, following
    corners[inside], corners[outside] = kept, left


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _compare(corner, count, code, plane, prepared, polygon, owner, column, row):
    """Is the cell before a piece's face, over a polygon? (0 no, 1 yes, 2 where a + b x + c y > 0, a, b, c).

    For curved faces: the affine function is fitted to the difference at the corners.
    """
    least, most = 1e300, -1e300
    sx, sy, sd, sxx, sxy, syy, sxd, syd = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for n in range(count):
        x, y = corner[polygon, n, 0], corner[polygon, n, 1]
        difference = _value(code, plane, prepared, CELL, column, row, x, y)
        difference -= _value(code, plane, prepared, owner, column, row, x, y)
        least, most = min(least, difference), max(most, difference)
        sx, sy, sd = sx + x, sy + y, sd + difference
        sxx, sxy, syy = sxx + x * x, sxy + x * y, syy + y * y
        sxd, syd = sxd + x * difference, syd + y * difference
    if most <= max(-ROUGH * least, EQUAL):
        return 0, 0.0, 0.0, 0.0
    if least >= -ROUGH * most:
        return 1, 0.0, 0.0, 0.0
    sx, sy, sd = sx / count, sy / count, sd / count
    sxx, sxy, syy = sxx / count - sx * sx, sxy / count - sx * sy, syy / count - sy * sy
    sxd, syd = sxd / count - sx * sd, syd / count - sy * sd
    determinant = sxx * syy - sxy * sxy
    if determinant < 1e-18:
        return (1 if sd > 0.0 else 0), 0.0, 0.0, 0.0
    b, c = (syy * sxd - sxy * syd) / determinant, (sxx * syd - sxy * sxd) / determinant
    return 2, sd - b * sx - c * sy, b, c


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def insert(pieces, prepared, count, cuts, column, row):
    """Put the cell, a face bounded by the first `cuts` lines, into the `count` pieces of a pixel; return how many."""
    corner, edge, corners, code, plane = pieces.corner, pieces.edge, pieces.corners, pieces.code, pieces.plane
    lines, edges = pieces.lines, pieces.edges
    cell = code[CELL]
    curved = cell & FACE_MASK == QUADRIC
    for p in range(count):
        owner = code[p]
        flat = not curved and (owner == NOTHING or owner & FACE_MASK != QUADRIC)
        fresh, current, seen = count, p, True
        state, a, b, c = 2, 0.0, 0.0, 0.0
        if flat:
            a = plane[CELL, 0] - plane[p, 0]
            b, c = plane[CELL, 1] - plane[p, 1], plane[CELL, 2] - plane[p, 2]
            least, most = extent(corner, corners[p], p, a, b, c)
            if most <= EQUAL:
                continue
        for n in range(cuts):  # most pieces lie outside one line: look before cutting
            least, most = extent(corner, corners[p], p, lines[n, 0], lines[n, 1], lines[n, 2])
            if most <= THIN:
                seen = False
                break
        for n in range(cuts if seen else 0):
            least, most = extent(corner, corners[current], current, lines[n, 0], lines[n, 1], lines[n, 2])
            if most <= THIN or fresh >= CELL - 1:
                seen = False
                break
            if least < -THIN:
                target = SECOND if current == FIRST else FIRST
                _divide(corner, edge, corners, current, target, fresh, lines[n, 0], lines[n, 1], lines[n, 2],
                        edges[n, 0], edges[n, 1])  # fmt: skip
                fresh, current = fresh + 1, target
        if not seen:
            continue
        if not flat:
            state, a, b, c = _compare(corner, corners[current], code, plane, prepared, current, p, column, row)
        if state == 2:
            least, most = extent(corner, corners[current], current, a, b, c)
            if most <= EQUAL:
                continue
            if least < -EQUAL:
                if fresh >= CELL - 1:
                    continue
                target = SECOND if current == FIRST else FIRST
                _divide(corner, edge, corners, current, target, fresh, a, b, c, NOTHING, NOTHING)
                fresh, current = fresh + 1, target
        elif state == 0:
            continue
        for n in range(count, fresh):
            code[n] = owner
            for axis in range(3):
                plane[n, axis] = plane[p, axis]
        code[p] = cell
        for axis in range(3):
            plane[p, axis] = plane[CELL, axis]
        if current != p:
            corners[p] = corners[current]
            for n in range(corners[current]):
                corner[p, n, 0], corner[p, n, 1] = corner[current, n, 0], corner[current, n, 1]
                edge[p, n] = edge[current, n]
        count = fresh
    return count


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def bound(lines, edges, cuts, a, b, c, inner_edge, outer_edge):
    """Append a line to the cell's if it passes through the pixel. Return (lines, False if nothing is inside)."""
    reach = 0.5 * (abs(b) + abs(c))
    if a <= -reach:
        return cuts, False
    if a < reach:
        lines[cuts, 0], lines[cuts, 1], lines[cuts, 2] = a, b, c
        edges[cuts, 0], edges[cuts, 1] = inner_edge, outer_edge
        return cuts + 1, True
    return cuts, True


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _set_face(pieces, prepared, k, face, column, row):
    """Make a flat face of solid k that of the cell."""
    p = FACES + 3 * face
    pieces.code[CELL] = (k << FACE_BITS) + face
    pieces.plane[CELL, 0] = prepared[p] + prepared[p + 1] * column + prepared[p + 2] * row
    pieces.plane[CELL, 1], pieces.plane[CELL, 2] = prepared[p + 1], prepared[p + 2]


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _keep_needed(pieces, polygon, first, cuts):
    """Cut polygon FIRST or SECOND by the lines from `first` on and drop those that leave no edge on it.

    Many chords of an outline may pass a pixel with their far ends; each would cost every piece a cut.
    Return (lines, the polygon that is left or -1 if there is none).
    """
    corner, edge, corners, lines, edges = pieces.corner, pieces.edge, pieces.corners, pieces.lines, pieces.edges
    for n in range(first, cuts):
        a, b, c = lines[n, 0], lines[n, 1], lines[n, 2]
        least, most = extent(corner, corners[polygon], polygon, a, b, c)
        if most <= THIN:
            return first, -1
        if least < -THIN:
            target = SECOND if polygon == FIRST else FIRST
            _divide(corner, edge, corners, polygon, target, CELL, a, b, c, n, NOTHING)
            polygon = target
    kept = first
    for n in range(first, cuts):
        for m in range(corners[polygon]):
            if edge[polygon, m] == n:
                for axis in range(3):
                    lines[kept, axis] = lines[n, axis]
                edges[kept, 0], edges[kept, 1] = edges[n, 0], edges[n, 1]
                edge[polygon, m] = NOTHING  # numbers of lines change
                kept += 1
                break
    return kept, polygon


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def insert_solid(pieces, everything, lines, line_counts, k, column, row, count):
    """Put a convex solid into the `count` pieces of the pixel at (column, row); return how many there are then."""
    prepared, outlines, rims, base = everything[k], line_counts[k, 0], line_counts[k, 1], k * LINES
    cuts, inside = 0, True
    for n in range(outlines):
        a = lines[base + n, 0] + lines[base + n, 1] * column + lines[base + n, 2] * row
        b, c, edge = lines[base + n, 1], lines[base + n, 2], 2 * (base + n)
        cuts, inside = bound(pieces.lines, pieces.edges, cuts, a, b, c, edge, edge + 1)
        if not inside:
            return count
    curved = prepared[2] != 0.0 and prepared[3] > 0.0
    polygon = FIRST
    if cuts > 1 or curved:
        whole_pixel(pieces, FIRST, 0.0)
        cuts, polygon = _keep_needed(pieces, polygon, 0, cuts)
        if polygon < 0:
            return count
    front = int(prepared[0])
    if curved:
        side = (k << FACE_BITS) + QUADRIC
        ends, inside = cuts, front > 0
        for n in range(outlines, rims):
            a, b, c = lines[base + n, 0], lines[base + n, 1], lines[base + n, 2]
            a += b * column + c * row
            ends, inside = bound(pieces.lines, pieces.edges, ends, a, b, c, NOTHING, NOTHING)
            if not inside:
                break
        if inside:
            ends, polygon = _keep_needed(pieces, polygon, cuts, ends)
            inside = polygon >= 0
        if not inside:
            pieces.code[CELL] = side
            return insert(pieces, everything, count, cuts, column, row)
        for n in range(cuts, ends):  # between two chords of the rim the side ends at the second
            for axis in range(3):
                pieces.lines[n, axis] = -pieces.lines[n, axis]
            pieces.code[CELL] = side
            count = insert(pieces, everything, count, n + 1, column, row)
            for axis in range(3):
                pieces.lines[n, axis] = -pieces.lines[n, axis]
        _set_face(pieces, prepared, k, 0, column, row)
        return insert(pieces, everything, count, ends, column, row)
    for face in range(front):
        _set_face(pieces, prepared, k, face, column, row)
        ends, inside = cuts, True
        for other in range(front):
            if other != face and inside:
                p = FACES + 3 * other
                a = prepared[p] + prepared[p + 1] * column + prepared[p + 2] * row - pieces.plane[CELL, 0]
                b, c = prepared[p + 1] - pieces.plane[CELL, 1], prepared[p + 2] - pieces.plane[CELL, 2]
                ends, inside = bound(pieces.lines, pieces.edges, ends, a, b, c, NOTHING, NOTHING)
        if inside:
            count = insert(pieces, everything, count, ends, column, row)
    return count
