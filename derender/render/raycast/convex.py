"""Solids as bounds on inverse depth: the one formula behind every convex solid.

Along the ray through pixel (i, j) a point has camera coordinates r / w with r = ((i - cx) / fx, (j - cy) / fy, 1) and
w its inverse depth. A half space n.p <= d then bounds w: from above where the camera is outside it (d < 0, a front
face), from below otherwise (a back face), and the bound n.r / d is affine in (i, j). A sphere or an infinite cylinder
gives K w^2 - 2 B w + A <= 0 with B affine and A quadratic in (i, j), so the two roots are such bounds as well. A
solid is hit where the least upper bound is at least the greatest lower bound and positive, and that upper bound is the
inverse depth of the hit. Nothing here can divide by zero depth, so solids that reach behind the camera are not clipped.

A prepared solid is one row of PREPARED float64 numbers:
    [0] number of front faces, [1] number of back faces, [2] 1 with a quadric else 0, [3] K, [4:7] column i0, row j0 and
    spare, [8:26] six affine bounds (a, b, c): w = a + b i + c j, the front ones first, [26:29] B = B0 + B1 t + B2 s
    about (i0, j0) (t = i - i0, s = j - j0), [29:35] the discriminant B^2 - K A = q0 + q1 t + q2 s + q3 t^2 + q4 t s +
    q5 s^2.
Its rectangle is four int64: first column, end column, first row, end row (ends excluded); empty when nothing shows.
"""

import math

import numpy as np

from derender.compilation.cache import njit
from derender.scene.solids import BOX, CYLINDER, MESH, PLANE, SPHERE

