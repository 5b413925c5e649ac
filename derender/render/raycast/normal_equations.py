"""Misfit of the blurred antialiased image, its derivative, and Gauss-Newton's normal equations: sparse and exact.

The two large kernels, which draw the image and its derivatives, are called by their addresses: every optimiser that
calls `cost` and `normal_equations` by name would otherwise compile them once more.

A pixel costs rho(r) = r^2 / (2 sigma^2) under the normal likelihood (Eq. 6), and
-log((exp(-r^2 / (2 sigma^2)) + exp(-limit)) / (1 + exp(-limit))) under a mixture with a broad outlier whose share makes
the two equal at r^2 / (2 sigma^2) = `limit`. Constants are left out: differences of costs are differences of log
density.

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
from typing import NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.compilation.cache import address_of, call_for_nothing, njit
from derender.render.blur import blur_into
from derender.render.raycast.antialias import TWO, draw_antialiased
from derender.render.raycast.canvas import (
    FACE_BITS,
    FACE_MASK,
    NOTHING,
    QUADRIC,
    Canvas,
    curved_inverse_depth,
    new_canvas,
)
from derender.render.raycast.convex import DEPTH, FACES, LINES, NORMAL
from derender.scene.solids import CYLINDER

MOTION = 9  # twist (v, w) and the rates of the three extents


class Records(NamedTuple):
    """The Jacobian of the antialiased image by every solid's motion: d depth[pixel] = sum over records form .
    motion[solid].
    """

    pixel: np.ndarray  # (M,) int32, row * W + column
    solid: np.ndarray  # (M,) int32
    form: np.ndarray  # (M, MOTION) float64; only the first `filled[0]` are filled
    filled: np.ndarray  # (1,) int64, how many are


def new_records(camera: Camera, solids: int) -> Records:
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


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
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


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _plane(prepared, s, face):
    """The inverse depth a + b i + c j of a flat face."""
    p = FACES + 3 * face
    return prepared[s, p], prepared[s, p + 1], prepared[s, p + 2]


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
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


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
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


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _seen_depth(prepared, code, solid, w, background, column, row):
    """Depth of the piece with this code at a place on an outline of `solid`, whose own inverse depth there is w."""
    if code == NOTHING:
        return background
    owner, face = code >> FACE_BITS, code & FACE_MASK
    if face == QUADRIC:  # at its own limb: the chord may lie on either side
        return 1.0 / (w if owner == solid else curved_inverse_depth(prepared[owner], column, row))
    a, b, c = _plane(prepared, owner, face)
    return 1.0 / (a + b * column + c * row)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
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


@njit(cache=True, nogil=True, borrows=True)
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


# places in `numbers` and in `calls`
BACKGROUND, LIMIT = range(2)
DRAW, RECORD = range(2)


class Misfit(NamedTuple):
    """Arrays for comparing one observed image with scenes of one structure.

    blurred, weighted, weight : (H, W) float64: blurred model; derivative of the cost by it; weight of each pixel in the
        normal equations.
    """

    canvas: Canvas
    records: Records
    kinds: np.ndarray  # (N,) int32
    observed: np.ndarray  # (H, W) float64 metres, any number where missing
    precision: np.ndarray  # (H, W) float64, 1 / sigma^2, 0 where missing
    numbers: np.ndarray  # (2,) float64, the background depth and the limit of the robust cost (infinite: normal)
    floor: np.ndarray  # (H, W) float64, exp(-limit) of what is observed nearer than drawn, which a caller may raise
    taps: np.ndarray  # (R + 1,) float64, of the blur
    window: np.ndarray  # (4,) int64, all pixels
    row_costs: np.ndarray  # (H,) float64, of each row
    blurred: np.ndarray
    weighted: np.ndarray
    weight: np.ndarray
    images: np.ndarray  # (P, H * W) float64, derivatives of the blurred image by the parameters
    bounds: np.ndarray  # (P, 4) int64, where not zero
    calls: np.ndarray  # (2,) int64, addresses in this process of `draw_antialiased` and `record`


def new_misfit(
    camera: Camera,
    observed: np.ndarray,
    sigma: float | np.ndarray,
    kinds: np.ndarray,
    parameters: int,
    taps: np.ndarray,
    background: float,
    limit: float = math.inf,
) -> Misfit:
    """Allocate a Misfit. observed : (H, W), NaN or 0 where missing; sigma : metres, a number or (H, W)."""
    height, width = camera.height, camera.width
    seen = np.isfinite(observed) & (observed > 0)
    precision = np.where(seen, 1.0 / np.broadcast_to(np.asarray(sigma, float), (height, width)) ** 2, 0.0)
    kinds = np.ascontiguousarray(kinds, np.int32)
    blurred, weighted, weight = np.zeros((3, height, width))
    canvas, records = new_canvas(camera, len(kinds)), new_records(camera, len(kinds))
    window = np.array([0, width, 0, height], np.int64)
    poses, sizes, active = np.empty((len(kinds), 4, 4)), np.empty((len(kinds), 3)), np.empty(len(kinds), np.bool_)
    return Misfit(
        canvas=canvas,
        records=records,
        kinds=kinds,
        observed=np.ascontiguousarray(np.where(seen, observed, 0.0), np.float64),
        precision=np.ascontiguousarray(precision),
        numbers=np.array([background, limit], np.float64),
        floor=np.full((height, width), math.exp(-limit)),
        taps=np.ascontiguousarray(taps, np.float64),
        window=window,
        row_costs=np.zeros(height),
        blurred=blurred,
        weighted=weighted,
        weight=weight,
        images=np.zeros((parameters, height * width)),
        bounds=np.zeros((parameters, 4), np.int64),
        calls=np.array(
            [
                address_of(draw_antialiased, canvas, kinds, poses, sizes, 0.0, window),
                address_of(record, canvas, records, kinds, poses, sizes, active, 0.0, window, True),
            ],
            np.int64,
        ),
    )


@njit(cache=True, nogil=True)
def cost(misfit, poses, sizes):
    """Draw, blur and compare: return the cost (minus log likelihood up to a constant).

    What the last call has found is used again wherever nothing has changed, to the same last bit.
    """
    canvas = misfit.canvas
    height, width = misfit.observed.shape
    margin = misfit.taps.shape[0] - 1
    call_for_nothing(misfit.calls[DRAW], canvas, misfit.kinds, poses, sizes, misfit.numbers[BACKGROUND], misfit.window)
    dirty = canvas.dirty
    if dirty[0] < dirty[1]:
        left, right = max(dirty[0] - margin, 0), min(dirty[1] + margin, width)
        top, bottom = max(dirty[2] - margin, 0), min(dirty[3] + margin, height)
        blurred = np.empty((bottom - top, right - left))
        blur_into(misfit.taps, canvas.depth, left, right, top, bottom, blurred)
        misfit.blurred[top:bottom, left:right] = blurred
        compare_rows(misfit, top, bottom)
    total = 0.0
    for row in range(height):
        total += misfit.row_costs[row]
    return total


@njit(cache=True, nogil=True)
def compare_rows(misfit, top, bottom):
    """Compare the rows from `top` to `bottom` of the blurred image with the observed one: costs, weights, residuals."""
    width = misfit.observed.shape[1]
    normal, usual = math.isinf(misfit.numbers[LIMIT]), math.exp(-misfit.numbers[LIMIT])
    for row in range(top, bottom):
        total = 0.0
        if normal:
            for column in range(width):
                r = misfit.blurred[row, column] - misfit.observed[row, column]
                weight = misfit.precision[row, column]
                misfit.weight[row, column] = weight
                misfit.weighted[row, column] = weight * r
                total += 0.5 * weight * r * r
        else:
            for column in range(width):
                r = misfit.blurred[row, column] - misfit.observed[row, column]
                weight, floor = misfit.precision[row, column], misfit.floor[row, column] if r > 0.0 else usual
                inlier = math.exp(-min(0.5 * weight * r * r, 700.0))
                total += math.log((1.0 + floor) / (inlier + floor))
                weight *= inlier / (inlier + floor)
                misfit.weight[row, column] = weight
                misfit.weighted[row, column] = weight * r
        misfit.row_costs[row] = total


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})  # sums may be taken in any order: that is all it allows
def _products(first, second, weight, start, end):
    total = 0.0
    for pixel in range(start, end):
        total += first[pixel] * second[pixel] * weight[pixel]
    return total


@njit(cache=True, nogil=True)
def normal_equations(misfit, poses, sizes, motions, edges, gradient, hessian):
    """Write the gradient (P,) of the cost and its Gauss-Newton Hessian (P, P) by parameters with the given motions.

    `cost` must have been called last for the same placement: its image and residuals are used.
    motions : (P, N, MOTION) float64, the motion of each solid per unit of each parameter.
    """
    count, solids = motions.shape[0], motions.shape[1]
    width = misfit.blurred.shape[1]
    height = misfit.blurred.shape[0]
    active = np.zeros(solids, np.bool_)
    moves = np.zeros((count, solids), np.bool_)
    for p in range(count):
        for k in range(solids):
            for c in range(MOTION):
                if motions[p, k, c] != 0.0:
                    moves[p, k] = True
                    active[k] = True
    call_for_nothing(misfit.calls[RECORD], misfit.canvas, misfit.records, misfit.kinds, poses, sizes, active,
                     misfit.numbers[BACKGROUND], misfit.window, edges)  # fmt: skip
    spread(misfit.records, motions, moves, misfit.images)
    radius = misfit.taps.shape[0] - 1
    for p in range(count):
        bounds = misfit.bounds[p]
        bounds[0], bounds[1], bounds[2], bounds[3] = width, 0, height, 0
        for k in range(solids):
            if moves[p, k]:
                rectangle = misfit.canvas.rectangle[k]
                if rectangle[0] < rectangle[1]:
                    bounds[0], bounds[1] = min(bounds[0], rectangle[0]), max(bounds[1], rectangle[1])
                    bounds[2], bounds[3] = min(bounds[2], rectangle[2]), max(bounds[3], rectangle[3])
        bounds[0], bounds[1] = max(bounds[0] - radius, 0), min(bounds[1] + radius, width)
        bounds[2], bounds[3] = max(bounds[2] - radius, 0), min(bounds[3] + radius, height)
        if bounds[0] < bounds[1] and bounds[2] < bounds[3] and radius > 0:
            image = misfit.images[p].reshape(height, width)
            blurred = np.empty((bounds[3] - bounds[2], bounds[1] - bounds[0]))
            blur_into(misfit.taps, image, bounds[0], bounds[1], bounds[2], bounds[3], blurred)
            image[bounds[2] : bounds[3], bounds[0] : bounds[1]] = blurred
    weight, weighted = misfit.weight.reshape(height * width), misfit.weighted.reshape(height * width)
    for p in range(count):
        image = misfit.images[p]
        first = misfit.bounds[p]
        total = 0.0
        for row in range(first[2], first[3]):
            for pixel in range(row * width + first[0], row * width + first[1]):
                total += image[pixel] * weighted[pixel]
        gradient[p] = total
        for q in range(p + 1):
            second = misfit.bounds[q]
            left, right = max(first[0], second[0]), min(first[1], second[1])
            total = 0.0
            if left < right:
                for row in range(max(first[2], second[2]), min(first[3], second[3])):
                    total += _products(image, misfit.images[q], weight, row * width + left, row * width + right)
            hessian[p, q] = total
            hessian[q, p] = total
    for p in range(count):  # leave the images clean for the next call
        first = misfit.bounds[p]
        for row in range(first[2], first[3]):
            misfit.images[p, row * width + first[0] : row * width + first[1]] = 0.0
