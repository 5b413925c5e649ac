"""Score a region of blurred pixels: the compiled twins of the likelihoods' `per_pixel`.

Under noise that neighbouring pixels share this goes row by row: first how probably each pixel shows its surface, then
the scores, which look at that to the left and above. Outside the region it is as it was, for a region reaches a pixel
farther than the blur (`set_reach`).
"""

import math

import numpy as np

from derender.compilation.cache import njit
from derender.render.raycast.lane_names import (
    LANES,
    absolute,
    accumulate,
    add,
    divide,
    exponential,
    load,
    logarithm,
    maximum,
    minimum,
    multiply,
    multiply_add,
    reciprocal,
    splat,
    store,
    subtract,
    sum_lanes,
    where_at_least,
    zero_sum,
)
from derender.render.raycast.state import (
    CURRENT,
    DEPTH,
    GAUSSIAN,
    GOING_ON,
    HEIGHT,
    LIKELIHOOD,
    LIKELIHOOD_PARAMETERS,
    NO_RETURN,
    OBSERVED_IMAGE,
    PAD,
    SCORE,
    SHOWS,
    SIGMA,
    WIDTH,
)

# entries of `parameters` for the robust likelihood, as `Robust.row` lays them out
GROWTH, OUTLIER, NEAR, FAR, MISSING, MISSING_EDGE, EDGE_STEP = range(LIKELIHOOD_PARAMETERS, LIKELIHOOD_PARAMETERS + 7)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def score_gaussian(parameters, images, half, left, right, top, bottom, height):
    """Turn the blurred depth in images[SCORE + half] into squared residuals.

    Returns their sum and that of the current half's scores in the region.
    """
    new, old = zero_sum(), zero_sum()
    observed, score, current = images[OBSERVED_IMAGE], images[SCORE + half], images[SCORE + CURRENT]
    zero = splat(np.float32(0))
    for row in range(top, bottom):
        for column in range(left, right, LANES):
            residual = subtract(load(observed, row, column), load(score, row, column))
            square = maximum(multiply(residual, residual), zero)  # 0 where nothing was observed (NaN)
            old = accumulate(old, load(current, row, column))
            store(score, row, column, square)
            new = accumulate(new, square)
    return sum_lanes(new), sum_lanes(old)


@njit(inline="always", borrows=True)
def _constants(parameters):
    """Return the lanes that `_mixture` takes."""
    outlier = parameters[OUTLIER]
    peak, floor = (1.0 - outlier) / math.sqrt(2.0 * math.pi), outlier / (parameters[FAR] - parameters[NEAR])
    return (
        splat(np.float32(parameters[SIGMA])), splat(np.float32(parameters[GROWTH])), splat(np.float32(peak)),
        splat(np.float32(parameters[NEAR])), splat(np.float32(parameters[FAR])), splat(np.float32(floor)),
        splat(np.float32(1e-30)), splat(np.float32(0)), splat(np.float32(-0.5)),
    )  # fmt: skip


@njit(inline="always", borrows=True)
def _mixture(told, model, constants):
    """Return what pixels hold, and the densities of their surface and of outliers: the twin of `mixture`."""
    sigma, growth, peak, near, far, floor, nothing, zero, half_less = constants
    value = absolute(told)
    model = where_at_least(told, zero, model, minimum(model, value))  # what is below zero may be hidden
    inverse = reciprocal(multiply_add(growth, multiply(model, model), sigma))
    z = multiply(subtract(value, model), inverse)
    surface = multiply(multiply(peak, inverse), exponential(multiply(half_less, multiply(z, z))))
    return value, surface, where_at_least(value, near, where_at_least(far, value, floor, nothing), nothing)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def score_robust(parameters, images, half, left, right, top, bottom, height):
    """Turn the blurred depth in images[SCORE + half] into log densities under the mixture; returns sums as above."""
    new, old = zero_sum(), zero_sum()
    observed, score, current = images[OBSERVED_IMAGE], images[SCORE + half], images[SCORE + CURRENT]
    depth = images[DEPTH + half]
    constants = _constants(parameters)
    lost, lost_edge = parameters[MISSING], parameters[MISSING_EDGE]
    edges = lost != lost_edge  # else it makes no difference where they are
    found_score, found_score_edge = np.float32(math.log1p(-lost)), np.float32(math.log1p(-lost_edge))
    lost_score, lost_score_edge = np.float32(math.log(lost)), np.float32(math.log(lost_edge))
    step = splat(np.float32(parameters[EDGE_STEP]))
    zero = splat(np.float32(0))
    for row in range(top, bottom):
        above, below = max(row - 1, 0), min(row + 1, height - 1)
        for column in range(left, right, LANES):
            value, surface, outliers = _mixture(load(observed, row, column), load(score, row, column), constants)
            density = logarithm(add(surface, outliers))
            found, missed = splat(found_score), splat(lost_score)
            if edges:
                here = load(depth, row, column)
                twice = add(here, here)
                along = subtract(add(load(depth, row, column - 1), load(depth, row, column + 1)), twice)
                down = subtract(add(load(depth, above, column), load(depth, below, column)), twice)
                bend = subtract(maximum(absolute(along), absolute(down)), step)  # positive at an edge
                found = where_at_least(zero, bend, found, splat(found_score_edge))
                missed = where_at_least(zero, bend, missed, splat(lost_score_edge))
            result = where_at_least(zero, value, missed, add(density, found))  # a missing pixel's value is 0
            result = where_at_least(value, zero, result, zero)  # NaN: the padding
            old = accumulate(old, load(current, row, column))
            store(score, row, column, result)
            new = accumulate(new, result)
    return sum_lanes(new), sum_lanes(old)


