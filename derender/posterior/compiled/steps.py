"""The kernels, compiled: the same random numbers in the same order as the readable ones, the same decisions.

A step is: propose (by kernel), evaluate, decide. The engine is called from one place only, since whatever a compiled
function calls is compiled into it again.
"""

import math

from derender.compilation.cache import njit
from derender.compilation.call import call_for_number
from derender.posterior.compiled.evaluate import evaluate, settle
from derender.posterior.compiled.layout import (
    COUNT,
    CUMULATIVE,
    CYCLE,
    DENSITY,
    DIRECTION,
    FACTOR_FIRST,
    FIRST,
    KEEP,
    KEEP_AT,
    KERNEL,
    LOG,
    NEXT,
    NOW,
    OFFSET,
    PERIOD,
    PRIOR,
    PROPOSE_AT,
    REACH,
    SCALE,
    STEPS,
)
from derender.posterior.compiled.prior import (
    difference,
    directions,
    log_prior,
    log_proposal,
    move,
    resample,
    shaped,
    wrap,
)
from derender.posterior.kernels.independence import DEGREES
from derender.posterior.kernels.window import FINEST
from derender.sampling.metropolis import compiled_log_threshold

RESIMULATE, DRIFT, INDEPENDENCE, WINDOW, JUMP, FLIP, RELOCATE, TURN = range(8)
PLACING = (RELOCATE, TURN)  # they put objects down in the world
READABLE = -1  # a kernel without a compiled form: the caller takes its step


@njit(cache=True, nogil=True)
def pick(rng, table, numbers, flags):
    """Return the number of the next kernel: by weight, or in turns."""
    count = len(numbers)
    flags[STEPS] += 1
    if flags[CYCLE]:
        return (flags[STEPS] - 1) % count
    threshold = rng.random() * numbers[count - 1, CUMULATIVE]
    for k in range(count - 1):
        if threshold < numbers[k, CUMULATIVE]:
            return k
    return count - 1


@njit(cache=True, nogil=True)
def half_turn(unknowns, laws, values, i):
    """Turn angle i of the proposed values by half its period."""
    start, period = unknowns[OFFSET, i], laws[i, PERIOD]
    values[NEXT, start] = wrap(values[NOW, start] + 0.5 * period, period)


