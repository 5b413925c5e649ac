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