PREPARED = 36
FACES, QUADRIC_B, DISCRIMINANT = 8, 26, 29
ROUNDING = 1e-3  # pixels by which rectangles are enlarged: float32 rows must miss everywhere outside them
NEAREST = 1e-6  # metres: anything nearer to the camera's plane counts as behind it when rectangles are bounded


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _tangents(x, z, xx, xz, zz):
    """Bounds of X / Z over the ellipse with centre (x, z), shape ((xx, xz), (xz, zz)); infinite if Z can be 0."""
    leading = z * z - zz
    if z <= 0.0 or leading <= NEAREST * NEAREST:
        return -math.inf, math.inf
    middle = x * z - xz
    root = math.sqrt(max(middle * middle - leading * (x * x - xx), 0.0))
    return (middle - root) / leading, (middle + root) / leading


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _first_pixel(value, limit):
    """The first pixel at or beyond `value`, in [0, limit]; a hair early, never late."""
    return int(math.ceil(min(max(value - ROUNDING, 0.0), float(limit))))  # clipped first: ceil of infinity has no int


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _set_rectangle(rectangle, lower_x, upper_x, lower_y, upper_y, camera, width, height):
    rectangle[0] = _first_pixel(camera[0] * lower_x + camera[2], width)
    rectangle[1] = max(_first_pixel(camera[0] * upper_x + camera[2] + 1.0 + 2.0 * ROUNDING, width), rectangle[0])
    rectangle[2] = _first_pixel(camera[1] * lower_y + camera[3], height)
    rectangle[3] = max(_first_pixel(camera[1] * upper_y + camera[3] + 1.0 + 2.0 * ROUNDING, height), rectangle[2])
    if rectangle[2] >= rectangle[3]:
        rectangle[1] = rectangle[0]


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def box_rectangle(pose, size, camera, width, height, rectangle):
    """Bound the image of a box: exact if it lies before the camera, the whole image if it reaches behind."""
    lower_x, upper_x, lower_y, upper_y = math.inf, -math.inf, math.inf, -math.inf
    behind = 0
    a, b, c = 0.5 * size[0], 0.5 * size[1], 0.5 * size[2]
    ax, ay, az = a * pose[0, 0], a * pose[1, 0], a * pose[2, 0]
    bx, by, bz = b * pose[0, 1], b * pose[1, 1], b * pose[2, 1]
    cx, cy, cz = c * pose[0, 2], c * pose[1, 2], c * pose[2, 2]
    for corner in range(8):
        i = 1.0 if corner & 1 else -1.0
        j = 1.0 if corner & 2 else -1.0
        k = 1.0 if corner & 4 else -1.0
        depth = pose[2, 3] + i * az + j * bz + k * cz
        if depth <= NEAREST:
            behind += 1
            continue
        inverse = 1.0 / depth
        horizontal = (pose[0, 3] + i * ax + j * bx + k * cx) * inverse
        vertical = (pose[1, 3] + i * ay + j * by + k * cy) * inverse
        lower_x, upper_x = min(lower_x, horizontal), max(upper_x, horizontal)
        lower_y, upper_y = min(lower_y, vertical), max(upper_y, vertical)
    if behind == 8:
        rectangle[1] = rectangle[0]
    elif behind > 0:
        rectangle[0], rectangle[1], rectangle[2], rectangle[3] = 0, width, 0, height
    else:
        _set_rectangle(rectangle, lower_x, upper_x, lower_y, upper_y, camera, width, height)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _put_face(prepared, nx, ny, nz, offset, camera):
    """Add the half space n.p <= offset, n = (nx, ny, nz) over the focal lengths: a front face if the camera is outside.

    nx and ny are divided by fx and fy beforehand.
    """
    if abs(offset) < 1e-12:
        offset = 1e-12
    inverse = 1.0 / offset
    b, c = nx * inverse, ny * inverse
    a = nz * inverse - b * camera[2] - c * camera[3]
    front, back = int(prepared[0]), int(prepared[1])
    slot = FACES + 3 * (front + back)
    if offset < 0.0:
        if back > 0:  # make room: fronts stay first, the order among the backs does not matter
            first = FACES + 3 * front
            for k in range(3):
                prepared[slot + k] = prepared[first + k]
            slot = first
        prepared[0] = front + 1
    else:
        prepared[1] = back + 1
    prepared[slot], prepared[slot + 1], prepared[slot + 2] = a, b, c


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _put_slab(prepared, pose, axis, half, camera):
    """Add the two faces of a slab |axis coordinate| <= half."""
    nx, ny, nz = pose[0, axis], pose[1, axis], pose[2, axis]
    middle = nx * pose[0, 3] + ny * pose[1, 3] + nz * pose[2, 3]
    nx, ny = nx / camera[0], ny / camera[1]
    _put_face(prepared, nx, ny, nz, middle + half, camera)
    _put_face(prepared, -nx, -ny, -nz, half - middle, camera)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _put_quadric(prepared, xx, xy, xz, yy, yz, zz, pose, radius, column, row, camera):
    """Add (p - centre)' M (p - centre) <= radius^2, M a projection with these entries, about a pixel."""
    x, y = (column - camera[2]) / camera[0], (row - camera[3]) / camera[1]
    dx, dy = 1.0 / camera[0], 1.0 / camera[1]
    px, py, pz = pose[0, 3], pose[1, 3], pose[2, 3]
    mx, my, mz = xx * px + xy * py + xz * pz, xy * px + yy * py + yz * pz, xz * px + yz * py + zz * pz
    k = px * mx + py * my + pz * mz - radius * radius
    if abs(k) < 1e-12:
        k = 1e-12
    rx, ry, rz = xx * x + xy * y + xz, xy * x + yy * y + yz, xz * x + yz * y + zz
    b0, b1, b2 = mx * x + my * y + mz, mx * dx, my * dy
    prepared[2], prepared[3], prepared[4], prepared[5] = 1.0, k, column, row
    prepared[QUADRIC_B], prepared[QUADRIC_B + 1], prepared[QUADRIC_B + 2] = b0, b1, b2
    q = DISCRIMINANT
    prepared[q] = b0 * b0 - k * (rx * x + ry * y + rz)
    prepared[q + 1] = 2.0 * (b0 * b1 - k * rx * dx)
    prepared[q + 2] = 2.0 * (b0 * b2 - k * ry * dy)
    prepared[q + 3] = b1 * b1 - k * xx * dx * dx
    prepared[q + 4] = 2.0 * (b1 * b2 - k * xy * dx * dy)
    prepared[q + 5] = b2 * b2 - k * yy * dy * dy


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _prepare_round(pose, radius, half, camera, width, height, prepared, rectangle):
    """A cylinder along its z axis; with half = 0 a sphere. Either is bounded by two ellipsoids: caps, or one twice."""
    ax, ay, az = pose[0, 2], pose[1, 2], pose[2, 2]
    flat = 1.0 if half > 0.0 else 0.0
    xx, yy, zz = 1.0 - flat * ax * ax, 1.0 - flat * ay * ay, 1.0 - flat * az * az
    xy, xz, yz = -flat * ax * ay, -flat * ax * az, -flat * ay * az
    px, py, pz = pose[0, 3], pose[1, 3], pose[2, 3]
    square = radius * radius
    if pz + radius * math.sqrt(max(zz, 0.0)) + abs(half * az) <= NEAREST:
        return  # wholly behind the camera
    hx, hy, hz = half * ax, half * ay, half * az
    left_a, right_a = _tangents(px + hx, pz + hz, square * xx, square * xz, square * zz)
    left_b, right_b = _tangents(px - hx, pz - hz, square * xx, square * xz, square * zz)
    top_a, bottom_a = _tangents(py + hy, pz + hz, square * yy, square * yz, square * zz)
    top_b, bottom_b = _tangents(py - hy, pz - hz, square * yy, square * yz, square * zz)
    _set_rectangle(
        rectangle,
        min(left_a, left_b),
        max(right_a, right_b),
        min(top_a, top_b),
        max(bottom_a, bottom_b),
        camera,
        width,
        height,
    )
    if half > 0.0:
        _put_slab(prepared, pose, 2, half, camera)
    column, row = (rectangle[0] + rectangle[1]) // 2, (rectangle[2] + rectangle[3]) // 2
    _put_quadric(prepared, xx, xy, xz, yy, yz, zz, pose, radius, column, row, camera)
    if prepared[3] <= 0.0 and prepared[0] == 0.0:  # the camera is inside
        rectangle[1] = rectangle[0]


