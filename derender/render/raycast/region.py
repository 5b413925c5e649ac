"""Draw and score a rectangle of the image: the one piece of work that full and incremental evaluation share.

A proposal's rectangles are those of what moved, before and after; where they would touch, one that holds both. Scores
are the compiled twins of the likelihoods' `per_pixel`. Under noise that neighbouring pixels share they go row by row:
first how probably each pixel shows its surface, then the scores, which look at that to the left and above. Outside the
region it is as it was, for a region reaches a pixel farther than the blur (MARGIN).
"""

import math

import numpy as np

from derender.compilation.cache import call_for_nothing, call_for_two_numbers, njit
from derender.render.likelihoods.correlated import BEYOND, JUMP
from derender.render.raycast.convex import DISCRIMINANT, FACES, QUADRIC_B
from derender.render.raycast.lane_names import (
    LANES,
    absolute,
    accumulate,
    add,
    divide,
    exponential,
    load,
    log_of_sum,
    logarithm,
    maximum,
    minimum,
    multiply,
    multiply_add,
    reciprocal,
    splat,
    square_root,
    steps_from,
    store,
    subtract,
    sum_lanes,
    where_at_least,
    zero_sum,
)
from derender.render.raycast.state import (
    ANEW,
    BACKGROUND,
    BLUR,
    CORRELATED,
    CURRENT,
    DEPTH,
    GOING_ON,
    HEIGHT,
    LIKELIHOOD,
    LIKELIHOOD_PARAMETERS,
    MARGIN,
    MESHES,
    NO_RETURN,
    OBSERVED_IMAGE,
    PAD,
    RADIUS,
    RATE,
    REGIONS,
    SCORE,
    SHOWS,
    SIGMA,
    WIDTH,
)
from derender.scene.solids import MESH

