"""Eq. 1 compiled: where the root and each vertex stand, from the numbers that a proposal has filled in."""

import math

from derender.compilation.cache import call_for_nothing, njit
from derender.posterior.compiled.layout import (
    CHILD_FACE,
    CONTACT_CODE,
    KIND,
    NEXT,
    PARENT,
    PARENT_FACE,
    POSE_AT,
    SHAPES,
    SIZES,
)
from derender.scene.contacts.compiled import SIX_DOF, compose

FREE_ROOT, FIXED_ROOT, LOOKED_AT = SIX_DOF, 100, 101  # codes of the root


@njit(cache=True, nogil=True)
def place_root(vertices, numbers, pose):
    """Write the proposed pose of the root, which is the last vertex; a fixed one is there already."""
    root = vertices.shape[1] - 1
    code, values, out = vertices[CONTACT_CODE, root], numbers[NEXT, root], pose[NEXT, root]
    if code == FREE_ROOT:  # the same as a free contact: x, y, z, qw, qx, qy, qz
        size = values[SIZES:SHAPES]
        call_for_nothing(vertices[POSE_AT, root], SIX_DOF, vertices[KIND, root], size, vertices[KIND, root], size,
                         vertices[PARENT_FACE, root], vertices[CHILD_FACE, root], values, out)  # fmt: skip
    elif code == LOOKED_AT:  # Rz(roll) T(0, 0, distance) Rx(pi / 2 + elevation) Rz(azimuth)
        c, s = math.cos(math.pi / 2 + values[1]), math.sin(math.pi / 2 + values[1])
        cz, sz = math.cos(values[2]), math.sin(values[2])
        cr, sr = math.cos(values[3]), math.sin(values[3])
        out[0, 0], out[0, 1], out[0, 2] = cr * cz - sr * c * sz, -cr * sz - sr * c * cz, sr * s
        out[1, 0], out[1, 1], out[1, 2] = sr * cz + cr * c * sz, -sr * sz + cr * c * cz, -cr * s
        out[2, 0], out[2, 1], out[2, 2] = s * sz, s * cz, c
        out[0, 3], out[1, 3], out[2, 3] = 0.0, 0.0, values[0]


@njit(cache=True, nogil=True)
def seen_from(frame, pose, out):
    """Write the (4, 4) pose in the axes of a frame, frame^-1 pose, into the first three rows of `out`."""
    for i in range(3):
        for j in range(4):
            total = 0.0
            for k in range(3):
                total += frame[k, i] * (pose[k, j] - (frame[k, 3] if j == 3 else 0.0))
            out[i, j] = total


@njit(cache=True, nogil=True)
def place(vertices, extents, numbers, pose, relative, n):
    """Write the proposed extents and pose of vertex n; its parent's are there."""
    parent = vertices[PARENT, n]
    own = numbers[NEXT, n]
    for i in range(3):
        size = extents[n, 0, i]
        for j in range(3):
            size += extents[n, j + 1, i] * own[SHAPES + j]
        own[SIZES + i] = size
    call_for_nothing(vertices[POSE_AT, n], vertices[CONTACT_CODE, n], vertices[KIND, parent],
                     numbers[NEXT, parent, SIZES:SHAPES], vertices[KIND, n], own[SIZES:SHAPES],
                     vertices[PARENT_FACE, n], vertices[CHILD_FACE, n], own, relative)  # fmt: skip
    compose(pose[NEXT, parent], relative, pose[NEXT, n])
