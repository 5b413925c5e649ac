"""What every pixel of the antialiased depth image does when a solid moves or grows: sparse, exact, one pass.

A point p of a solid with pose (R, c) and size s moves by v + w x p + R (q_k / s_k) e_k ds_k, q = R'(p - c), under the
twist (v, w) about the camera's centre and the growth ds: nine numbers, its *motion*. The derivative of the area
integral
of depth over a pixel has two terms:
* inside: the depth at a pixel changes by n . dp / (n . r), n the normal, r the ray with unit z;
* at outlines: an outline element of ds pixels whose normal through the camera's centre is N (outwards) moves outwards
by
  N . dp / (z |(N_x / fx, N_y / fy)|) pixels and replaces the depth behind by its own.
Where a nearer solid hides the outline there is nothing; where the solid touches what lies behind, the step is zero and
so is the term. Both are `weight * N . dp`, a linear form on motions (a covector): `Records` list pixel, solid and form.
"""

import math

from derender.kernel_cache import njit
from derender.model.solids import CYLINDER, MESH, PLANE
from derender.vision.raycast.canvas import FACE_BITS, FACE_MASK, NOTHING, QUADRIC, SAMPLES, SPLIT
from derender.vision.raycast.convex import FACES, inverse_depth
from derender.vision.raycast.silhouette import NEAR, outline

BISECTIONS = 10  # an outline's hidden part is found to a thousandth of a pixel


@njit(cache=True, nogil=True)
def add_form(form, weight, nx, ny, nz, px, py, pz, pose, size):
    """Add weight * N . dp, as a linear form on motions, to `form` (MOTION,)."""
    form[0] += weight * nx
    form[1] += weight * ny
    form[2] += weight * nz
    form[3] += weight * (py * nz - pz * ny)
    form[4] += weight * (pz * nx - px * nz)
    form[5] += weight * (px * ny - py * nx)
    dx, dy, dz = px - pose[0, 3], py - pose[1, 3], pz - pose[2, 3]
    for k in range(3):
        if size[k] > 0.0:
            a, b, c = pose[0, k], pose[1, k], pose[2, k]
            form[6 + k] += weight * (a * nx + b * ny + c * nz) * (a * dx + b * dy + c * dz) / size[k]


@njit(cache=True, nogil=True)
def _add_surface(form, weight, kind, pose, size, prepared, face, column, row, camera):
    """Add the inner term of one sample: weight * n . dp / (n . r)."""
    x, y = (column - camera[2]) / camera[0], (row - camera[3]) / camera[1]
    if face != QUADRIC:
        p = FACES + 3 * face
        a, b, c = prepared[p], prepared[p + 1], prepared[p + 2]
        depth = 1.0 / (a + b * column + c * row)
        # the plane is n . p = 1 with n = (b fx, c fy, a + b cx + c cy), so n . r is the inverse depth
        add_form(
            form,
            weight * depth,
            b * camera[0],
            c * camera[1],
            a + b * camera[2] + c * camera[3],
            depth * x,
            depth * y,
            depth,
            pose,
            size,
        )
        return
    depth = 1.0 / inverse_depth(prepared, column, row)
    px, py, pz = depth * x, depth * y, depth
    nx, ny, nz = px - pose[0, 3], py - pose[1, 3], pz - pose[2, 3]
    if kind == CYLINDER:
        along = nx * pose[0, 2] + ny * pose[1, 2] + nz * pose[2, 2]
        nx, ny, nz = nx - along * pose[0, 2], ny - along * pose[1, 2], nz - along * pose[2, 2]
    facing = nx * x + ny * y + nz
    if facing < 0.0:
        add_form(form, weight / facing, nx, ny, nz, px, py, pz, pose, size)