DRAWN, SCORED = 0, 1  # of a region: the columns and rows that are drawn, and the wider ones that the blur reaches


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def draw_region(settings, parameters, images, kind, prepared, rectangle, half, region):
    """Draw the clean depth of a half in columns region[0]:region[1] (a multiple of LANES) and rows [2]:[3].

    The nearest surface, or the wall at the likelihood's `background` depth where that is nearer.
    """
    left, right, top, bottom = region[0], region[1], region[2], region[3]
    image = images[DEPTH + half]
    fill(image, left, right, top, bottom, PAD, np.float32(1.0 / parameters[BACKGROUND]))
    for k in range(kind.shape[1]):
        r0, r1, r2, r3 = rectangle[half, k, 0], rectangle[half, k, 1], rectangle[half, k, 2], rectangle[half, k, 3]
        if r0 < right and r1 > left and r2 < bottom and r3 > top:
            first, end, start, stop = max(r0, left), min(r1, right), max(r2, top), min(r3, bottom)
            if kind[0, k] == MESH:
                raise_to_image(image, first, end, start, stop, PAD, images[MESHES + 2 * kind[2, k] + half])
            else:
                first = left + (first - left) // LANES * LANES  # so that rounding up stays inside the region
                raise_solid(image, first, end, start, stop, PAD, prepared[half, k], (r0 + r1) // 2)
    invert(image, left, right, top, bottom, PAD, settings[WIDTH])


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def score_region(settings, parameters, taps, images, half, region):
    """Blur and score a half in a region (columns a multiple of LANES).

    Returns the sum of its new scores and of the scores that the current half had there before (after the first, full
    scoring of a scene the second is not meaningful: the current half itself was written).
    """
    height = settings[HEIGHT]
    left, right, top, bottom = region[0] + PAD, region[1] + PAD, region[2], region[3]
    call_for_nothing(settings[BLUR], images[DEPTH + half], images[SCORE + half], taps, left, right, top, bottom, height)
    return call_for_two_numbers(settings[RATE], parameters, images, half, left, right, top, bottom, height)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def whole_image(settings, region):
    """Make a region the whole image."""
    region[0], region[1] = 0, (settings[WIDTH] + LANES - 1) // LANES * LANES
    region[2], region[3] = 0, settings[HEIGHT]


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _touch(a, b):
    return a[0] < b[1] and b[0] < a[1] and a[2] < b[3] and b[2] < a[3]


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def add_region(settings, regions, rectangle):
    """Add a rectangle to the proposal's regions, swallowing those whose scored regions it touches.

    A drawn region's columns are padded to a multiple of LANES, and so are those of its scored region, which is all that
    the blur can reach from it.
    """
    left, right, top, bottom = rectangle[0], rectangle[1], rectangle[2], rectangle[3]
    if left >= right:
        return
    width, height, margin = settings[WIDTH], settings[HEIGHT], settings[MARGIN]
    count, k = settings[REGIONS], -1
    while k < count:
        if k >= 0:
            if not _touch(regions[SCORED, k], regions[SCORED, count]):
                k += 1
                continue
            left, right = min(left, regions[DRAWN, k, 0]), min(max(right, regions[DRAWN, k, 1]), width)
            top, bottom = min(top, regions[DRAWN, k, 2]), max(bottom, regions[DRAWN, k, 3])
            count -= 1
            for i in range(4):
                regions[DRAWN, k, i], regions[SCORED, k, i] = regions[DRAWN, count, i], regions[SCORED, count, i]
        drawn, scored = regions[DRAWN, count], regions[SCORED, count]
        drawn[0], drawn[1] = left, left + (right - left + LANES - 1) // LANES * LANES
        drawn[2], drawn[3] = top, bottom
        first, end = max(left - margin, 0), min(right + margin, width)
        scored[0], scored[1] = first, first + (end - first + LANES - 1) // LANES * LANES
        # under shared noise a pixel tells of those after it, in its own row and below
        above = settings[RADIUS] if settings[LIKELIHOOD] == CORRELATED else margin
        scored[2], scored[3] = max(top - above, 0), min(bottom + margin, height)
        k = 0
    settings[REGIONS] = count + 1


FAR_BOUND = np.float32(3e38)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _affine(prepared, face, column):
    """Affine bound `face`: its value at `column` of row 0, its slope along rows, and its slope down columns."""
    k = FACES + 3 * face
    slope = prepared[k + 1]
    return prepared[k] + slope * column, np.float32(slope), prepared[k + 2]


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _bound(prepared, face, column, row):
    """Affine bound `face` on a row: its value at `column` and its slope."""
    start, slope, down = _affine(prepared, face, column)
    return np.float32(start + down * row), slope


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _raise_plane(image, left, right, top, bottom, middle, pad, prepared):
    for row in range(top, bottom):
        a, b = _bound(prepared, 0, middle, row)
        start, slope = splat(a), splat(b)
        for column in range(left, right, LANES):
            value = multiply_add(slope, steps_from(column - middle), start)
            store(image, row, column + pad, maximum(value, load(image, row, column + pad)))


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _raise_box(image, left, right, top, bottom, middle, pad, prepared):
    """Three upper and five lower bounds, repeated where a box has fewer: no branch in the loop."""
    front, back = int(prepared[0]), int(prepared[1])
    second, third = min(1, front - 1), min(2, front - 1)
    seventh, eighth = front + min(3, back - 1), front + min(4, back - 1)
    # read once: it is not known that what is written to the image leaves them as they are
    start0, b0, down0 = _affine(prepared, 0, middle)
    start1, b1, down1 = _affine(prepared, second, middle)
    start2, b2, down2 = _affine(prepared, third, middle)
    start3, b3, down3 = _affine(prepared, front, middle)
    start4, b4, down4 = _affine(prepared, front + 1, middle)
    start5, b5, down5 = _affine(prepared, front + 2, middle)
    start6, b6, down6 = _affine(prepared, seventh, middle)
    start7, b7, down7 = _affine(prepared, eighth, middle)
    for row in range(top, bottom):
        a0, a1 = np.float32(start0 + down0 * row), np.float32(start1 + down1 * row)
        a2, a3 = np.float32(start2 + down2 * row), np.float32(start3 + down3 * row)
        a4, a5 = np.float32(start4 + down4 * row), np.float32(start5 + down5 * row)
        a6, a7 = np.float32(start6 + down6 * row), np.float32(start7 + down7 * row)
        for column in range(left, right, LANES):
            x = steps_from(column - middle)
            upper = minimum(
                minimum(multiply_add(splat(b0), x, splat(a0)), multiply_add(splat(b1), x, splat(a1))),
                multiply_add(splat(b2), x, splat(a2)),
            )
            lower = maximum(
                maximum(multiply_add(splat(b3), x, splat(a3)), multiply_add(splat(b4), x, splat(a4))),
                maximum(multiply_add(splat(b5), x, splat(a5)), multiply_add(splat(b6), x, splat(a6))),
            )
            lower = maximum(lower, multiply_add(splat(b7), x, splat(a7)))
            before = load(image, row, column + pad)
            store(image, row, column + pad, where_at_least(upper, maximum(lower, before), upper, before))


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _raise_quadric(image, left, right, top, bottom, middle, pad, prepared):
    """A sphere (no faces) or a cylinder (two). Everything is divided by |K|, so that the roots are centre +- root."""
    front, faces = int(prepared[0]), int(prepared[0] + prepared[1])
    a0, b0, a1, b1, a2, b2 = FAR_BOUND, np.float32(0), -FAR_BOUND, np.float32(0), -FAR_BOUND, np.float32(0)
    origin, q = int(prepared[4]), DISCRIMINANT
    outside = prepared[3] > 0.0
    scale = 1.0 / abs(prepared[3])
    square, signed = scale * scale, scale if outside else -scale
    c2, m1 = np.float32(prepared[q + 3] * square), np.float32(prepared[QUADRIC_B + 1] * signed)
    zero = splat(np.float32(0))
    for row in range(top, bottom):
        if front > 0:
            a0, b0 = _bound(prepared, 0, middle, row)
        if faces > front:
            a1, b1 = _bound(prepared, front, middle, row)
        if faces > front + 1:
            a2, b2 = _bound(prepared, front + 1, middle, row)
        s = row - prepared[5]
        c0 = np.float32((prepared[q] + (prepared[q + 2] + prepared[q + 5] * s) * s) * square)
        c1 = np.float32((prepared[q + 1] + prepared[q + 4] * s) * square)
        m0 = np.float32((prepared[QUADRIC_B] + prepared[QUADRIC_B + 2] * s) * signed)
        for column in range(left, right, LANES):
            x, t = steps_from(column - middle), steps_from(column - origin)
            discriminant = multiply_add(multiply_add(splat(c2), t, splat(c1)), t, splat(c0))
            root = square_root(maximum(discriminant, zero))
            centre = multiply_add(splat(m1), t, splat(m0))
            upper = multiply_add(splat(b0), x, splat(a0))
            lower = maximum(multiply_add(splat(b1), x, splat(a1)), multiply_add(splat(b2), x, splat(a2)))
            if outside:
                upper = minimum(upper, add(centre, root))
                lower = maximum(lower, subtract(centre, root))
            else:
                lower = maximum(lower, add(centre, root))
            before = load(image, row, column + pad)
            hit = where_at_least(upper, maximum(lower, before), upper, before)
            store(image, row, column + pad, where_at_least(discriminant, zero, hit, before))


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def raise_solid(image, left, right, top, bottom, pad, prepared, middle):
    """Raise an image of inverse depth to that of a prepared solid, columns from `left` to `right` rounded up to LANES.

    image : (H, P) float32, pixel i at column i + pad. middle : int column about which the bounds are expanded.
    """
    if prepared[2] != 0.0:
        _raise_quadric(image, left, right, top, bottom, middle, pad, prepared)
    elif prepared[1] == 0.0:
        _raise_plane(image, left, right, top, bottom, middle, pad, prepared)
    else:
        _raise_box(image, left, right, top, bottom, middle, pad, prepared)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def raise_to_image(image, left, right, top, bottom, pad, other):
    """Raise an image of inverse depth to another (H, >= W) one without padding, columns from `left` to `right`."""
    for row in range(top, bottom):
        for column in range(left, right):
            if other[row, column] > image[row, column + pad]:
                image[row, column + pad] = other[row, column]


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def fill(image, left, right, top, bottom, pad, value):
    """Set columns from `left` to `right` (rounded up to LANES) of some rows."""
    for row in range(top, bottom):
        for column in range(left, right, LANES):
            store(image, row, column + pad, splat(value))


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def invert(image, left, right, top, bottom, pad, width):
    """Turn inverse depth into depth in a region, and replicate the image's edges where the region touches them."""
    for row in range(top, bottom):
        for column in range(left + pad, right + pad, LANES):
            store(image, row, column, reciprocal(load(image, row, column)))
        if left == 0:
            store(image, row, pad - LANES, splat(image[row, pad]))
        if right >= width:
            store(image, row, pad + width, splat(image[row, pad + width - 1]))


# entries of `parameters` for the robust likelihood, as `Robust.row` lays them out
GROWTH, OUTLIER, NEAR, FAR, MISSING, MISSING_EDGE, EDGE_STEP, FLYING = range(
    LIKELIHOOD_PARAMETERS, LIKELIHOOD_PARAMETERS + 8
)
NOTHING = 1e-30  # density of outliers where there are none


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
        splat(np.float32(NOTHING)), splat(np.float32(0)), splat(np.float32(-0.5)),
    )  # fmt: skip