@njit(cache=True, nogil=True, borrows=True)
def prepare_solid(kind, pose, size, camera, width, height, prepared, rectangle):
    """Turn one posed solid into its bounds on inverse depth and the rectangle outside which it cannot show.

    kind : PLANE, BOX, SPHERE, CYLINDER or MESH (of a mesh only the rectangle is found).
    pose : (4, 4) float64, object to camera. size : (3,) float64, full extents.
    camera : (>= 4,) float64, fx, fy, cx, cy, ... width, height : int.
    prepared : (PREPARED,) float64, written. rectangle : (4,) int64, written.

    A plane shows from both sides. A solid that the camera is inside of does not show (its back faces are culled).
    """
    for k in range(PREPARED):
        prepared[k] = 0.0
    for k in range(4):
        rectangle[k] = 0
    if kind == PLANE:
        offset = pose[0, 2] * pose[0, 3] + pose[1, 2] * pose[1, 3] + pose[2, 2] * pose[2, 3]
        sign = 1.0 if offset < 0.0 else -1.0
        _put_face(
            prepared,
            sign * pose[0, 2] / camera[0],
            sign * pose[1, 2] / camera[1],
            sign * pose[2, 2],
            -abs(offset) - 1e-12,
            camera,
        )
        rectangle[1], rectangle[3] = width, height
    elif kind == BOX:
        for axis in range(3):
            _put_slab(prepared, pose, axis, 0.5 * size[axis], camera)
        if prepared[0] > 0.0:
            box_rectangle(pose, size, camera, width, height, rectangle)
    elif kind == SPHERE:
        _prepare_round(pose, 0.5 * size[0], 0.0, camera, width, height, prepared, rectangle)
    elif kind == CYLINDER:
        _prepare_round(pose, 0.5 * size[0], 0.5 * size[2], camera, width, height, prepared, rectangle)
    elif kind == MESH:
        box_rectangle(pose, size, camera, width, height, rectangle)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def discriminant(prepared, t, s):
    """B^2 - K A of a prepared solid with a quadric, at t columns and s rows from its (i0, j0)."""
    q = DISCRIMINANT
    return (
        prepared[q]
        + (prepared[q + 1] + prepared[q + 3] * t + prepared[q + 4] * s) * t
        + (prepared[q + 2] + prepared[q + 5] * s) * s
    )