@njit(cache=True, nogil=True)
def _surfaces(canvas, records, kinds, poses, sizes, active, window):
    """Records of the inner term for all pixels of the window that see an active solid."""
    camera, inverse, code = canvas.camera, canvas.inverse, canvas.code
    width = inverse.shape[1]
    count = records.count[0]
    for row in range(window[2], window[3]):
        for column in range(window[0], window[1]):
            if canvas.mixed[row, column] == 0 and code[row, column] != NOTHING:
                k = code[row, column] >> FACE_BITS
                if active[k]:
                    records.pixel[count], records.solid[count] = row * width + column, k
                    form = records.form[count]
                    form[:] = 0.0
                    _add_surface(
                        form,
                        1.0,
                        kinds[k],
                        poses[k],
                        sizes[k],
                        canvas.prepared[k],
                        code[row, column] & FACE_MASK,
                        float(column),
                        float(row),
                        camera,
                    )
                    count += 1
    weight = 1.0 / SAMPLES
    for m in range(canvas.count[0]):
        pixel = canvas.mixed_pixels[m]
        row, column = pixel // width, pixel % width
        codes = canvas.samples[m]
        begin = count
        if codes[0] == SPLIT:
            for part in range(2):
                share = canvas.split[m, part]
                here = codes[1 + part]
                if here == NOTHING or not active[here >> FACE_BITS]:
                    continue
                k = here >> FACE_BITS
                if part == 0 or count == begin or records.solid[count - 1] != k:
                    records.pixel[count], records.solid[count] = pixel, k
                    records.form[count] = 0.0
                    count += 1
                _add_surface(
                    records.form[count - 1],
                    share[0],
                    kinds[k],
                    poses[k],
                    sizes[k],
                    canvas.prepared[k],
                    here & FACE_MASK,
                    column + share[1],
                    row + share[2],
                    camera,
                )
            continue
        for n in range(SAMPLES):
            here = codes[n]
            if here == NOTHING or not active[here >> FACE_BITS]:
                continue
            k, face = here >> FACE_BITS, here & FACE_MASK
            seen = 0.0
            x, y = 0.0, 0.0
            if (
                face != QUADRIC
            ):  # one form for all samples of a flat face, at their mean, when the first of them comes up
                for o in range(SAMPLES):
                    if codes[o] == here:
                        if o < n:
                            seen = 0.0
                            break
                        seen += 1.0
                        x += canvas.offsets[o, 0]
                        y += canvas.offsets[o, 1]
                if seen == 0.0:
                    continue
                x, y = x / seen, y / seen
            else:
                seen, x, y = 1.0, canvas.offsets[n, 0], canvas.offsets[n, 1]
            slot = begin
            while slot < count and records.solid[slot] != k:
                slot += 1
            if slot == count:
                if count >= records.pixel.shape[0]:
                    break
                records.pixel[count], records.solid[count] = pixel, k
                records.form[count] = 0.0
                count += 1
            _add_surface(
                records.form[slot],
                weight * seen,
                kinds[k],
                poses[k],
                sizes[k],
                canvas.prepared[k],
                face,
                column + x,
                row + y,
                camera,
            )
    records.count[0] = count


@njit(cache=True, nogil=True)
def nearest(canvas, kinds, without, column, row, background):
    """Return (inverse depth, index) of the nearest of all solids but one along a ray; of the wall, -1, if none."""
    best, label = 1.0 / background, -1
    i, j = math.floor(column + 0.5), math.floor(row + 0.5)
    for k in range(kinds.shape[0]):
        rectangle = canvas.rectangle[k]
        if k != without and rectangle[0] <= i < rectangle[1] and rectangle[2] <= j < rectangle[3]:
            value = inverse_depth(canvas.prepared[k], column, row)
            if value > best:
                best, label = value, k
    return best, label


@njit(cache=True, nogil=True)
def _behind(canvas, kinds, k, column, row, w, background):
    """What lies behind an outline of solid k at inverse depth w: a solid's index, -1 for nothing, -2 if hidden
    itself."""
    value, label = nearest(canvas, kinds, k, column, row, background)
    return label if w > value else -2


