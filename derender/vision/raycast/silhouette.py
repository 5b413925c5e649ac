"""Outlines of solids as straight pieces in space: where the depth image is discontinuous.

The outline of a solid is where its surface turns away from the camera: edges of a box between a face that the camera
sees and one that it does not, tangent circles of spheres, tangent lines and rims of cylinders. Curved outlines are cut
into chords of about a pixel; the plane through the camera's centre and a chord is tangent to second order.
"""

import math

import numpy as np

from derender.kernel_cache import njit
from derender.model.solids import BOX, CYLINDER, SPHERE

NEAR = 1e-3  # metres: outlines are cut off at this depth
CHORDS = 256  # most pieces of one curved outline


@njit(cache=True, nogil=True)
def _point(pose, x, y, z, out):
    for axis in range(3):
        out[axis] = pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2] * z + pose[axis, 3]


@njit(cache=True, nogil=True)
def _box(pose, half, segments):
    seen = np.zeros((3, 2), np.int64)  # does the camera see the face on the negative, positive side of this axis?
    for axis in range(3):
        middle = pose[0, axis] * pose[0, 3] + pose[1, axis] * pose[1, 3] + pose[2, axis] * pose[2, 3]
        seen[axis, 0] = half[axis] - middle < 0.0
        seen[axis, 1] = middle + half[axis] < 0.0
    count = 0
    corner = np.zeros(3)
    for along in range(3):
        first, second = (along + 1) % 3, (along + 2) % 3
        for i in range(2):
            for j in range(2):
                if seen[first, i] != seen[second, j]:
                    corner[first], corner[second] = (2 * i - 1) * half[first], (2 * j - 1) * half[second]
                    for end in range(2):
                        corner[along] = (2 * end - 1) * half[along]
                        _point(pose, corner[0], corner[1], corner[2], segments[count, end])
                    count += 1
    return count


@njit(cache=True, nogil=True)
def _chords(length):
    """How many chords for an arc of `length` pixels."""
    return int(min(max(math.ceil(length), 16.0), float(CHORDS - 2)))


@njit(cache=True, nogil=True)
def _sphere(pose, radius, focal, segments):
    cx, cy, cz = pose[0, 3], pose[1, 3], pose[2, 3]
    square = cx * cx + cy * cy + cz * cz
    if square <= radius * radius:
        return 0
    share = 1.0 - radius * radius / square
    ring = radius * math.sqrt(share)
    length = math.sqrt(square)
    nx, ny, nz = cx / length, cy / length, cz / length
    # two directions across the line of sight
    if abs(nx) < 0.6:
        ax, ay, az = 0.0, nz, -ny
    else:
        ax, ay, az = -nz, 0.0, nx
    scale = ring / math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax * scale, ay * scale, az * scale
    bx, by, bz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
    pieces = _chords(2.0 * math.pi * ring * focal / max(share * cz, NEAR))
    for n in range(pieces):
        for end in range(2):
            angle = 2.0 * math.pi * (n + end) / pieces
            c, s = math.cos(angle), math.sin(angle)
            segments[n, end, 0] = share * cx + c * ax + s * bx
            segments[n, end, 1] = share * cy + c * ay + s * by
            segments[n, end, 2] = share * cz + c * az + s * bz
    return pieces


@njit(cache=True, nogil=True)
def _cylinder(pose, radius, half, focal, segments):
    # tangent lines: radial directions e with e . camera = radius, the camera in the object's axes
    camera = np.empty(3)
    for axis in range(3):
        camera[axis] = -(pose[0, axis] * pose[0, 3] + pose[1, axis] * pose[1, 3] + pose[2, axis] * pose[2, 3])
    distance = math.sqrt(camera[0] * camera[0] + camera[1] * camera[1])
    direction = math.atan2(camera[1], camera[0])
    opening = math.acos(radius / distance) if distance > radius else 0.0  # the side is seen where |angle| < opening
    count = 0
    if distance > radius:
        for sign in (-1.0, 1.0):
            angle = direction + sign * opening
            x, y = radius * math.cos(angle), radius * math.sin(angle)
            _point(pose, x, y, -half, segments[count, 0])
            _point(pose, x, y, half, segments[count, 1])
            count += 1
    for side in (-1.0, 1.0):
        cap_seen = side * camera[2] > half
        # of a cap that is seen the outline is the far arc, of one that is not the near arc
        start = direction + (opening if cap_seen else -opening)
        extent = 2.0 * math.pi - 2.0 * opening if cap_seen else 2.0 * opening
        depth = pose[2, 3] + side * half * pose[2, 2]
        pieces = _chords(extent * radius * focal / max(depth, NEAR)) // 2 if extent > 1e-9 else 0
        for n in range(pieces):
            for end in range(2):
                angle = start + extent * (n + end) / pieces
                _point(pose, radius * math.cos(angle), radius * math.sin(angle), side * half, segments[count, end])
            count += 1
    return count


@njit(cache=True, nogil=True)
def outline(kind, pose, size, focal, segments):
    """Write the ends of the pieces of a solid's outline and return how many there are.

    kind, pose (4, 4), size (3,): as in Solids. focal : pixels, decides the length of chords.
    segments : (CHORDS, 2, 3) float64, written: the two ends of each piece in camera axes, metres.
    """
    if kind == BOX:
        return _box(pose, 0.5 * size, segments)
    if kind == SPHERE:
        return _sphere(pose, 0.5 * size[0], focal, segments)
    if kind == CYLINDER:
        return _cylinder(pose, 0.5 * size[0], 0.5 * size[2], focal, segments)
    return 0
