"""Score a region under noise that neighbouring pixels share: the compiled twin of `Correlated.per_pixel`.

Row by row: first the residuals of the row, then its scores, which look at residuals of this row and of the two above.
Outside the region residuals are as they were, for a region reaches two pixels farther than the blur (`set_reach`).
"""

import math

import numpy as np

from derender.compilation.cache import njit
from derender.render.raycast.lane_names import (
    LANES,
    absolute,
    accumulate,
    add,
    all_at_least,
    divide,
    exponential,
    load,
    load_table,
    logarithm,
    look_up,
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
    LIKELIHOOD_PARAMETERS,
    NO_RESIDUAL,
    OBSERVED_IMAGE,
    RESIDUALS,
    SCORE,
    SIGMA,
)

# entries of `parameters`, as `Correlated.row` lays them out; the last are tables of eight, by which neighbours tell
GROWTH, OUTLIER, NEAR, FAR, TAIL, JUMP, LIMIT = range(LIKELIHOOD_PARAMETERS, LIKELIHOOD_PARAMETERS + 7)
WEST, NORTH, NORTH_WEST, NORTH_EAST, WEST_2, NORTH_2, SHARPNESS = range(LIMIT + 1, LIMIT + 1 + 56, 8)
EDGE, EDGE_2, FLYING = range(SHARPNESS + 8, SHARPNESS + 11)  # probabilities, one and two pixels from a jump; a share
WIDER, DEVIATIONS = 4.0, 12.0  # of the likelihood, whose sixteenth power of a density is taken below; in its limit
# Added to the residual of what is no part of the scene: beyond any limit for its neighbours, taken off for itself. A
# float32 keeps 1e-4 of a standard deviation beside it.
APART = np.float32(1024.0)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def score_correlated(parameters, images, half, left, right, top, bottom, height):
    """Turn the blurred depth in images[SCORE + half] into log densities given earlier pixels.

    Returns their sum and that of the current half's scores in the region.
    """
    new, old = zero_sum(), zero_sum()
    observed, score, current = images[OBSERVED_IMAGE], images[SCORE + half], images[SCORE + CURRENT]
    depth, residuals = images[DEPTH + half], images[len(images) - RESIDUALS + half]
    outlier, tail = parameters[OUTLIER], parameters[TAIL]
    sigma, growth = splat(np.float32(parameters[SIGMA])), splat(np.float32(parameters[GROWTH]))
    near, far = splat(np.float32(parameters[NEAR])), splat(np.float32(parameters[FAR]))
    peak = splat(np.float32((1.0 - outlier) * (1.0 - tail) / math.sqrt(2.0 * math.pi)))
    flat = splat(np.float32((1.0 - outlier) * tail / (WIDER * math.sqrt(2.0 * math.pi))))
    falls = splat(np.float32(-0.5 / (WIDER * WIDER)))
    floor = splat(np.float32(outlier / (parameters[FAR] - parameters[NEAR])))
    jump, reach = splat(np.float32(parameters[JUMP])), np.float32(parameters[LIMIT])
    by_west, by_north = load_table(parameters, WEST), load_table(parameters, NORTH)
    by_north_west, by_north_east = load_table(parameters, NORTH_WEST), load_table(parameters, NORTH_EAST)
    by_west_2, by_north_2 = load_table(parameters, WEST_2), load_table(parameters, NORTH_2)
    sharpness = load_table(parameters, SHARPNESS)
    seven = splat(np.float32(7))
    weight_west, weight_north = look_up(by_west, seven), look_up(by_north, seven)
    weight_north_west, weight_north_east = look_up(by_north_west, seven), look_up(by_north_east, seven)
    weight_west_2, weight_north_2 = look_up(by_west_2, seven), look_up(by_north_2, seven)
    sharpest, alone = look_up(sharpness, seven), look_up(sharpness, splat(np.float32(0)))
    zero, nothing, apart, none = (splat(np.float32(0)), splat(np.float32(1e-30)), splat(APART), splat(NO_RESIDUAL))
    one, two, four = splat(np.float32(1)), splat(np.float32(2)), splat(np.float32(4))
    limit = splat(reach)
    edges = parameters[EDGE] > 0.0
    beside, beside_2 = splat(np.float32(parameters[EDGE])), splat(np.float32(parameters[EDGE_2]))
    flies = splat(np.float32(parameters[FLYING] * (1.0 - outlier)))
    shows = splat(np.float32((1.0 - parameters[FLYING]) * (1.0 - outlier) / math.sqrt(2.0 * math.pi)))
    blunt = splat(np.float32(DEVIATIONS / parameters[LIMIT]))  # of what the noise scatters by, its bias included
    half_less = splat(np.float32(-0.5))
    for row in range(top, bottom):
        for column in range(left, right, LANES):
            told, model = load(observed, row, column), load(score, row, column)
            value = absolute(told)
            model = where_at_least(told, zero, model, minimum(model, value))  # what is below zero may be hidden
            grown = multiply(growth, model)
            inverse = reciprocal(multiply_add(grown, value, sigma))
            z = multiply(subtract(value, model), inverse)
            z = where_at_least(told, zero, z, add(z, apart))
            store(residuals, row, column, where_at_least(value, nothing, z, none))  # not where it is 0 or NaN
            store(score, row, column, multiply(multiply(inverse, inverse), multiply_add(grown, model, sigma)))
        above, above_2 = max(row - 1, 0), max(row - 2, 0)
        # no residual is below -1, so rows that are not there tell nothing
        limit_1 = limit if row >= 1 else splat(np.float32(-1))
        limit_2 = limit if row >= 2 else splat(np.float32(-1))
        for column in range(left, right, LANES):
            here, at = load(depth, row, column), load(residuals, row, column)
            west, north = load(residuals, row, column - 1), load(residuals, above, column)
            north_west, north_east = load(residuals, above, column - 1), load(residuals, above, column + 1)
            west_2, north_2 = load(residuals, row, column - 2), load(residuals, above_2, column)
            depth_west, depth_north = load(depth, row, column - 1), load(depth, above, column)
            depth_north_west, depth_north_east = load(depth, above, column - 1), load(depth, above, column + 1)
            depth_west_2, depth_north_2 = load(depth, row, column - 2), load(depth, above_2, column)
            # of the four that tell together: how far off they are, and the farthest and the nearest surface
            off = maximum(
                maximum(absolute(north_west), absolute(north_east)), maximum(absolute(west_2), absolute(north_2))
            )
            off_west, off_north = absolute(west), absolute(north)
            far_4 = maximum(maximum(depth_north_west, depth_north_east), maximum(depth_west_2, depth_north_2))
            near_4 = minimum(minimum(depth_north_west, depth_north_east), minimum(depth_west_2, depth_north_2))
            far_6, near_6 = (
                maximum(far_4, maximum(depth_west, depth_north)),
                minimum(near_4, minimum(depth_west, depth_north)),
            )
            same = multiply(jump, here)
            if all_at_least(limit_2, maximum(off, maximum(off_west, off_north))) and all_at_least(
                same, maximum(subtract(far_6, here), subtract(here, near_6))
            ):  # all six tell, as they do where most surfaces are
                mean = multiply(weight_west, west)
                mean = multiply_add(weight_north, north, mean)
                mean = multiply_add(weight_north_west, north_west, mean)
                mean = multiply_add(weight_north_east, north_east, mean)
                mean = multiply_add(weight_west_2, west_2, mean)
                mean = multiply_add(weight_north_2, north_2, mean)
                sharp = sharpest
            else:
                step_west, step_north = absolute(subtract(depth_west, here)), absolute(subtract(depth_north, here))
                step = maximum(subtract(far_4, here), subtract(here, near_4))
                by_one = where_at_least(limit, off_west, where_at_least(same, step_west, one, zero), zero)
                by_two = where_at_least(limit_1, off_north, where_at_least(same, step_north, two, zero), zero)
                by_four = where_at_least(limit_2, off, where_at_least(same, step, four, zero), zero)
                tells = add(add(by_one, by_two), by_four)
                mean = multiply(look_up(by_west, tells), west)
                mean = multiply_add(look_up(by_north, tells), north, mean)
                mean = multiply_add(look_up(by_north_west, tells), north_west, mean)
                mean = multiply_add(look_up(by_north_east, tells), north_east, mean)
                mean = multiply_add(look_up(by_west_2, tells), west_2, mean)
                mean = multiply_add(look_up(by_north_2, tells), north_2, mean)
                sharp = look_up(sharpness, tells)
            told = load(observed, row, column)
            value = absolute(told)
            own = where_at_least(told, zero, at, subtract(at, apart))
            mean, sharp = where_at_least(told, zero, mean, zero), where_at_least(told, zero, sharp, alone)
            z = multiply(subtract(own, mean), sharp)
            wide = exponential(multiply(falls, multiply(z, z)))
            square = multiply(wide, wide)
            fourth = multiply(square, square)
            eighth = multiply(fourth, fourth)
            narrow = multiply(eighth, eighth)  # four times as narrow is the sixteenth power: no second exponential
            surface = multiply(
                multiply(sharp, load(score, row, column)), multiply_add(peak, narrow, multiply(flat, wide))
            )
            if edges:
                below, below_2 = min(row + 1, height - 1), min(row + 2, height - 1)
                depth_east, depth_south = load(depth, row, column + 1), load(depth, below, column)
                depth_east_2, depth_south_2 = load(depth, row, column + 2), load(depth, below_2, column)
                twice = add(here, here)
                bend = maximum(
                    absolute(subtract(add(depth_west, depth_east), twice)),
                    absolute(subtract(add(depth_north, depth_south), twice)),
                )
                bend_2 = maximum(
                    absolute(subtract(add(depth_west_2, depth_east_2), twice)),
                    absolute(subtract(add(depth_north_2, depth_south_2), twice)),
                )
                if not all_at_least(same, maximum(bend, bend_2)):
                    far_4 = maximum(maximum(depth_west, depth_east), maximum(depth_north, depth_south))
                    near_4 = minimum(minimum(depth_west, depth_east), minimum(depth_north, depth_south))
                    beyond = where_at_least(add(far_4, near_4), twice, far_4, near_4)
                    far_4 = maximum(maximum(depth_west_2, depth_east_2), maximum(depth_north_2, depth_south_2))
                    near_4 = minimum(minimum(depth_west_2, depth_east_2), minimum(depth_north_2, depth_south_2))
                    other = where_at_least(add(far_4, near_4), twice, far_4, near_4)
                    other = where_at_least(same, bend, other, beyond)
                    share = where_at_least(same, bend, where_at_least(same, bend_2, zero, beside_2), beside)
                    # between both: anywhere, as likely
                    between = where_at_least(
                        value,
                        minimum(here, other),
                        where_at_least(
                            maximum(here, other), value, divide(flies, absolute(subtract(other, here))), zero
                        ),
                        zero,
                    )
                    across = multiply(blunt, reciprocal(multiply_add(growth, multiply(other, other), sigma)))
                    z = subtract(value, where_at_least(told, zero, other, minimum(other, value)))
                    z = multiply(z, across)
                    there = multiply(multiply(shows, across), exponential(multiply(half_less, multiply(z, z))))
                    # no difference of both is multiplied: a share of nothing may be of what is no number
                    surface = add(
                        multiply(subtract(one, share), surface),
                        where_at_least(zero, share, zero, multiply(share, add(there, between))),
                    )
            inside = where_at_least(value, near, where_at_least(far, value, floor, nothing), nothing)
            result = logarithm(add(surface, inside))
            result = where_at_least(value, nothing, result, zero)
            old = accumulate(old, load(current, row, column))
            store(score, row, column, result)
            new = accumulate(new, result)
    return sum_lanes(new), sum_lanes(old)