@njit(cache=True, nogil=True)
def _walk(canvas, records, kinds, k, pose, size, start, end, background, window):
    """Walk along one straight piece of the outline of solid k, pixel by pixel, and record its visible parts."""
    camera = canvas.camera
    x0, y0, z0, x1, y1, z1 = start[0], start[1], start[2], end[0], end[1], end[2]
    if z0 < NEAR and z1 < NEAR:
        return
    if z0 < NEAR or z1 < NEAR:
        share = (NEAR - z0) / (z1 - z0)
        x, y = x0 + share * (x1 - x0), y0 + share * (y1 - y0)
        if z0 < NEAR:
            x0, y0, z0 = x, y, NEAR
        else:
            x1, y1, z1 = x, y, NEAR
    # normal of the plane through the camera's centre and the piece, away from the solid's centre
    nx, ny, nz = y0 * z1 - z0 * y1, z0 * x1 - x0 * z1, x0 * y1 - y0 * x1
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    if length < 1e-15:
        return
    if nx * pose[0, 3] + ny * pose[1, 3] + nz * pose[2, 3] > 0.0:
        length = -length
    nx, ny, nz = nx / length, ny / length, nz / length
    w0, w1 = 1.0 / z0, 1.0 / z1
    i0, j0 = camera[0] * x0 * w0 + camera[2], camera[1] * y0 * w0 + camera[3]
    i1, j1 = camera[0] * x1 * w1 + camera[2], camera[1] * y1 * w1 + camera[3]
    di, dj = i1 - i0, j1 - j0
    pixels = math.sqrt(di * di + dj * dj)
    if pixels < 1e-9:
        return
    # clip to the window's pixels (Liang and Barsky)
    enter, leave = 0.0, 1.0
    for axis in range(2):
        origin, delta = (i0, di) if axis == 0 else (j0, dj)
        low, high = window[2 * axis] - 0.5, window[2 * axis + 1] - 0.5
        if delta == 0.0:
            if origin < low or origin >= high:
                return
            continue
        a, b = (low - origin) / delta, (high - origin) / delta
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    if enter >= leave:
        return
    scale = 1.0 / math.sqrt((nx / camera[0]) ** 2 + (ny / camera[1]) ** 2)
    width = canvas.inverse.shape[1]
    count = records.count[0]
    t = enter
    state = _behind(canvas, kinds, k, i0 + t * di, j0 + t * dj, w0 + t * (w1 - w0), background)
    while t < leave - 1e-12 and count < records.pixel.shape[0]:
        # to the next border between pixels
        column, row = i0 + t * di, j0 + t * dj
        following = min(leave, t + 1.0 / pixels)
        if di != 0.0:
            border = math.floor(column + 0.5 + (1e-9 if di > 0.0 else -1e-9)) + (0.5 if di > 0.0 else -0.5)
            following = min(following, (border - i0) / di)
        if dj != 0.0:
            border = math.floor(row + 0.5 + (1e-9 if dj > 0.0 else -1e-9)) + (0.5 if dj > 0.0 else -0.5)
            following = min(following, (border - j0) / dj)
        following = max(following, t + 1e-9)
        state_after = _behind(
            canvas, kinds, k, i0 + following * di, j0 + following * dj, w0 + following * (w1 - w0), background
        )
        if state_after != state:  # stop where the one that hides it, or that is behind it, changes
            low, high = t, following
            for _ in range(BISECTIONS):
                middle = 0.5 * (low + high)
                if (
                    _behind(canvas, kinds, k, i0 + middle * di, j0 + middle * dj, w0 + middle * (w1 - w0), background)
                    == state
                ):
                    low = middle
                else:
                    high = middle
            following = high
            state_after = _behind(canvas, kinds, k, i0 + high * di, j0 + high * dj, w0 + high * (w1 - w0), background)
        middle = 0.5 * (t + following)
        column, row = i0 + middle * di, j0 + middle * dj
        w = w0 + middle * (w1 - w0)
        behind, label = nearest(canvas, kinds, k, column, row, background)
        if w > behind:
            depth = 1.0 / w
            step = depth - 1.0 / behind
            i, j = int(math.floor(column + 0.5)), int(math.floor(row + 0.5))
            if window[0] <= i < window[1] and window[2] <= j < window[3]:
                pixel = j * width + i
                if count == 0 or records.pixel[count - 1] != pixel or records.solid[count - 1] != k:
                    records.pixel[count], records.solid[count] = pixel, k
                    records.form[count] = 0.0
                    count += 1
                add_form(
                    records.form[count - 1],
                    step * (following - t) * pixels * scale * w,
                    nx,
                    ny,
                    nz,
                    depth * (column - camera[2]) / camera[0],
                    depth * (row - camera[3]) / camera[1],
                    depth,
                    pose,
                    size,
                )
        t, state = following, state_after
    records.count[0] = count


@njit(cache=True, nogil=True)
def record(canvas, records, kinds, poses, sizes, active, background, window, edges):
    """Record how the antialiased depths in a window depend on the motions of the active solids.

    Parameters
    ----------
    canvas : Canvas as `draw_antialiased` has left it for the same solids, background and window.
    records : Records, overwritten. active : (N,) bool, the solids whose motion matters.
    edges : bool; False leaves the occlusion edges out (the misleading derivative, for comparison).
    """
    records.count[0] = 0
    _surfaces(canvas, records, kinds, poses, sizes, active, window)
    if not edges:
        return
    focal = max(canvas.camera[0], canvas.camera[1])
    for k in range(kinds.shape[0]):
        rectangle = canvas.rectangle[k]
        if (
            not active[k]
            or kinds[k] == PLANE
            or kinds[k] == MESH
            or rectangle[0] >= window[1]
            or rectangle[1] <= window[0]
            or rectangle[2] >= window[3]
            or rectangle[3] <= window[2]
        ):
            continue
        pieces = outline(kinds[k], poses[k], sizes[k], focal, records.segments)
        for n in range(pieces):
            _walk(
                canvas,
                records,
                kinds,
                k,
                poses[k],
                sizes[k],
                records.segments[n, 0],
                records.segments[n, 1],
                background,
                window,
            )
