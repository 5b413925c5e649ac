"""What every pixel of the antialiased depth image does when a solid moves or grows: sparse, exact, one pass.

A point p of a solid with pose (R, c) and size s moves by v + w x p + R (q_k / s_k) e_k ds_k, q = R'(p - c), under the
twist (v, w) about the camera's centre and the growth ds: nine numbers, its *motion*. The derivative of the area
integral of depth over a pixel has two terms:
* inside: the depth at a pixel changes by n . dp / (n . r), n the normal, r the ray with unit z;
* at outlines: an outline element of ds pixels whose normal through the camera's centre is N (outwards) moves outwards
  by N . dp / (z |(N_x / fx, N_y / fy)|) pixels: the piece inside gains its depth times that, the piece outside loses
  its own. Every piece's borders are taken for themselves, so what is hidden, or seen through, needs no search; where
  two pieces of one face meet, the two cancel.
Borders where depth is continuous (creases, contact lines) cancel too and are left out. All this is `weight * N . dp`,
a linear form on motions (a covector): `Records` list pixel, solid and form.
"""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from derender.compilation.cache import njit
from derender.render.raycast.canvas import FACE_BITS, FACE_MASK, NOTHING, QUADRIC
from derender.render.raycast.convex import FACES
from derender.render.raycast.integral import TWO
from derender.render.raycast.outline import DEPTH, LINES, NORMAL
from derender.render.raycast.pieces import curved_inverse_depth
from derender.scene.solids import CYLINDER

if TYPE_CHECKING:
    from derender.camera.intrinsics import Camera

MOTION = 9  # twist (v, w) and the rates of the three extents


class Records(NamedTuple):
    """The Jacobian of the antialiased image by every solid's motion: d depth[pixel] = sum over records form .
    motion[solid].

    pixel : (M,) int32, row * W + column. solid : (M,) int32. form : (M, MOTION) float64; only the first `filled[0]`
        are filled.
    filled : (1,) int64, how many are.
    """

    pixel: np.ndarray
    solid: np.ndarray
    form: np.ndarray
    filled: np.ndarray


def new_records(camera: "Camera", solids: int) -> Records:
    """Allocate Records for a Camera and this many solids: four for every pixel, and the outlines."""
    size = 4 * camera.width * camera.height + solids * 16 * (camera.width + camera.height)
    return Records(np.zeros(size, np.int32), np.zeros(size, np.int32), np.zeros((size, MOTION)), np.zeros(1, np.int64))


@njit(cache=True, nogil=True)
def spread(records, motions, moves, images):
    """Forward mode: add the derivative of the antialiased image by parameters to images (P, H * W).

    motions : (P, N, MOTION) float64, the motion of each solid per unit of each parameter; moves : (P, N) bool, where
    that is not zero.
    """
    for m in range(records.filled[0]):
        pixel, form = records.pixel[m], records.form[m]
        k = records.solid[m]
        for p in range(motions.shape[0]):
            if moves[p, k]:
                motion = motions[p, k]
                value = 0.0
                for c in range(MOTION):
                    value += form[c] * motion[c]
                images[p, pixel] += value


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def add_form(forms, slot, weight, nx, ny, nz, px, py, pz, poses, sizes, s):
    """Add weight * N . dp at a point p of solid s, as a linear form on motions, to forms[slot] (MOTION,)."""
    nx, ny, nz = weight * nx, weight * ny, weight * nz
    forms[slot, 0] += nx
    forms[slot, 1] += ny
    forms[slot, 2] += nz
    forms[slot, 3] += py * nz - pz * ny
    forms[slot, 4] += pz * nx - px * nz
    forms[slot, 5] += px * ny - py * nx
    px, py, pz = px - poses[s, 0, 3], py - poses[s, 1, 3], pz - poses[s, 2, 3]
    for k in range(3):
        if sizes[s, k] > 0.0:
            a, b, c = poses[s, 0, k], poses[s, 1, k], poses[s, 2, k]
            forms[slot, 6 + k] += (a * nx + b * ny + c * nz) * (a * px + b * py + c * pz) / sizes[s, k]


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _plane(prepared, s, face):
    """The inverse depth a + b i + c j of a flat face."""
    p = FACES + 3 * face
    return prepared[s, p], prepared[s, p + 1], prepared[s, p + 2]


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _add_surface(forms, slot, weight, kinds, poses, sizes, prepared, s, face, column, row, camera):
    """Add the inner term of one place, weight * n . dp / (n . r), to forms[slot]."""
    x, y = (column - camera[2]) / camera[0], (row - camera[3]) / camera[1]
    if face != QUADRIC:
        a, b, c = _plane(prepared, s, face)
        depth = 1.0 / (a + b * column + c * row)
        # the plane is n . p = 1 with n = (b fx, c fy, a + b cx + c cy), so n . r is the inverse depth
        nx, ny, nz = b * camera[0], c * camera[1], a + b * camera[2] + c * camera[3]
        add_form(forms, slot, weight * depth, nx, ny, nz, depth * x, depth * y, depth, poses, sizes, s)
        return
    depth = 1.0 / curved_inverse_depth(prepared[s], column, row)
    px, py, pz = depth * x, depth * y, depth
    nx, ny, nz = px - poses[s, 0, 3], py - poses[s, 1, 3], pz - poses[s, 2, 3]
    if kinds[s] == CYLINDER:
        along = nx * poses[s, 0, 2] + ny * poses[s, 1, 2] + nz * poses[s, 2, 2]
        nx, ny, nz = nx - along * poses[s, 0, 2], ny - along * poses[s, 1, 2], nz - along * poses[s, 2, 2]
    facing = nx * x + ny * y + nz
    if facing < 0.0:
        add_form(forms, slot, weight / facing, nx, ny, nz, px, py, pz, poses, sizes, s)


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _slot_of(pixels, solids, forms, begin, count, pixel, solid):
    """The index of a solid's record among those of the present pixel, from `begin` on; `count` if it is new, -1 if
    there is no room."""
    for slot in range(begin, count):
        if solids[slot] == solid:
            return slot
    if count >= pixels.shape[0]:
        return -1
    pixels[count], solids[count] = pixel, solid
    for c in range(MOTION):
        forms[count, c] = 0.0
    return count


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _seen_depth(prepared, code, solid, w, background, column, row):
    """Depth of the piece with this code at a place on an outline of `solid`, whose own inverse depth there is w."""
    if code == NOTHING:
        return background
    owner, face = code >> FACE_BITS, code & FACE_MASK
    if face == QUADRIC:  # at its own limb: the chord may lie on either side
        return 1.0 / (w if owner == solid else curved_inverse_depth(prepared[owner], column, row))
    a, b, c = _plane(prepared, owner, face)
    return 1.0 / (a + b * column + c * row)


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _add_border(forms, slot, solid, edge, code, x0, y0, x1, y1, lines, prepared, camera, background, poses, sizes):
    """Add what a piece gains or loses where its border, a part of an outline, moves: depth times speed, integrated."""
    line = edge >> 1
    dx, dy = x1 - x0, y1 - y0
    length = math.sqrt(dx * dx + dy * dy)
    if length < 1e-12:
        return
    if edge & 1:
        length = -length
    nx, ny, nz = lines[line, NORMAL], lines[line, NORMAL + 1], lines[line, NORMAL + 2]
    for node in range(2):
        share = 0.5 + (node - 0.5) * TWO
        column, row = x0 + share * dx, y0 + share * dy
        w = lines[line, DEPTH] + lines[line, DEPTH + 1] * column + lines[line, DEPTH + 2] * row
        if w > 0.0:
            weight = 0.5 * length * w * _seen_depth(prepared, code, solid, w, background, column, row)
            depth = 1.0 / w
            x, y = depth * (column - camera[2]) / camera[0], depth * (row - camera[3]) / camera[1]
            add_form(forms, slot, weight, nx, ny, nz, x, y, depth, poses, sizes, solid)