@njit(inline="always", borrows=True)
def _mixture(told, model, constants):
    """Return what pixels hold, and the densities of their surface and of outliers: the twin of `mixture`."""
    _, _, _, near, far, floor, nothing, zero, _ = constants
    value, model = _shown(told, model, zero)
    surface = _on_surface(value, model, constants)
    return value, surface, where_at_least(value, near, where_at_least(far, value, floor, nothing), nothing)


@njit(inline="always", borrows=True)
def _shown(told, model, zero):
    """Return what pixels hold and what they are to show: what is below zero shows what may be hidden, or nearer."""
    value = absolute(told)
    return value, where_at_least(told, zero, model, minimum(model, value))


@njit(inline="always", borrows=True)
def _on_surface(value, model, constants):
    """Return the density of pixels that show a surface: the twin of `surface_density`, times the share that does."""
    sigma, growth, peak, _, _, _, _, _, half_less = constants
    inverse = reciprocal(multiply_add(growth, multiply(model, model), sigma))
    z = multiply(subtract(value, model), inverse)
    return multiply(multiply(peak, inverse), exponential(multiply(half_less, multiply(z, z))))


@njit(inline="always", borrows=True)
def _flying(told, nearest, farthest, half_flying, quarter_flying, constants):
    """Return the density of pixels that fly: the twin of `flying_density`, times the share that does."""
    zero = constants[7]
    within = divide(half_flying, subtract(farthest, nearest))
    within = where_at_least(told, nearest, where_at_least(farthest, told, within, zero), zero)
    on_one = add(_on_surface(told, nearest, constants), _on_surface(told, farthest, constants))
    return multiply_add(quarter_flying, on_one, within)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def score_robust(parameters, images, half, left, right, top, bottom, height):
    """Turn the blurred depth in images[SCORE + half] into log densities under the mixture; returns sums as above."""
    new, old = zero_sum(), zero_sum()
    observed, score, current = images[OBSERVED_IMAGE], images[SCORE + half], images[SCORE + CURRENT]
    depth = images[DEPTH + half]
    lost, lost_edge = parameters[MISSING], parameters[MISSING_EDGE]
    flying = parameters[FLYING]
    edges = lost != lost_edge or flying > 0.0  # else it makes no difference where they are
    if not edges and parameters[GROWTH] == 0.0:
        return _score_even(parameters, images, half, left, right, top, bottom)
    constants = _constants(parameters)
    found_score, found_score_edge = np.float32(math.log1p(-lost)), np.float32(math.log1p(-lost_edge))
    lost_score, lost_score_edge = np.float32(math.log(lost)), np.float32(math.log(lost_edge))
    step, zero, stays = splat(np.float32(parameters[EDGE_STEP])), splat(np.float32(0)), splat(np.float32(1.0 - flying))
    half_flying = splat(np.float32(0.5 * flying))
    quarter_flying = splat(np.float32(0.25 * flying / (1.0 - parameters[OUTLIER])))  # `_on_surface` has that factor
    for row in range(top, bottom):
        above, below = max(row - 1, 0), min(row + 1, height - 1)
        for column in range(left, right, LANES):
            told = load(observed, row, column)
            value, surface, outliers = _mixture(told, load(score, row, column), constants)
            density = add(surface, outliers)
            found, missed = splat(found_score), splat(lost_score)
            if edges:
                here = load(depth, row, column)
                west, east = load(depth, row, column - 1), load(depth, row, column + 1)
                north, south = load(depth, above, column), load(depth, below, column)
                along, down = subtract(add(west, east), add(here, here)), subtract(add(north, south), add(here, here))
                bend = subtract(maximum(absolute(along), absolute(down)), step)  # positive at an edge
                found = where_at_least(zero, bend, found, splat(found_score_edge))
                missed = where_at_least(zero, bend, missed, splat(lost_score_edge))
                if flying > 0.0:  # the twin of `near_edges`
                    first, last = load(depth, above, column - 1), load(depth, below, column + 1)
                    third, fourth = load(depth, above, column + 1), load(depth, below, column - 1)
                    falling, rising = add(first, last), add(third, fourth)
                    falling, rising = subtract(falling, add(here, here)), subtract(rising, add(here, here))
                    bend = maximum(bend, subtract(maximum(absolute(falling), absolute(rising)), step))
                    nearest, farthest = minimum(west, east), maximum(west, east)
                    nearest = minimum(minimum(nearest, minimum(north, south)), here)
                    farthest = maximum(maximum(farthest, maximum(north, south)), here)
                    nearest = minimum(nearest, minimum(minimum(first, last), minimum(third, fourth)))
                    farthest = maximum(farthest, maximum(maximum(first, last), maximum(third, fourth)))
                    flies = _flying(told, nearest, farthest, half_flying, quarter_flying, constants)
                    mixed = multiply_add(stays, density, flies)
                    density = where_at_least(zero, bend, density, where_at_least(told, zero, mixed, density))
            result = where_at_least(zero, value, missed, add(logarithm(density), found))  # a missing pixel's value is 0
            result = where_at_least(value, zero, result, zero)  # NaN: the padding
            old = accumulate(old, load(current, row, column))
            store(score, row, column, result)
            new = accumulate(new, result)
    return sum_lanes(new), sum_lanes(old)


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def _score_even(parameters, images, half, left, right, top, bottom):
    """As `score_robust`, of noise that is the same at any depth and pixels that return as often at edges.

    Then it goes in logarithms, at half the work: none is needed of a density, and no noise of each pixel.
    """
    new, old = zero_sum(), zero_sum()
    observed, score, current = images[OBSERVED_IMAGE], images[SCORE + half], images[SCORE + CURRENT]
    outlier, near, far, lost = parameters[OUTLIER], parameters[NEAR], parameters[FAR], parameters[MISSING]
    found, missed, inverse = math.log1p(-lost), splat(np.float32(math.log(lost))), 1.0 / parameters[SIGMA]
    peak = splat(np.float32(found + math.log((1.0 - outlier) * inverse / math.sqrt(2.0 * math.pi))))
    floor = splat(np.float32(found + math.log(outlier / (far - near))))
    nothing = splat(np.float32(found + math.log(NOTHING)))
    nearest, farthest, scale = splat(np.float32(near)), splat(np.float32(far)), splat(np.float32(inverse))
    zero, half_less = splat(np.float32(0)), splat(np.float32(-0.5))
    for row in range(top, bottom):
        for column in range(left, right, LANES):
            value, model = _shown(load(observed, row, column), load(score, row, column), zero)
            z = multiply(subtract(value, model), scale)
            outliers = where_at_least(value, nearest, where_at_least(farthest, value, floor, nothing), nothing)
            result = log_of_sum(multiply_add(multiply(z, z), half_less, peak), outliers)
            result = where_at_least(zero, value, missed, result)  # a missing pixel's value is 0
            result = where_at_least(value, zero, result, zero)  # NaN: the padding
            old = accumulate(old, load(current, row, column))
            store(score, row, column, result)
            new = accumulate(new, result)
    return sum_lanes(new), sum_lanes(old)


