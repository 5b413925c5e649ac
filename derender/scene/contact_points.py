"""Where bodies touch: the contact patch of each pair, by clipping the polygons that two convex bodies show each other.

For a pair the direction of least overlap is found among the axes of `separation` and the normals of meshes' faces.
Along it each body has an outermost feature: a face, an edge or a corner, within a tolerance. The two features,
projected along the direction, are clipped against each other (Sutherland and Hodgman 1974); the corners of what both
share are the points that carry force.
"""

import math

import numpy as np

from derender.compilation.cache import njit
from derender.scene.polygon import chain
from derender.scene.separation import FLAT_AXES, ROUND_AXES, flat_axis, reach, round_axis
from derender.scene.solids import BOX, CYLINDER, MESH, PLANE, SPHERE

MOST_CORNERS = 64  # of a feature; a rim is drawn with 24, and clipping adds one corner a side
RIM = 24
FACES = 6  # of the flat axes, those before the products of edges
# A cylinder lies on its side where the contact's normal is within this cosine of its rim's plane.
LYING = 0.1
# An edge's direction must part two bodies this much better (share of the shorter extent) before a face's yields to it:
# of two equal ones the face has the larger patch.
FACE_PREFERENCE = 1e-4
# Corners on the outline of the other polygon count as inside it, in units of the shorter extent.
ON_OUTLINE = 1e-9
PARALLEL = 1e-9  # sine below which two edges are parallel


@njit(cache=True, nogil=True, borrows=True)
def support(kind, pose, size, vertices, first, last, x, y, z):
    """Return how far a body reaches from its centre along the unit vector (x, y, z)."""
    if kind != MESH:
        return reach(kind, pose, size, x, y, z)
    best = -math.inf
    for k in range(first, last):
        along = (
            (vertices[k, 0] - pose[0, 3]) * x + (vertices[k, 1] - pose[1, 3]) * y + (vertices[k, 2] - pose[2, 3]) * z
        )
        best = max(best, along)
    return best


@njit(cache=True, nogil=True)
def feature(kind, pose, size, vertices, first, last, n, depth, patch, out):
    """Write the points (K, 3) of a body that lie within `depth` of its outermost along n, and return K.

    patch : radius in metres of the small square that stands for a ball's contact, and half the width of that of a
        cylinder that lies on its side: what resists rolling.
    """
    centre = pose[:3, 3]
    if kind == SPHERE:
        u, v = across(n)
        for k in range(4):
            a, b = (patch, 0.0) if k == 0 else (0.0, patch) if k == 1 else (-patch, 0.0) if k == 2 else (0.0, -patch)
            for i in range(3):
                out[k, i] = centre[i] + 0.5 * size[0] * n[i] + a * u[i] + b * v[i]
        return 4
    if kind == MESH:
        top = support(kind, pose, size, vertices, first, last, n[0], n[1], n[2])
        count = 0
        for k in range(first, last):
            height = 0.0
            for i in range(3):
                height += (vertices[k, i] - centre[i]) * n[i]
            if height >= top - depth and count < MOST_CORNERS:
                out[count] = vertices[k]
                count += 1
        return count
    axis = pose[:3, 2].copy()
    cosine = axis[0] * n[0] + axis[1] * n[1] + axis[2] * n[2]
    if kind == CYLINDER and abs(cosine) < LYING:
        side = n - cosine * axis
        side /= math.sqrt(side[0] ** 2 + side[1] ** 2 + side[2] ** 2)
        width = np.cross(axis, side)
        count = 0
        for end in (-1.0, 1.0):
            # the lower end of one that leans does not touch
            if 0.5 * size[2] * (end * cosine - abs(cosine)) < -depth:
                continue
            for way in (end, -end):
                out[count] = centre + 0.5 * size[0] * side + 0.5 * end * size[2] * axis + way * patch * width
                count += 1
        return count
    count = 0
    top = reach(kind, pose, size, n[0], n[1], n[2])
    corners = 8 if kind == BOX else RIM
    for k in range(corners):
        if kind == BOX:
            a, b, c = 0.5 * size[0], 0.5 * size[1], 0.5 * size[2]
            a, b, c = (a if k & 1 else -a), (b if k & 2 else -b), (c if k & 4 else -c)
        else:
            angle = 2.0 * math.pi * k / RIM
            a, b = 0.5 * size[0] * math.cos(angle), 0.5 * size[0] * math.sin(angle)
            c = 0.5 * size[2] if cosine > 0 else -0.5 * size[2]
        height = 0.0
        for i in range(3):
            out[count, i] = pose[i, 0] * a + pose[i, 1] * b + pose[i, 2] * c
            height += out[count, i] * n[i]
        if height >= top - depth:
            out[count] += centre
            count += 1
    if count == 0:  # a leaning cylinder touches between two corners of its drawn rim
        radial = n - cosine * axis
        radial /= max(math.sqrt(radial[0] ** 2 + radial[1] ** 2 + radial[2] ** 2), PARALLEL)
        end = 1.0 if cosine > 0 else -1.0
        out[0] = centre + 0.5 * size[0] * radial + 0.5 * end * size[2] * axis
        count = 1
    return count


