"""Draw the triangles of meshes: at pixel centres, and as pieces of mixed pixels."""

from derender.kernel_cache import njit
from derender.vision.raycast.canvas import FACE_BITS
from derender.vision.raycast.facets import side_matters
from derender.vision.raycast.outline import EDGE
from derender.vision.raycast.pieces import CELL, bound, insert


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
                    if abs(value) < reach and side_matters(facets, t, side) > 0:
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
    """List for every mixed pixel of a window the triangles that may be seen in it."""
    head, following = facets.head, facets.following
    used = 0
    for row in range(window[2], window[3]):
        for column in range(window[0], window[1]):
            head[row, column] = -1
    for t in range(facets.triangles.shape[0]):
        if not facets.shown[t]:
            continue
        for row in range(max(facets.bounds[t, 2], window[2]), min(facets.bounds[t, 3], window[3])):
            for column in range(max(facets.bounds[t, 0], window[0]), min(facets.bounds[t, 1], window[1])):
                if mixed[row, column] != 0 and used < following.shape[0]:
                    following[used, 0], following[used, 1] = head[row, column], t
                    head[row, column] = used
                    used += 1
    facets.used[0] = used


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def insert_facets(facets, pieces, prepared, lines, base, k, column, row, count):
    """Put the triangles of mesh solid k that the pixel may see into its `count` pieces; return how many there are."""
    at = facets.head[int(row), int(column)]
    while at >= 0:
        t = facets.following[at, 1]
        at = facets.following[at, 0]
        if facets.solid[t] != k:
            continue
        cuts, inside = 0, True
        for side in range(3):
            line, edge, outer = base + 3 * t + side, -1, -1
            if side_matters(facets, t, side) == 2:
                edge, outer = 2 * line, 2 * line + 1
            a = lines[line, EDGE] + lines[line, EDGE + 1] * column + lines[line, EDGE + 2] * row
            b, c = lines[line, EDGE + 1], lines[line, EDGE + 2]
            cuts, inside = bound(pieces.lines, pieces.edges, cuts, a, b, c, edge, outer)
            if not inside:
                break
        if inside:
            pieces.code[CELL] = (k << FACE_BITS) + t
            plane = facets.plane
            pieces.plane[CELL, 0] = plane[t, 0] + plane[t, 1] * column + plane[t, 2] * row
            pieces.plane[CELL, 1], pieces.plane[CELL, 2] = plane[t, 1], plane[t, 2]
            count = insert(pieces, prepared, count, cuts, column, row)
    return count
