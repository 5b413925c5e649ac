"""Draw the triangles of meshes: at pixel centres, and as pieces of mixed pixels."""

import numpy as np

from derender.compilation.cache import njit
from derender.render.raycast.canvas import FACE_BITS, FLAT, OUTLINE
from derender.render.raycast.outline import EDGE
from derender.render.raycast.pieces import CELL, bound, insert


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def draw_facets(facets, k, lines, base, inverse, code, mixed, window):
    """Draw the triangles of mesh solid k at pixel centres; pixels that outlines or creases cross become mixed."""
    for t in range(facets.first[k], facets.first[k + 1]):
        if not facets.shown[t]:
            continue
        a, b, c = facets.plane[t, 0], facets.plane[t, 1], facets.plane[t, 2]
        first = base + 3 * t
        for row in range(max(facets.bounds[t, 2], window[2]), min(facets.bounds[t, 3], window[3])):
            for column in range(max(facets.bounds[t, 0], window[0]), min(facets.bounds[t, 1], window[1])):
                least, crossed, missed = 1e300, False, False
                for side in range(3):
                    line = first + side
                    value = lines[line, EDGE] + lines[line, EDGE + 1] * column + lines[line, EDGE + 2] * row
                    reach = 0.5 * (abs(lines[line, EDGE + 1]) + abs(lines[line, EDGE + 2]))
                    least = min(least, value)
                    missed = missed or value <= -reach
                    if abs(value) < reach and facets.side[t, side] != FLAT:
                        crossed = True
                if missed:
                    continue
                if crossed:
                    mixed[row, column] = 1
                value = a + b * column + c * row
                if least >= -1e-9 and value > inverse[row, column]:
                    inverse[row, column] = value
                    code[row, column] = (k << FACE_BITS) + t


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def list_facets(facets, mixed, window):
    """Return the triangles (L,) that may be seen in the mixed pixels of a window, pixel after pixel.

    facets.listed[row, column] says where those of a pixel start and end.
    """
    listed, bounds = facets.listed, facets.bounds
    left, right, top, bottom = window[0], window[1], window[2], window[3]
    listed[top:bottom, left:right] = 0
    triangles = np.empty(0, np.int64)
    for filling in range(2):  # count them, then write them
        for t in range(facets.triangles.shape[0]):
            if not facets.shown[t]:
                continue
            for row in range(max(bounds[t, 2], top), min(bounds[t, 3], bottom)):
                for column in range(max(bounds[t, 0], left), min(bounds[t, 1], right)):
                    if mixed[row, column] != 0:
                        if filling:
                            triangles[listed[row, column, 1]] = t
                        listed[row, column, 1] += 1
        if filling == 0:
            total = 0
            for row in range(top, bottom):
                for column in range(left, right):
                    count = listed[row, column, 1]
                    listed[row, column, 0] = listed[row, column, 1] = total
                    total += count
            triangles = np.empty(total, np.int64)
    return triangles


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def insert_facets(facets, listed, pieces, prepared, lines, base, k, column, row, half, count):
    """Put the `listed` triangles that are mesh solid k's into the `count` pieces of the square about (column, row).

    Return how many pieces there are.
    """
    for t in listed:
        if facets.solid[t] != k:
            continue
        cuts, inside = 0, True
        for side in range(3):
            line, edge, outer = base + 3 * t + side, -1, -1
            if facets.side[t, side] == OUTLINE:
                edge, outer = 2 * line, 2 * line + 1
            a = lines[line, EDGE] + lines[line, EDGE + 1] * column + lines[line, EDGE + 2] * row
            b, c = lines[line, EDGE + 1], lines[line, EDGE + 2]
            cuts, inside = bound(pieces.lines, pieces.edges, cuts, a, b, c, edge, outer, half)
            if not inside:
                break
        if inside:
            pieces.code[CELL] = (k << FACE_BITS) + t
            plane = facets.plane
            pieces.plane[CELL, 0] = plane[t, 0] + plane[t, 1] * column + plane[t, 2] * row
            pieces.plane[CELL, 1], pieces.plane[CELL, 2] = plane[t, 1], plane[t, 2]
            count = insert(pieces, prepared, count, cuts, column, row)
    return count
