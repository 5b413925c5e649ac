"""The sweep: pick a kernel, propose, evaluate, decide, keep; one source, which numba compiles or Python runs.

The engine is called from one place only, since whatever a compiled function calls is compiled into it again.
"""

import math

from derender.compilation.cache import call_for_number, njit
from derender.posterior.compiled.evaluate import evaluate, settle
from derender.posterior.compiled.layout import (
    COUNT,
    CUMULATIVE,
    CYCLE,
    DENSITY,
    FACTOR_FIRST,
    FIRST,
    FORM,
    KEEP,
    KEEP_AT,
    LOG,
    NEXT,
    NOW,
    PLACE_AT,
    PRIOR,
    PROPOSE_AT,
    REACH,
    SCALE,
    STEPS,
)
from derender.posterior.compiled.prior import move
from derender.posterior.kernels.base import PLACING, ROW
from derender.posterior.kernels.drift import FINEST
from derender.sampling.metropolis import compiled_log_threshold

ELSEWHERE = -1  # form of a kernel whose steps the caller takes


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

    Returns early where the caller takes the next step: how many are done, and its kernel's number; else -1.
    kept : (draws, P + 3) float64, written: values, log prior, log likelihood, a spare.
    counts : (K, 2) int64 (steps, accepted ones), added to.
    """
    unknowns, laws, values, row = model.unknowns, model.laws, chain.values, chain.row
    size = model.places.shape[1]
    for taken in range(done, draws * thin):
        k = pick(rng, kernels.table, kernels.numbers, chain.flags)
        form = kernels.table[FORM, k]
        if form == ELSEWHERE:
            return taken, k
        members = kernels.members[kernels.table[FIRST, k] : kernels.table[FIRST, k + 1]]
        factor = kernels.factors[kernels.table[FACTOR_FIRST, k] : kernels.table[FACTOR_FIRST, k + 1]]
        scale = kernels.numbers[k, SCALE]
        keep = kernels.table[KEEP, k]
        places, present, spacing = 1, -1, 0.0
        put = members[:0]  # vertices that a relocation puts down
        if form == ROW:
            reach = kernels.numbers[k, REACH]
            spacing = reach * math.exp(rng.random() * math.log(FINEST / reach))
        if form == PLACING:
            put, thetas = members[2 : 2 + len(members) // 2 - 1], members[1 + len(members) // 2 :]
            correction = call_for_number(
                kernels.table[PLACE_AT, k], rng, model.vertices, laws, chain.numbers, chain.pose, chain.relative,
                chain.moved_pose, put, members[0], members[1], thetas, factor, kernels.table[PROPOSE_AT, k]
            )  # fmt: skip
        else:
            correction = call_for_number(
                kernels.table[PROPOSE_AT, k], rng, unknowns, laws, values, chain.tangents, members, factor, scale,
                kernels.spread, kernels.mean
            )  # fmt: skip
        if form == ROW:
            places = int(kernels.numbers[k, COUNT])
            present = int(rng.random() * places)
            for p in range(size + 3):
                row[present, p] = values[NOW, p]
            row[present, LOG] = values[NOW, PRIOR] + temperature * values[NOW, DENSITY]
        accepted = False
        for place in range(places + (form == ROW)):
            if place == present:
                continue
            if form == ROW:
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
            if place < places and form == ROW:
                for p in range(size + 3):
                    row[place, p] = values[NEXT, p]
                row[place, LOG] = -math.inf
                if values[NEXT, PRIOR] > -math.inf:
                    row[place, LOG] = values[NEXT, PRIOR] + temperature * values[NEXT, DENSITY] + jacobian
            elif form == ROW:
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