@njit(cache=True, nogil=True)
def propose(rng, unknowns, laws, values, tangents, members, factor, code, scale, spread, mean):
    """Write the proposed values; return log proposal(old | new) / proposal(new | old), or NaN where there is none."""
    tangent, solved = tangents[0], tangents[1]
    if code == RESIMULATE:
        resample(rng, unknowns, laws, members, values[NEXT])
        return log_prior(unknowns, laws, values[NOW]) - log_prior(unknowns, laws, values[NEXT])
    if code == DRIFT:
        shaped(rng, factor, directions(unknowns, members), solved, tangent)
        move(unknowns, laws, members, values[NOW], tangent, scale, values[NEXT])
        return 0.0
    if code == INDEPENDENCE:
        size = directions(unknowns, members)
        shaped(rng, factor, size, solved, tangent)
        chi_squared = 0.0
        for _ in range(DEGREES):
            chi_squared += rng.standard_normal() ** 2
        for i in range(size):
            tangent[i] *= math.sqrt(DEGREES / chi_squared)
        forward = log_proposal(unknowns, laws, members, tangent, factor, solved, DEGREES)
        if forward == -math.inf:
            return math.nan
        move(unknowns, laws, members, mean, tangent, 1.0, values[NEXT])
        difference(unknowns, laws, members, values[NOW], mean, tangent)
        return log_proposal(unknowns, laws, members, tangent, factor, solved, DEGREES) - forward
    if code == JUMP:
        angles = 0
        for i in members:
            angles += laws[i, PERIOD] != 0.0
        wanted = int(rng.random() * angles)
        for i in members:
            if laws[i, PERIOD] != 0.0:
                if wanted == 0:
                    half_turn(unknowns, laws, values, i)
                wanted -= 1
        return 0.0
    if code == FLIP:
        chosen = 3 * int(rng.random() * (len(members) // 3))
        half_turn(unknowns, laws, values, members[chosen])
        length, width = unknowns[OFFSET, members[chosen + 1]], unknowns[OFFSET, members[chosen + 2]]
        values[NEXT, length], values[NEXT, width] = values[NOW, width], values[NOW, length]
        return 0.0
    # A window: spacing and direction; the places come later.
    size = directions(unknowns, members)
    direction = 0
    for i in members:
        for way in range(unknowns[DIRECTION, i], unknowns[DIRECTION, i + 1]):
            tangent[direction] = rng.standard_normal() * spread[way]
            direction += 1
    used = 0
    for i in range(size):
        solved[i] = 1.0 if rng.random() < 0.5 else 0.0
        used += solved[i] == 1.0
    for i in range(size):
        tangent[i] *= solved[i] if used else 1.0
    return 0.0


@njit(cache=True, nogil=True)
def choose(rng, row, count, present):
    """Return the number of one place of a window, in proportion to the exponentials of its logs."""
    highest = -math.inf
    for k in range(count):
        highest = max(highest, row[k, LOG])
    total = 0.0
    for k in range(count):
        total += math.exp(row[k, LOG] - highest)
    threshold = rng.random() * total
    running = 0.0
    for k in range(count):
        running += math.exp(row[k, LOG] - highest)
        if threshold < running:
            return k
    return present


@njit(cache=True, nogil=True)
def sweep(rng, model, kernels, chain, engine, done, draws, thin, temperature, kept, counts):
    """Take draws * thin steps, of which `done` are done, and keep every `thin`-th state.

    Returns early where the next step is a readable kernel's: how many are done, and that kernel's number; else -1.
    kept : (draws, P + 3) float64, written: values, log prior, log likelihood, a spare.
    counts : (K, 2) int64 (steps, accepted ones), added to.
    """
    unknowns, laws, values, row = model.unknowns, model.laws, chain.values, chain.row
    size = model.places.shape[1]
    for taken in range(done, draws * thin):
        k = pick(rng, kernels.table, kernels.numbers, chain.flags)
        code = kernels.table[KERNEL, k]
        if code == READABLE:
            return taken, k
        members = kernels.members[kernels.table[FIRST, k] : kernels.table[FIRST, k + 1]]
        factor = kernels.factors[kernels.table[FACTOR_FIRST, k] : kernels.table[FACTOR_FIRST, k + 1]]
        scale = kernels.numbers[k, SCALE]
        keep = kernels.table[KEEP, k]
        places, present, spacing = 1, -1, 0.0
        put = members[:0]  # vertices that a relocation puts down
        if code == WINDOW:
            reach = kernels.numbers[k, REACH]
            spacing = reach * math.exp(rng.random() * math.log(FINEST / reach))
        if code in PLACING:
            put, thetas = members[2 : 2 + len(members) // 2 - 1], members[1 + len(members) // 2 :]
            correction = call_for_number(
                kernels.table[PROPOSE_AT, k], rng, model.vertices, laws, chain.numbers, chain.pose, chain.relative,
                chain.moved_pose, put, members[0], members[1], thetas, factor
            )  # fmt: skip
        else:
            correction = call_for_number(
                kernels.table[PROPOSE_AT, k], rng, unknowns, laws, values, chain.tangents, members, factor, code, scale,
                kernels.spread, kernels.mean
            )  # fmt: skip
        if code == WINDOW:
            places = int(kernels.numbers[k, COUNT])
            present = int(rng.random() * places)
            for p in range(size + 3):
                row[present, p] = values[NOW, p]
            row[present, LOG] = values[NOW, PRIOR] + temperature * values[NOW, DENSITY]
        accepted = False
        for place in range(places + (code == WINDOW)):
            if place == present:
                continue
            if code == WINDOW:
                chosen = choose(rng, row, places, present) if place == places else place
                if chosen == present:
                    break
                step = (chosen - present) * spacing
                move(unknowns, laws, members, values[NOW], chain.tangents[0], step, values[NEXT])
            jacobian = 0.0
            if keep >= 0 and not math.isnan(correction):
                jacobian = call_for_number(
                    kernels.table[KEEP_AT, k], model.vertices, model.extents, model.places, laws, values, chain.numbers,
                    chain.pose, chain.marks, engine.parameters, chain.relative, keep, put, chain.moved_pose
                )  # fmt: skip
            if math.isnan(correction + jacobian):
                values[NEXT, PRIOR] = -math.inf
            else:
                evaluate(model, chain, engine)
            if place < places and code == WINDOW:
                for p in range(size + 3):
                    row[place, p] = values[NEXT, p]
                row[place, LOG] = -math.inf
                if values[NEXT, PRIOR] > -math.inf:
                    row[place, LOG] = values[NEXT, PRIOR] + temperature * values[NEXT, DENSITY] + jacobian
            elif code == WINDOW:
                accepted = True
            else:
                log_ratio = -math.inf
                if values[NEXT, PRIOR] > -math.inf:
                    log_ratio = (
                        values[NEXT, PRIOR]
                        - values[NOW, PRIOR]
                        + temperature * (values[NEXT, DENSITY] - values[NOW, DENSITY])
                        + (correction + jacobian)
                    )
                accepted = compiled_log_threshold(rng) < log_ratio
            settle(model, chain, engine, accepted)
        counts[k, 0] += 1
        counts[k, 1] += accepted
        if (taken + 1) % thin == 0:
            for p in range(size + 3):
                kept[taken // thin, p] = values[NOW, p]
    return draws * thin, -1


__all__ = [
    "DRIFT", "FLIP", "INDEPENDENCE", "JUMP", "PLACING", "READABLE", "RELOCATE", "RESIMULATE", "TURN", "WINDOW", "sweep",
]  # fmt: skip
