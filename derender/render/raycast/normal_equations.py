"""Misfit of the blurred antialiased image, its gradient, and Gauss-Newton's normal equations: all compiled.

The two large kernels, which draw the image and its derivatives, are called by their addresses: every optimiser that
calls `cost` and `normal_equations` by name would otherwise compile them once more.

A pixel costs rho(r) = r^2 / (2 sigma^2) under the normal likelihood (Eq. 6), and
-log((exp(-r^2 / (2 sigma^2)) + exp(-limit)) / (1 + exp(-limit))) under a mixture with a broad outlier whose share makes
the two equal at r^2 / (2 sigma^2) = `limit`. Constants are left out: differences of costs are differences of log
density.
"""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from derender.compilation.cache import address_of, call_for_nothing, njit
from derender.render.raycast.antialias import draw_antialiased
from derender.render.raycast.canvas import Canvas, new_canvas
from derender.render.raycast.sensitivity import MOTION, Records, new_records, record, spread

if TYPE_CHECKING:
    from derender.camera.intrinsics import Camera

# places in `numbers` and in `calls`
BACKGROUND, LIMIT = range(2)
DRAW, RECORD = range(2)


class Misfit(NamedTuple):
    """Arrays for comparing one observed image with scenes of one structure.

    canvas : Canvas. records : Records. kinds : (N,) int32.
    observed : (H, W) float64 metres, any number where missing. precision : (H, W) float64, 1 / sigma^2, 0 where
        missing.
    numbers : (2,) float64, the background depth and the limit of the robust cost (infinite: normal).
    taps : (R + 1,) float64, of the blur. window : (4,) int64, all pixels.
    row_costs : (H,) float64, of each row.
    blurred, weighted, scratch, weight, spare : (H, W) float64: blurred model; derivative of the cost by it; scratch;
        weight of each pixel in the normal equations; scratch.
    images : (P, H * W) float64, derivatives of the blurred image by the parameters. bounds : (P, 4) int64, where not
        zero.
    calls : (2,) int64, addresses in this process of `draw_antialiased` and `record`.
    """

    canvas: Canvas
    records: Records
    kinds: np.ndarray
    observed: np.ndarray
    precision: np.ndarray
    numbers: np.ndarray
    taps: np.ndarray
    window: np.ndarray
    row_costs: np.ndarray
    blurred: np.ndarray
    weighted: np.ndarray
    scratch: np.ndarray
    weight: np.ndarray
    spare: np.ndarray
    images: np.ndarray
    bounds: np.ndarray
    calls: np.ndarray


def new_misfit(
    camera: "Camera",
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
    blurred, weighted, scratch, weight, spare = np.zeros((5, height, width))
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
        taps=np.ascontiguousarray(taps, np.float64),
        window=window,
        row_costs=np.zeros(height),
        blurred=blurred,
        weighted=weighted,
        scratch=scratch,
        weight=weight,
        spare=spare,
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
    dirty, changed = canvas.dirty, np.empty(4, np.int64)
    if dirty[0] < dirty[1]:
        changed[0], changed[1] = max(dirty[0] - margin, 0), min(dirty[1] + margin, width)
        changed[2], changed[3] = max(dirty[2] - margin, 0), min(dirty[3] + margin, height)
        blur_rectangle(canvas.depth, misfit.taps, changed, misfit.scratch, misfit.blurred)
        compare_rows(misfit, changed[2], changed[3])
    total = 0.0
    for row in range(height):
        total += misfit.row_costs[row]
    return total


@njit(cache=True, nogil=True)
def compare_rows(misfit, top, bottom):
    """Compare the rows from `top` to `bottom` of the blurred image with the observed one: costs, weights, residuals."""
    width = misfit.observed.shape[1]
    limit = misfit.numbers[LIMIT]
    floor = math.exp(-limit)
    for row in range(top, bottom):
        total = 0.0
        if math.isinf(limit):
            for column in range(width):
                r = misfit.blurred[row, column] - misfit.observed[row, column]
                weight = misfit.precision[row, column]
                misfit.weight[row, column] = weight
                misfit.weighted[row, column] = weight * r
                total += 0.5 * weight * r * r
        else:
            for column in range(width):
                r = misfit.blurred[row, column] - misfit.observed[row, column]
                weight = misfit.precision[row, column]
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
    blurred = misfit.spare
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
            blur_rectangle(image, misfit.taps, bounds, misfit.scratch, blurred)
            for row in range(bounds[2], bounds[3]):
                image[row, bounds[0] : bounds[1]] = blurred[row, bounds[0] : bounds[1]]
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


@njit(cache=True, nogil=True)
def blur_rectangle(image, taps, rectangle, scratch, blurred):
    """Write the blurred image inside a rectangle (its margin is read from `image`, edges replicated).

    image, blurred, scratch : (H, W) float64, different arrays. taps : (R + 1,) float64 from the centre outwards.
    rectangle : (4,) int64, first column, end column, first row, end row.
    """
    height, width = image.shape
    radius = taps.shape[0] - 1
    c0, c1, r0, r1 = rectangle[0], rectangle[1], rectangle[2], rectangle[3]
    for row in range(max(r0 - radius, 0), min(r1 + radius, height)):
        left, right = max(c0, min(radius, c1)), min(c1, max(width - radius, c0))
        for column in range(c0, c1):
            scratch[row, column] = taps[0] * image[row, column]
        for k in range(1, radius + 1):
            tap = taps[k]
            for column in range(c0, min(left, c1)):
                scratch[row, column] += tap * (image[row, max(column - k, 0)] + image[row, min(column + k, width - 1)])
            for column in range(left, right):
                scratch[row, column] += tap * (image[row, column - k] + image[row, column + k])
            for column in range(max(right, left), c1):
                scratch[row, column] += tap * (image[row, max(column - k, 0)] + image[row, min(column + k, width - 1)])
    for row in range(r0, r1):
        for column in range(c0, c1):
            blurred[row, column] = taps[0] * scratch[row, column]
        for k in range(1, radius + 1):
            tap, above, below = taps[k], max(row - k, 0), min(row + k, height - 1)
            for column in range(c0, c1):
                blurred[row, column] += tap * (scratch[above, column] + scratch[below, column])
