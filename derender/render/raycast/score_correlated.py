"""Score a region under noise that neighbouring pixels share: the compiled twin of `Correlated.per_pixel`.

Row by row: first how probably each pixel shows its surface, then the scores, which look at that to the left and above.
Outside the region it is as it was, for a region reaches a pixel farther than the blur (`set_reach`).
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
    GOING_ON,
    LIKELIHOOD_PARAMETERS,
    NO_RETURN,
    OBSERVED_IMAGE,
    SCORE,
    SHOWS,
    SIGMA,
)

# entries of `parameters`, as `Correlated.row` lays them out
GROWTH, OUTLIER, NEAR, FAR, SHARED, CLUMP = range(LIKELIHOOD_PARAMETERS, LIKELIHOOD_PARAMETERS + 6)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def score_correlated(parameters, images, half, left, right, top, bottom, height):
    """Turn the blurred depth in images[SCORE + half] into log densities given earlier pixels.

    Returns their sum and that of the current half's scores in the region.
    """
    new, old = zero_sum(), zero_sum()
    observed, score, current = images[OBSERVED_IMAGE], images[SCORE + half], images[SCORE + CURRENT]
    going_on, shows = images[len(images) - GOING_ON], images[len(images) - SHOWS + half]
    outlier = parameters[OUTLIER]
    sigma, growth = splat(np.float32(parameters[SIGMA])), splat(np.float32(parameters[GROWTH]))
    near, far = splat(np.float32(parameters[NEAR])), splat(np.float32(parameters[FAR]))
    peak = splat(np.float32((1.0 - outlier) / math.sqrt(2.0 * math.pi)))
    floor = splat(np.float32(outlier / (parameters[FAR] - parameters[NEAR])))
    clump = splat(np.float32(parameters[CLUMP]))
    more = splat(np.float32(parameters[SHARED] - parameters[CLUMP]))
    zero, one, nothing, none = splat(np.float32(0)), splat(np.float32(1)), splat(np.float32(1e-30)), splat(NO_RETURN)
    half_less = splat(np.float32(-0.5))
    for row in range(top, bottom):
        for column in range(left, right, LANES):
            told, model = load(observed, row, column), load(score, row, column)
            value = absolute(told)
            model = where_at_least(told, zero, model, minimum(model, value))  # what is below zero may be hidden
            inverse = reciprocal(multiply_add(growth, multiply(model, model), sigma))
            z = multiply(subtract(value, model), inverse)
            surface = multiply(multiply(peak, inverse), exponential(multiply(half_less, multiply(z, z))))
            inside = where_at_least(value, near, where_at_least(far, value, floor, nothing), nothing)
            anew = add(surface, inside)
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