@njit(cache=True, nogil=True)
def across(n):
    """Return two unit vectors (3,) that with n make a right-handed frame."""
    other = np.array([1.0, 0.0, 0.0]) if abs(n[0]) < 0.7 else np.array([0.0, 1.0, 0.0])
    u = np.cross(n, other)
    u /= math.sqrt(u[0] ** 2 + u[1] ** 2 + u[2] ** 2)
    return u, np.cross(n, u)


@njit(cache=True, nogil=True)
def hull_in_place(points, count, scale):
    """Sort points (K, 2) into the convex polygon around them, counterclockwise; return its number of corners."""
    if count < 3:
        return count
    for i in range(1, count):  # by x, then y
        x, y = points[i, 0], points[i, 1]
        j = i - 1
        while j >= 0 and (points[j, 0] > x or (points[j, 0] == x and points[j, 1] > y)):
            points[j + 1] = points[j]
            j -= 1
        points[j + 1, 0], points[j + 1, 1] = x, y
    there, flat = points[:count].copy(), ON_OUTLINE * scale * scale
    below, above = chain(there, flat), chain(there[::-1].copy(), flat)
    turn, size = len(below) - 1, len(below) + len(above) - 2
    points[:turn], points[turn:size] = below[:-1], above[:-1]
    return size


@njit(cache=True, nogil=True)
def clipped(subject, count, window, sides, scale, out):
    """Write the part of a polygon (K, 2) inside a convex one (S, 2), S >= 3, and return its number of corners."""
    out[:count] = subject[:count]
    other = np.empty_like(out)
    for s in range(sides):
        ax, ay = window[s, 0], window[s, 1]
        dx, dy = window[(s + 1) % sides, 0] - ax, window[(s + 1) % sides, 1] - ay
        length = math.sqrt(dx * dx + dy * dy)
        if length < ON_OUTLINE * scale:
            continue
        kept = 0
        for k in range(count):
            px, py = out[k, 0], out[k, 1]
            qx, qy = out[(k + 1) % count, 0], out[(k + 1) % count, 1]
            inside = (dx * (py - ay) - dy * (px - ax)) / length
            beyond = (dx * (qy - ay) - dy * (qx - ax)) / length
            if inside >= -ON_OUTLINE * scale:
                other[kept, 0], other[kept, 1] = px, py
                kept += 1
            if (inside < -ON_OUTLINE * scale) != (beyond < -ON_OUTLINE * scale):
                share = inside / (inside - beyond)
                other[kept, 0], other[kept, 1] = px + share * (qx - px), py + share * (qy - py)
                kept += 1
        count = min(kept, len(out) - 2)
        out[:count] = other[:count]
        if count == 0:
            break
    return count