@njit(inline="always", borrows=True)
def _apart(there, model, inverse, one):
    """Return 1 + (d / j)^4 of a neighbour's depth, see `Correlated`; inverse : 1 / j."""
    off = multiply(subtract(absolute(there), model), inverse)
    return multiply_add(multiply(off, off), multiply(off, off), one)


# entries of `parameters`, as `Correlated.row` lays them out
SHARED, CLUMP = range(LIKELIHOOD_PARAMETERS + 4, LIKELIHOOD_PARAMETERS + 6)  # of one that neighbours share, after FAR


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def score_correlated(parameters, images, half, left, right, top, bottom, height):
    """Turn the blurred depth in images[SCORE + half] into log densities given earlier pixels; returns sums as above."""
    new, old = zero_sum(), zero_sum()
    observed, score, current = images[OBSERVED_IMAGE], images[SCORE + half], images[SCORE + CURRENT]
    going_on, shows = images[len(images) - GOING_ON], images[len(images) - SHOWS + half]
    densities = images[len(images) - ANEW]
    constants = _constants(parameters)
    sigma, growth = constants[0], constants[1]
    clump, more = splat(np.float32(parameters[CLUMP])), splat(np.float32(parameters[SHARED] - parameters[CLUMP]))
    zero, one, nothing, none = splat(np.float32(0)), splat(np.float32(1)), splat(np.float32(1e-30)), splat(NO_RETURN)
    jump, beyond = splat(np.float32(JUMP)), splat(np.float32(BEYOND))
    for row in range(top, bottom):
        for column in range(left, right, LANES):
            value, surface, outliers = _mixture(load(observed, row, column), load(score, row, column), constants)
            anew = add(surface, outliers)
            store(shows, row, column, where_at_least(value, nothing, divide(surface, anew), none))  # not where 0 or NaN
            store(densities, row, column, anew)
        above = max(row - 1, 0)
        first = splat(np.float32(0)) if row >= 1 else splat(np.float32(2))  # more than any: no row is above the first
        for column in range(left, right, LANES):
            west, north = load(shows, row, column - 1), load(shows, above, column)
            by_west, by_north = where_at_least(west, zero, one, zero), where_at_least(north, first, one, zero)
            value, model = _shown(load(observed, row, column), load(score, row, column), zero)
            off = multiply_add(beyond, multiply_add(growth, multiply(model, model), sigma), multiply(jump, model))
            inverse = reciprocal(off)
            by = where_at_least(west, zero, _apart(load(observed, row, column - 1), model, inverse, one), one)
            over = where_at_least(north, first, _apart(load(observed, above, column), model, inverse, one), one)
            # west / by + north / over in one division
            shown = multiply_add(multiply(by_west, west), over, multiply(multiply(by_north, north), by))
            count = add(by_west, by_north)
            goes_on = multiply_add(more, divide(shown, multiply(multiply(by, over), maximum(count, one))), clump)
            beside = load(going_on, row, column)  # 0 where none of the nearest returned
            goes_on = where_at_least(add(count, beside), nothing, goes_on, zero)
            density = multiply_add(goes_on, beside, multiply(subtract(one, goes_on), load(densities, row, column)))
            result = where_at_least(value, nothing, logarithm(maximum(density, nothing)), zero)
            old = accumulate(old, load(current, row, column))
            store(score, row, column, result)
            new = accumulate(new, result)
    return sum_lanes(new), sum_lanes(old)