@njit(cache=True, nogil=True, borrows=True)
def pixel_log_densities(settings, parameters, images, result):
    """Write each pixel's log density under the current scene into `result` (H, W) float64; 0 where there is none."""
    sigma = parameters[SIGMA]
    constant = math.log(sigma) + 0.5 * math.log(2.0 * math.pi)
    for row in range(settings[HEIGHT]):
        for column in range(settings[WIDTH]):
            score = images[SCORE + CURRENT, row, column + PAD]
            if settings[LIKELIHOOD] != GAUSSIAN:
                result[row, column] = score
            elif math.isnan(images[OBSERVED_IMAGE, row, column + PAD]):
                result[row, column] = 0.0
            else:
                result[row, column] = -0.5 * score / (sigma * sigma) - constant


# entries of `parameters`, as `Correlated.row` lays them out
SHARED, CLUMP = range(LIKELIHOOD_PARAMETERS + 4, LIKELIHOOD_PARAMETERS + 6)  # of one that neighbours share, after FAR


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def score_correlated(parameters, images, half, left, right, top, bottom, height):
    """Turn the blurred depth in images[SCORE + half] into log densities given earlier pixels.

    Returns their sum and that of the current half's scores in the region.
    """
    new, old = zero_sum(), zero_sum()
    observed, score, current = images[OBSERVED_IMAGE], images[SCORE + half], images[SCORE + CURRENT]
    going_on, shows = images[len(images) - GOING_ON], images[len(images) - SHOWS + half]
    constants = _constants(parameters)
    clump = splat(np.float32(parameters[CLUMP]))
    more = splat(np.float32(parameters[SHARED] - parameters[CLUMP]))
    zero, one, nothing, none = splat(np.float32(0)), splat(np.float32(1)), splat(np.float32(1e-30)), splat(NO_RETURN)
    for row in range(top, bottom):
        for column in range(left, right, LANES):
            value, surface, outliers = _mixture(load(observed, row, column), load(score, row, column), constants)
            anew = add(surface, outliers)
            store(shows, row, column, where_at_least(value, nothing, divide(surface, anew), none))  # not where 0 or NaN
            store(score, row, column, anew)
        above = max(row - 1, 0)
        first = splat(np.float32(0)) if row >= 1 else splat(np.float32(2))  # more than any: no row is above the first
        for column in range(left, right, LANES):
            west, north = load(shows, row, column - 1), load(shows, above, column)
            by_west, by_north = where_at_least(west, zero, one, zero), where_at_least(north, first, one, zero)
            shown = add(multiply(by_west, west), multiply(by_north, north))
            count = add(by_west, by_north)
            goes_on = multiply_add(more, divide(shown, maximum(count, one)), clump)
            goes_on = where_at_least(count, one, goes_on, zero)
            density = multiply(subtract(one, goes_on), load(score, row, column))
            density = multiply_add(goes_on, load(going_on, row, column), density)
            value = absolute(load(observed, row, column))
            result = where_at_least(value, nothing, logarithm(maximum(density, nothing)), zero)
            old = accumulate(old, load(current, row, column))
            store(score, row, column, result)
            new = accumulate(new, result)
    return sum_lanes(new), sum_lanes(old)
