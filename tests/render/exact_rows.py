"""An independent antialiased image to judge others by: depth integrated exactly along many rows of rays.

Along one row of the image every bound on inverse depth is an affine function of the column, or the root of a quadratic
one, so the columns at which anything can change (an outline, a crease, one solid behind another) are roots in closed
form. Between two of them depth is smooth and is integrated by Gauss and Legendre. Nothing is sampled but the rows, and
nothing of `antialias`, `pieces` or `outline` is used: only the bounds that the ray caster itself is made of.
"""

import numpy as np
from scipy.ndimage import maximum_filter, sobel

from derender.compilation.cache import njit
from derender.render.raycast.convex import DISCRIMINANT, FACES, PREPARED, QUADRIC_B, inverse_depth, prepare_solid
from derender.render.raycast.depth import camera_array
from derender.scene.solids import Solids

NODES, WEIGHTS = np.polynomial.legendre.leggauss(4)
PLACES = 0.5 * (3.0 * NODES - NODES**3)  # square roots at either end become smooth
SHARES = WEIGHTS * 0.5 * 1.5 * (1.0 - NODES**2)


@njit(cache=True, nogil=True)
def _add_roots(found, count, constant, linear, square):
    """Append the real roots of constant + linear x + square x^2."""
    inner = linear * linear - 4.0 * constant * square
    if inner < 0.0:
        return count
    half = -0.5 * (linear + np.copysign(np.sqrt(inner), linear))
    if square != 0.0:
        found[count] = half / square
        count += 1
    if half != 0.0:
        found[count] = constant / half
        count += 1
    return count


@njit(cache=True, nogil=True)
def _crossings(prepared, row, found):
    """Write the columns at which the solids' bounds cross in this row; return how many."""
    count, affine = 0, 0
    values = np.zeros((prepared.shape[0] * 6, 2))
    for k in range(prepared.shape[0]):
        for face in range(int(prepared[k, 0] + prepared[k, 1])):
            p = FACES + 3 * face
            values[affine, 0] = prepared[k, p] + prepared[k, p + 2] * row
            values[affine, 1] = prepared[k, p + 1]
            for before in range(affine):
                slope = values[affine, 1] - values[before, 1]
                if slope != 0.0:
                    found[count] = (values[before, 0] - values[affine, 0]) / slope
                    count += 1
            affine += 1
    for k in range(prepared.shape[0]):
        if prepared[k, 2] == 0.0:
            continue
        q, own = DISCRIMINANT, prepared[k]
        s, start, ratio = row - own[5], count, own[3]
        d0, d1 = own[q] + (own[q + 2] + own[q + 5] * s) * s, own[q + 1] + own[q + 4] * s
        d2 = own[q + 3]
        b0, b1 = own[QUADRIC_B] + own[QUADRIC_B + 2] * s, own[QUADRIC_B + 1]
        count = _add_roots(found, count, d0, d1, d2)
        for n in range(affine):  # (K w - B)^2 = D where the face w meets either root
            u = ratio * (values[n, 0] + values[n, 1] * own[4]) - b0
            v = ratio * values[n, 1] - b1
            count = _add_roots(found, count, u * u - d0, 2.0 * u * v - d1, v * v - d2)
        for n in range(start, count):
            found[n] += own[4]
    return count


@njit(cache=True, nogil=True)
def _integrate_rows(prepared, background, rows, image):
    """Write the mean depth over every pixel, by `rows` exact lines through each, the even and the odd ones apart."""
    _, height, width = image.shape
    solids = prepared.shape[0]
    most = 36 * solids * solids + solids * (2 + 12 * solids)
    found, ends = np.empty(most), np.empty(most + width + 1)
    for row in range(height):
        for line in range(rows):
            place = row + (line + 0.5) / rows - 0.5
            count = _crossings(prepared, place, found)
            total = 0
            for n in range(count):
                if -0.5 < found[n] < width - 0.5:
                    ends[total] = found[n]
                    total += 1
            for column in range(width + 1):
                ends[total] = column - 0.5
                total += 1
            order = np.sort(ends[:total])
            for n in range(1, total):
                length = order[n] - order[n - 1]
                if length < 1e-13:
                    continue
                middle = 0.5 * (order[n] + order[n - 1])
                column = min(max(int(np.floor(middle + 0.5)), 0), width - 1)
                for node in range(PLACES.shape[0]):
                    x = middle + 0.5 * length * PLACES[node]
                    nearest = 1.0 / background
                    for k in range(solids):
                        nearest = max(nearest, inverse_depth(prepared[k], x, place))
                    image[line % 2, row, column] += 2.0 * SHARES[node] * length / nearest / rows


def row_integrated_depth(solids: Solids, camera, background: float, lines: int = 64) -> np.ndarray:
    """Return the mean depth over each pixel, exact along rows, by `lines` (even) of them: (2, height, width).

    The first is found by every other line, the second by the others: their mean is the best guess, and their
    difference tells how good it is. Meshes are not known; a wall at `background` metres must be behind all.
    """
    return _integrated(solids.kind, solids.pose, solids.size, camera_array(camera), camera.width, camera.height,
                       background, lines)  # fmt: skip


def column_integrated_depth(solids: Solids, camera, background: float, lines: int = 64) -> np.ndarray:
    """Return the same, exact along columns: rows of the scene mirrored at the image's diagonal."""
    mirrored = solids.pose[:, [1, 0, 2, 3]]
    found = _integrated(solids.kind, mirrored, solids.size, camera_array(camera)[[1, 0, 3, 2]], camera.height,
                        camera.width, background, lines)  # fmt: skip
    return np.swapaxes(found, 1, 2)


def _integrated(kinds, poses, sizes, camera, width, height, background, lines):
    prepared, image = np.zeros((len(kinds), PREPARED)), np.zeros((2, height, width))
    for k, kind in enumerate(kinds):
        pose, size = np.ascontiguousarray(poses[k], np.float64), np.ascontiguousarray(sizes[k], np.float64)
        prepare_solid(kind, pose, size, camera, width, height, prepared[k], np.zeros(4, int))
    _integrate_rows(prepared, float(background), lines, image)
    return image


def exact_derivative(scene, camera, background: float, step: float, lines: int = 64) -> np.ndarray:
    """Return central differences (height, width) of the mean depth of scene(h), Solids at a place h of some motion.

    The place of each crossing is exact, so the step can be so small that only the number of lines matters. An edge is
    found best by lines across it: rows and columns are weighed by how much depth changes along them and by how well
    their halves agree.
    """
    after, before = scene(step), scene(-step)
    shown = row_integrated_depth(scene(0.0), camera, background, 8).mean(axis=0)
    total, weights = np.zeros(shown.shape), np.zeros(shown.shape)
    for integrated, axis in ((row_integrated_depth, 1), (column_integrated_depth, 0)):
        halves = integrated(after, camera, background, lines) - integrated(before, camera, background, lines)
        halves /= 2.0 * step
        doubt = maximum_filter((halves[0] - halves[1]) ** 2, 3) + 1e-8 * np.max(halves**2)
        weight = (sobel(shown, axis) ** 2 + 1e-12) / doubt
        total += weight * halves.mean(axis=0)
        weights += weight
    return total / weights