@njit(cache=True, nogil=True, borrows=True)
def inverse_depth(prepared, column, row):
    """Inverse depth at which the ray through (column, row) enters a prepared convex solid; 0 where it misses.

    column, row may lie between pixels. The float64 reference of the compiled row loops.
    """
    upper, lower = math.inf, 0.0
    front, faces = int(prepared[0]), int(prepared[0] + prepared[1])
    for face in range(faces):
        k = FACES + 3 * face
        bound = prepared[k] + prepared[k + 1] * column + prepared[k + 2] * row
        if face < front:
            upper = min(upper, bound)
        else:
            lower = max(lower, bound)
    if prepared[2] != 0.0:
        t, s = column - prepared[4], row - prepared[5]
        square = discriminant(prepared, t, s)
        if square < 0.0:
            return 0.0
        root = math.sqrt(square)
        middle = prepared[QUADRIC_B] + prepared[QUADRIC_B + 1] * t + prepared[QUADRIC_B + 2] * s
        lower = max(lower, (middle - root) / prepared[3])
        if prepared[3] > 0.0:
            upper = min(upper, (middle + root) / prepared[3])
    return upper if upper >= lower and upper > 0.0 and upper < math.inf else 0.0


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _along_row(prepared, face, end, first, row, without):
    """Value at column `first` and slope of the affine bound `face` on a row; `without` and 0 from `end` on."""
    k = FACES + 3 * face
    if face >= end:
        return without, 0.0
    return prepared[k] + prepared[k + 1] * first + prepared[k + 2] * row, prepared[k + 1]


@njit(cache=True, nogil=True, error_model="numpy", borrows=True)
def inverse_depths(prepared, first, row, out):
    """Write `inverse_depth` of the pixels of a row from column `first` on into out (n,).

    Three upper and five lower bounds, as many as a box may have, and no check for zero: no branch in the loop.
    """
    front, faces = int(prepared[0]), int(prepared[0] + prepared[1])
    a0, b0 = _along_row(prepared, 0, front, first, row, math.inf)
    a1, b1 = _along_row(prepared, 1, front, first, row, math.inf)
    a2, b2 = _along_row(prepared, 2, front, first, row, math.inf)
    a3, b3 = _along_row(prepared, front, faces, first, row, 0.0)
    a4, b4 = _along_row(prepared, front + 1, faces, first, row, 0.0)
    a5, b5 = _along_row(prepared, front + 2, faces, first, row, 0.0)
    a6, b6 = _along_row(prepared, front + 3, faces, first, row, 0.0)
    a7, b7 = _along_row(prepared, front + 4, faces, first, row, 0.0)
    curved, t, s, k = prepared[2] != 0.0, first - prepared[4], row - prepared[5], prepared[3]
    middle, slope = prepared[QUADRIC_B] + prepared[QUADRIC_B + 2] * s, prepared[QUADRIC_B + 1]
    for n in range(out.size):
        x = float(n)
        upper = min(min(a0 + b0 * x, a1 + b1 * x), a2 + b2 * x)
        lower = max(max(max(a3 + b3 * x, a4 + b4 * x), max(a5 + b5 * x, a6 + b6 * x)), max(a7 + b7 * x, 0.0))
        if curved:  # the same for the whole row
            square = discriminant(prepared, t + x, s)
            root, near = math.sqrt(max(square, 0.0)), middle + slope * (t + x)
            lower = max(lower, (near - root) / k) if square >= 0.0 else math.inf
            upper = min(upper, (near + root) / k) if k > 0.0 else upper
        out[n] = upper if upper >= lower and 0.0 < upper < math.inf else 0.0