@njit(cache=True, nogil=True)
def between_segments(a, b, c, d):
    """Return the middle (2,) of the shortest line between the segments a-b and c-d in the plane, and its length."""
    u, v, w = b - a, d - c, a - c
    uu, uv, vv = u[0] * u[0] + u[1] * u[1], u[0] * v[0] + u[1] * v[1], v[0] * v[0] + v[1] * v[1]
    uw, vw = u[0] * w[0] + u[1] * w[1], v[0] * w[0] + v[1] * w[1]
    square = uu * vv - uv * uv
    s = min(max((uv * vw - vv * uw) / square, 0.0), 1.0) if square > PARALLEL * max(uu * vv, 1e-300) else 0.0
    t = min(max((uv * s + vw) / vv, 0.0), 1.0) if vv > 0 else 0.0
    s = min(max((uv * t - uw) / uu, 0.0), 1.0) if uu > 0 else 0.0
    p, q = a + s * u, c + t * v
    return 0.5 * (p + q), math.sqrt((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2)


@njit(cache=True, nogil=True, borrows=True)
def parting_direction(kind, pose, size, vertices, vertex_start, normals, normal_start, i, j, shortest, open_by, best):
    """Write the unit vector (3,) from j to i along which two bodies overlap least, and return the gap along it, metres;
    or the first that parts them by more than `open_by`.

    shortest : the shorter of their extents, metres.
    """
    gap, a, b = -math.inf, pose[i], pose[j]
    flat = kind[i] == BOX and kind[j] == BOX
    usual = FLAT_AXES if flat else FLAT_AXES + ROUND_AXES
    own = normal_start[i + 1] - normal_start[i]
    for k in range(usual + own + normal_start[j + 1] - normal_start[j]):
        if k < FLAT_AXES:
            x, y, z = flat_axis(k, a, b)
        elif k < usual:
            x, y, z = round_axis(k - FLAT_AXES, kind[i], a, size[i], kind[j], b, size[j])
        else:
            face = k - usual + (normal_start[i] if k < usual + own else normal_start[j] - own)
            x, y, z = normals[face, 0], normals[face, 1], normals[face, 2]
        length = math.sqrt(x * x + y * y + z * z)
        if length < 1e-6:
            continue
        x, y, z = x / length, y / length, z / length
        between = x * (a[0, 3] - b[0, 3]) + y * (a[1, 3] - b[1, 3]) + z * (a[2, 3] - b[2, 3])
        handicap = FACE_PREFERENCE * shortest if FACES <= k < FLAT_AXES else 0.0
        # a hull's faces look one way only, but its opposite may be as good
        for sign in (1.0, -1.0):
            sx, sy, sz = sign * x, sign * y, sign * z
            if kind[i] != MESH and kind[j] != MESH and sign * between < 0:
                continue
            found = (
                sign * between
                - support(kind[i], a, size[i], vertices, vertex_start[i], vertex_start[i + 1], -sx, -sy, -sz)
                - support(kind[j], b, size[j], vertices, vertex_start[j], vertex_start[j + 1], sx, sy, sz)
            )
            if found - handicap > gap:
                gap = found
                best[0], best[1], best[2] = sx, sy, sz
                if gap > open_by:
                    return gap
    return gap


@njit(cache=True, nogil=True)
def touch(kind, pose, size, vertices, vertex_start, normals, normal_start, i, j, open_by, flush, patch, out):
    """Write the contact points (K, 3) of bodies i and j and return K, the normal (3,) from j to i and the gap, metres.

    open_by : metres of gap up to which the two touch. flush : metres within which a corner counts to a face.
    """
    turned = 1.0
    if kind[i] == PLANE:
        i, j, turned = j, i, -1.0
    own = np.empty((MOST_CORNERS, 3))
    if kind[j] == PLANE:
        normal = pose[j, :3, 2].copy()
        below = -normal
        centre = pose[i, :3, 3]
        height = (
            (centre[0] - pose[j, 0, 3]) * normal[0]
            + (centre[1] - pose[j, 1, 3]) * normal[1]
            + (centre[2] - pose[j, 2, 3]) * normal[2]
        )
        gap = height - support(
            kind[i], pose[i], size[i], vertices, vertex_start[i], vertex_start[i + 1], below[0], below[1], below[2]
        )
        if gap > open_by:
            return 0, turned * normal, gap
        count = feature(
            kind[i], pose[i], size[i], vertices, vertex_start[i], vertex_start[i + 1], below, flush, patch, own
        )
        out[:count] = own[:count]
        return count, turned * normal, gap
    normal = np.zeros(3)
    scale = min(size[i, 0], size[i, 1], size[i, 2], size[j, 0], size[j, 1], size[j, 2])
    gap = parting_direction(
        kind, pose, size, vertices, vertex_start, normals, normal_start, i, j, scale, open_by, normal
    )
    if gap > open_by or gap == -math.inf:
        return 0, normal, gap
    u, v = across(normal)
    flat = np.empty((2, MOST_CORNERS, 2))
    counts = np.zeros(2, np.int64)
    height = 0.0
    for side in range(2):
        k = j if side else i
        way = normal if side else -normal
        counts[side] = feature(
            kind[k], pose[k], size[k], vertices, vertex_start[k], vertex_start[k + 1], way, flush, patch, own
        )
        top = -math.inf
        for c in range(counts[side]):
            flat[side, c, 0] = own[c, 0] * u[0] + own[c, 1] * u[1] + own[c, 2] * u[2]
            flat[side, c, 1] = own[c, 0] * v[0] + own[c, 1] * v[1] + own[c, 2] * v[2]
            top = max(top, own[c, 0] * way[0] + own[c, 1] * way[1] + own[c, 2] * way[2])
        height += 0.5 * top * (1.0 if side else -1.0)
        counts[side] = hull_in_place(flat[side], counts[side], scale)
    shared = np.empty((2 * MOST_CORNERS, 2))
    window = 0 if counts[0] > counts[1] else 1
    if counts[window] >= 3:
        count = clipped(flat[1 - window], counts[1 - window], flat[window], counts[window], scale, shared)
    else:
        last = counts - 1
        middle, apart = between_segments(flat[0, 0], flat[0, last[0]], flat[1, 0], flat[1, last[1]])
        count = 0
        if apart <= max(flush, 1e-6 * scale):
            shared[0] = middle
            count = 1
    count = min(count, MOST_CORNERS)
    for c in range(count):
        out[c] = shared[c, 0] * u + shared[c, 1] * v + height * normal
    return count, normal, gap


@njit(cache=True, nogil=True)
def all_contacts(
    kind, pose, size, vertices, vertex_start, normals, normal_start, owner, held, joined, near, wide, flush, patch
):
    """Return every contact point among bodies of N convex pieces.

    kind (N,), pose (N, 4, 4), size (N, 3) ; vertices (V, 3), vertex_start (N + 1,) : of meshes, in the scene's frame,
    normals (F, 3), normal_start (N + 1,) : of their faces ; owner (N,) : the body that it is a piece of, those of one
    do not bear each other ; held (N,) : what does not move ; joined (B, B) bool : bodies that the graph says are in
    contact.
    near, wide : metres of gap up to which a pair touches, and one that the graph joins; flush : as in `touch`, for
    each of these two kinds; patch : see `feature`.

    Returns first, second (P,) int64, point, normal (P, 3), from the second body to the first, and gap (P,) metres.
    """
    count = len(kind)
    radius = np.empty(count)  # of a ball around each piece
    for i in range(count):
        radius[i] = 0.5 * math.sqrt(size[i, 0] ** 2 + size[i, 1] ** 2 + size[i, 2] ** 2)
        for k in range(vertex_start[i], vertex_start[i + 1]):
            x, y, z = vertices[k, 0] - pose[i, 0, 3], vertices[k, 1] - pose[i, 1, 3], vertices[k, 2] - pose[i, 2, 3]
            radius[i] = max(radius[i], math.sqrt(x * x + y * y + z * z))
    limit = 4096
    first, second = np.empty(limit, np.int64), np.empty(limit, np.int64)
    point, normal, gap = np.empty((limit, 3)), np.empty((limit, 3)), np.empty(limit)
    found = 0
    out = np.empty((2 * MOST_CORNERS, 3))
    for i in range(count):
        for j in range(i):
            if owner[i] == owner[j] or (held[i] and held[j]) or (kind[i] == PLANE and kind[j] == PLANE):
                continue
            graph = joined[owner[i], owner[j]]
            open_by = wide if graph else near
            if kind[i] != PLANE and kind[j] != PLANE:
                x, y, z = pose[i, 0, 3] - pose[j, 0, 3], pose[i, 1, 3] - pose[j, 1, 3], pose[i, 2, 3] - pose[j, 2, 3]
                if x * x + y * y + z * z > (radius[i] + radius[j] + open_by) ** 2:
                    continue
            points, n, between = touch(
                kind, pose, size, vertices, vertex_start, normals, normal_start, i, j, open_by,
                flush[1] if graph else flush[0], patch, out,
            )  # fmt: skip
            if found + points > limit:
                limit *= 2
                first = np.concatenate((first, first))
                second = np.concatenate((second, second))
                point = np.concatenate((point, point))
                normal = np.concatenate((normal, normal))
                gap = np.concatenate((gap, gap))
            for c in range(points):
                first[found], second[found], gap[found] = owner[i], owner[j], between
                point[found] = out[c]
                normal[found] = n
                found += 1
    return first[:found], second[:found], point[:found], normal[:found], gap[:found]
