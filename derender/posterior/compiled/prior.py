"""Prior, moves and differences on the flat values: `space.py` compiled, number for number."""

import functools
import math

from derender.compilation.cache import call_for_number, njit
from derender.posterior import space
from derender.posterior.compiled.layout import CODE, DENSITY_AT, DIRECTION, DRAW_AT, OFFSET, PERIOD, ROTATION
from derender.scene.distributions import DistributionType, distributions

wrap = njit(cache=True, nogil=True)(space.wrap)
turn = njit(cache=True, nogil=True)(space.turn)
turn_between = njit(cache=True, nogil=True)(space.turn_between)
_rotation_density = njit(distributions["uniform-rotation"].density)
_draw_rotation = njit(distributions["uniform-rotation"].draw)


@functools.cache
def density_and_draw(kind: DistributionType):
    """Return the kernels density(x, row) -> float64 and draw(rng, row) -> float64 of a type that can be compiled.

    They are called by address, so a model compiles those that occur in it.
    """
    return njit(cache=True, nogil=True)(kind.density), njit(cache=True, nogil=True)(kind.draw)


@njit(cache=True, nogil=True)
def log_prior(unknowns, laws, values):
    """Return the log prior density of (P,) values."""
    total = 0.0
    for i in range(len(laws)):
        code, start = unknowns[CODE, i], unknowns[OFFSET, i]
        if code == ROTATION:
            total += _rotation_density(values[start : start + 4], laws[i])
        else:
            total += call_for_number(unknowns[DENSITY_AT, i], values[start], laws[i])
        if not total > -math.inf:
            return -math.inf
    return total


@njit(cache=True, nogil=True)
def resample(rng, unknowns, laws, members, values):
    """Draw some unknowns in place from their priors."""
    for i in members:
        code, start = unknowns[CODE, i], unknowns[OFFSET, i]
        if code == ROTATION:
            w, x, y, z = _draw_rotation(rng, laws[i])
            values[start], values[start + 1], values[start + 2], values[start + 3] = w, x, y, z
        else:
            values[start] = call_for_number(unknowns[DRAW_AT, i], rng, laws[i])


@njit(cache=True, nogil=True)
def move(unknowns, laws, members, values, tangent, scale, moved):
    """Write into `moved` where `values` are after a step of some unknowns by scale * tangent."""
    direction = 0
    step = tangent[:3].copy() if len(tangent) >= 3 else tangent.copy()
    for i in members:
        code, start, period = unknowns[CODE, i], unknowns[OFFSET, i], laws[i, PERIOD]
        if code == ROTATION:
            for k in range(3):
                step[k] = scale * tangent[direction + k]
            w, x, y, z = turn(values[start : start + 4], step)
            moved[start], moved[start + 1], moved[start + 2], moved[start + 3] = w, x, y, z
            direction += 3
        else:
            value = values[start] + scale * tangent[direction]
            moved[start] = value if period == 0.0 else wrap(value, period)
            direction += 1


@njit(cache=True, nogil=True)
def difference(unknowns, laws, members, values, origin, tangent):
    """Write into `tangent` the shortest step of some unknowns from `origin` to `values`."""
    direction = 0
    for i in members:
        code, start, period = unknowns[CODE, i], unknowns[OFFSET, i], laws[i, PERIOD]
        if code == ROTATION:
            x, y, z = turn_between(origin[start : start + 4], values[start : start + 4])
            tangent[direction], tangent[direction + 1], tangent[direction + 2] = x, y, z
            direction += 3
        else:
            step = values[start] - origin[start]
            if period != 0.0:
                step = wrap(step + 0.5 * period, period) - 0.5 * period
            tangent[direction] = step
            direction += 1


@njit(cache=True, nogil=True)
def directions(unknowns, members):
    """Return how many directions some unknowns have."""
    size = 0
    for i in members:
        size += unknowns[DIRECTION, i + 1] - unknowns[DIRECTION, i]
    return size


@njit(cache=True, nogil=True)
def shaped(rng, factor, size, normal, tangent):
    """tangent = factor @ normal for a (size, size) lower triangle stored flat, the normals drawn here."""
    for i in range(size):
        normal[i] = rng.standard_normal()
    for i in range(size):
        total = 0.0
        for j in range(i + 1):
            total += factor[i * size + j] * normal[j]
        tangent[i] = total
