"""Outlines of convex solids as straight lines in the image: where the depth image is discontinuous.

The outline of a solid is where its surface turns away from the camera: edges of a box between a face that the camera
sees and one that it does not, tangent circles of spheres, tangent lines and rims of cylinders. The image of a convex
solid is convex, so it is what all lines of its outline leave over. Curved outlines are cut into chords of about
half a pixel, shifted outwards by two thirds of their sagitta: then the area under chord and arc is the same.
"""

import math

import numpy as np

from derender.compilation.cache import njit
from derender.scene.solids import BOX, CYLINDER, SPHERE

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
