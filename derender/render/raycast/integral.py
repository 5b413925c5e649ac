"""Integrals over the pieces of a pixel: depth, and the places that stand for the rest when derivatives are taken.

A flat face is represented by the centroid of its piece, since depth mostly varies by a per cent over a pixel, so that
its curvature does not count; where a face is seen so nearly edge on that it varies more, by the middles of the sides of
triangles (exact for quadratic functions). Near the limb of a curved one depth goes like the root of the distance, its
derivative like one over it: there lines across the limb are integrated in the root itself, by Gauss and Legendre, from
the limb's own place.
"""

import math

from derender.compilation.cache import njit
from derender.render.raycast.canvas import FACE_BITS, FACE_MASK, NOTHING, QUADRIC, curved_inverse_depth, extent
from derender.render.raycast.convex import DISCRIMINANT
from derender.render.raycast.outline import LINES

STEEP = 0.04  # share by which inverse depth may vary over a piece that its centroid stands for
FAR = 2.0  # pixels from the limb from where on a curved face is taken as flat: its derivative's error is 1 % there
TWO, THREE = math.sqrt(1.0 / 3.0), math.sqrt(0.6)  # nodes of Gauss and Legendre on [-1, 1]


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
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


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _add_part(part_code, parts, at, code, share, x, y):
    if at < parts.shape[0]:
        part_code[at] = code
        parts[at, 0], parts[at, 1], parts[at, 2] = share, x, y
        return at + 1
    return at


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
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


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
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


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
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


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
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