NEAR = 1e-3  # metres: the depth that pieces nearer than this are taken to have when their length is reckoned
LINES = 512  # most lines of one solid
EDGE, DEPTH, NORMAL = 0, 3, 6  # a line's numbers: see `draw_outline`
LINE = 9


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _point(pose, x, y, z, out):
    for axis in range(3):
        out[axis] = pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2] * z + pose[axis, 3]


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def add_line(lines, count, start, end, inner, camera):
    """Append the line through two points in space; `inner` (3,) lies on its inner side. Return the new count.

    Points may lie behind the camera: the line is where the plane through the camera's centre cuts the image.
    """
    nx = start[1] * end[2] - start[2] * end[1]
    ny = start[2] * end[0] - start[0] * end[2]
    nz = start[0] * end[1] - start[1] * end[0]
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    if length < 1e-15:
        return count
    if nx * inner[0] + ny * inner[1] + nz * inner[2] > 0.0:
        length = -length
    nx, ny, nz = nx / length, ny / length, nz / length
    b, c = nx / camera[0], ny / camera[1]
    slope = math.sqrt(b * b + c * c)
    if slope < 1e-12:
        return count
    # the plane that holds the piece and is as far from the camera as can be: inverse depth along the piece
    dx, dy, dz = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    mx, my, mz = ny * dz - nz * dy, nz * dx - nx * dz, nx * dy - ny * dx
    offset = mx * start[0] + my * start[1] + mz * start[2]
    if offset == 0.0:
        return count
    line, scale = lines[count], 1.0 / slope
    line[0], line[1], line[2] = (b * camera[2] + c * camera[3] - nz) * scale, -b * scale, -c * scale
    p, q = mx / (offset * camera[0]), my / (offset * camera[1])
    line[3], line[4], line[5] = mz / offset - p * camera[2] - q * camera[3], p, q
    line[6], line[7], line[8] = nx * scale, ny * scale, nz * scale
    return count + 1


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _box(pose, half, camera, lines):
    seen = np.zeros((3, 2), np.int64)  # does the camera see the face on the negative, positive side of this axis?
    for axis in range(3):
        middle = pose[0, axis] * pose[0, 3] + pose[1, axis] * pose[1, 3] + pose[2, axis] * pose[2, 3]
        seen[axis, 0] = half[axis] - middle < 0.0
        seen[axis, 1] = middle + half[axis] < 0.0
    count = 0
    corner, start, end = np.zeros(3), np.zeros(3), np.zeros(3)
    for along in range(3):
        first, second = (along + 1) % 3, (along + 2) % 3
        for i in range(2):
            for j in range(2):
                if seen[first, i] != seen[second, j]:
                    corner[first], corner[second] = (2 * i - 1) * half[first], (2 * j - 1) * half[second]
                    corner[along] = -half[along]
                    _point(pose, corner[0], corner[1], corner[2], start)
                    corner[along] = half[along]
                    _point(pose, corner[0], corner[1], corner[2], end)
                    count = add_line(lines, count, start, end, pose[:3, 3], camera)
    return count


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _arc(centre, across, upright, begin, extent, length, inner, camera, lines, count):
    """Append chords of an arc: centre + cos across + sin upright, `extent` radians from `begin`, `length` pixels."""
    if extent < 1e-9:
        return count
    least = 4.0 + 40.0 * extent / (2.0 * math.pi)
    pieces = 4 * int(math.ceil(0.25 * min(max(4.0 * length, least), float(LINES // 3 - 8))))
    start, end = np.zeros(3), np.zeros(3)
    # the chord's ends lie on the circle; the arc's middle is beyond the chord's by 1 - cos of half its angle
    beyond = 2.0 / 3.0 * (1.0 - math.cos(0.5 * extent / pieces))
    for n in range(pieces):
        angle = begin + extent * n / pieces
        following = begin + extent * (n + 1) / pieces
        middle = 0.5 * (angle + following)
        c0, s0 = math.cos(angle) + beyond * math.cos(middle), math.sin(angle) + beyond * math.sin(middle)
        c1, s1 = math.cos(following) + beyond * math.cos(middle), math.sin(following) + beyond * math.sin(middle)
        for axis in range(3):
            start[axis] = centre[axis] + c0 * across[axis] + s0 * upright[axis]
            end[axis] = centre[axis] + c1 * across[axis] + s1 * upright[axis]
        count = add_line(lines, count, start, end, inner, camera)
    return count


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _sphere(pose, radius, focal, camera, lines):
    centre, across, upright = pose[:3, 3].copy(), np.zeros(3), np.zeros(3)
    square = centre[0] * centre[0] + centre[1] * centre[1] + centre[2] * centre[2]
    if square <= radius * radius:
        return 0
    share = 1.0 - radius * radius / square
    ring = radius * math.sqrt(share)
    distance = math.sqrt(square)
    nx, ny, nz = centre[0] / distance, centre[1] / distance, centre[2] / distance
    # two directions across the line of sight
    if abs(nx) < 0.6:
        ax, ay, az = 0.0, nz, -ny
    else:
        ax, ay, az = -nz, 0.0, nx
    scale = ring / math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax * scale, ay * scale, az * scale
    across[0], across[1], across[2] = ax, ay, az
    upright[0], upright[1], upright[2] = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
    length = 2.0 * math.pi * ring * focal / max(share * centre[2], NEAR)
    for axis in range(3):
        centre[axis] *= share
    return _arc(centre, across, upright, 0.0, 2.0 * math.pi, length, centre, camera, lines, 0)


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _cylinder(pose, radius, half, focal, camera, lines, counts):
    # tangent lines: radial directions e with e . viewer = radius, the camera in the object's axes
    viewer = np.empty(3)
    for axis in range(3):
        viewer[axis] = -(pose[0, axis] * pose[0, 3] + pose[1, axis] * pose[1, 3] + pose[2, axis] * pose[2, 3])
    distance = math.sqrt(viewer[0] * viewer[0] + viewer[1] * viewer[1])
    direction = math.atan2(viewer[1], viewer[0])
    opening = math.acos(radius / distance) if distance > radius else 0.0  # the side is seen where |angle| < opening
    count = 0
    start, end, across, upright = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    if distance > radius:
        for sign in (-1.0, 1.0):
            angle = direction + sign * opening
            x, y = radius * math.cos(angle), radius * math.sin(angle)
            _point(pose, x, y, -half, start)
            _point(pose, x, y, half, end)
            count = add_line(lines, count, start, end, pose[:3, 3], camera)
    for axis in range(3):
        across[axis], upright[axis] = radius * pose[axis, 0], radius * pose[axis, 1]
    cap = 0.0
    for side in (-1.0, 1.0):
        seen = side * viewer[2] > half
        # of a cap that is seen the outline is the far arc, of one that is not the near arc
        begin = direction + (opening if seen else -opening)
        extent = 2.0 * (math.pi - opening) if seen else 2.0 * opening
        _point(pose, 0.0, 0.0, side * half, start)
        length = extent * radius * focal / max(start[2], NEAR)
        count = _arc(start, across, upright, begin, extent, length, pose[:3, 3], camera, lines, count)
        if seen:
            cap = side
    counts[0], counts[1] = count, count
    if cap != 0.0:  # the rim between the cap and the side
        _point(pose, 0.0, 0.0, cap * half, start)
        length = 2.0 * opening * radius * focal / max(start[2], NEAR)
        begin, extent = direction - opening, 2.0 * opening
        counts[1] = _arc(start, across, upright, begin, extent, length, start, camera, lines, count)


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def draw_outline(kind, pose, size, camera, lines, counts):
    """Write the lines of a solid's outline.

    kind, pose (4, 4), size (3,): as in Solids. camera : (4,) float64 fx, fy, cx, cy.
    lines : (LINES, LINE) float64, written. [EDGE:] a, b, c: a + b i + c j is the distance of image point (i, j) from
        the line in pixels, positive on the solid's side. [DEPTH:] inverse depth along the line, affine likewise.
        [NORMAL:] where a point p of the line moves by dp, the line moves outwards by (these three . dp) / depth pixels.
    counts : (2,) int64, written: lines of the outline, and the end of those, after them, of the rim between a
        cylinder's cap and its side.
    """
    counts[0], counts[1] = 0, 0
    focal = max(camera[0], camera[1])
    if kind == BOX:
        counts[0] = _box(pose, 0.5 * size, camera, lines)
    elif kind == SPHERE:
        counts[0] = _sphere(pose, 0.5 * size[0], focal, camera, lines)
    elif kind == CYLINDER:
        _cylinder(pose, 0.5 * size[0], 0.5 * size[2], focal, camera, lines, counts)
    counts[1] = max(counts[1], counts[0])