@njit(cache=True, nogil=True)
def record(canvas, records, kinds, poses, sizes, active, background, window, edges):
    """Record how the antialiased depths in a window depend on the motions of the active solids.

    canvas : Canvas as `draw_antialiased` has left it for the same solids, background and window.
    records : Records, overwritten. active : (N,) bool, the solids whose motion matters.
    edges : bool; False leaves the occlusion edges out (the misleading derivative, for comparison).
    """
    camera, code, mixed, prepared, lines = canvas.camera, canvas.code, canvas.mixed, canvas.prepared, canvas.lines
    part_code, parts, border_code, borders = canvas.part_code, canvas.parts, canvas.border_code, canvas.borders
    pixels, solids, forms = records.pixel, records.solid, records.form
    part_range, border_range = canvas.part_range, canvas.border_range
    width, count = code.shape[1], 0
    left, right, top, bottom = window[1], window[0], window[3], window[2]
    for k in range(kinds.shape[0]):  # elsewhere no active solid is seen
        rectangle = canvas.rectangle[k]
        if active[k] and rectangle[0] < rectangle[1]:
            left, right = min(left, max(rectangle[0], window[0])), max(right, min(rectangle[1], window[1]))
            top, bottom = min(top, max(rectangle[2], window[2])), max(bottom, min(rectangle[3], window[3]))
    for row in range(top, bottom):
        for column in range(left, right):
            pixel, begin, here = row * width + column, count, code[row, column]
            if mixed[row, column] == 0:
                if here != NOTHING and active[here >> FACE_BITS]:
                    k, face = here >> FACE_BITS, here & FACE_MASK
                    slot = _slot_of(pixels, solids, forms, begin, count, pixel, k)
                    x, y = float(column), float(row)
                    if slot >= 0:
                        _add_surface(forms, slot, 1.0, kinds, poses, sizes, prepared, k, face, x, y, camera)
                        count += 1
                continue
            for part in range(part_range[pixel, 0], part_range[pixel, 1]):
                k, face = part_code[part] >> FACE_BITS, part_code[part] & FACE_MASK
                slot = _slot_of(pixels, solids, forms, begin, count, pixel, k) if active[k] else -1
                if slot >= 0:
                    count = max(count, slot + 1)
                    _add_surface(forms, slot, parts[part, 0], kinds, poses, sizes, prepared, k, face,
                                 parts[part, 1], parts[part, 2], camera)  # fmt: skip
            if not edges:
                continue
            for border in range(border_range[pixel, 0], border_range[pixel, 1]):
                edge = border_code[border, 0]
                k = (edge >> 1) // LINES
                slot = _slot_of(pixels, solids, forms, begin, count, pixel, k) if active[k] else -1
                if slot >= 0:
                    count = max(count, slot + 1)
                    _add_border(forms, slot, k, edge, border_code[border, 1], borders[border, 0], borders[border, 1],
                                borders[border, 2], borders[border, 3], lines, prepared, camera, background,
                                poses, sizes)  # fmt: skip
    records.filled[0] = count
