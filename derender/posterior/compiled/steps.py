"""The sweep: pick a kernel, propose, evaluate, decide, keep; one source, which numba compiles or Python runs.

The engine is called from one place only, since whatever a compiled function calls is compiled into it again.
"""

import math

from derender.compilation.cache import call_for_number, njit
from derender.posterior.compiled.evaluate import evaluate, settle
from derender.posterior.compiled.layout import (
    CUMULATIVE,
    CYCLE,
    DENSITY,
    FACTOR_FIRST,
    FIRST,
    FORM,
    KEEP,
    KEEP_AT,
    NEXT,
    NOW,
    PLACE_AT,
    PRIOR,
    PROPOSE_AT,
    SCALE,
    STEPS,
)
from derender.posterior.kernels.base import PLACING
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
def sweep(rng, model, kernels, chain, engine, done, draws, thin, temperature, kept, counts):
    """Take draws * thin steps, of which `done` are done, and keep every `thin`-th state.

    Returns early where the caller takes the next step: how many are done, and its kernel's number; else -1.
    kept : (draws, P + 2) float64, written: values, log prior, log likelihood.
    counts : (K, 2) int64 (steps, accepted ones), added to.
    """
    unknowns, laws, values = model.unknowns, model.laws, chain.values
    size = model.places.shape[1]
    for taken in range(done, draws * thin):
        k = pick(rng, kernels.table, kernels.numbers, chain.flags)
        form = kernels.table[FORM, k]
        if form == ELSEWHERE:
            return taken, k
        members = kernels.members[kernels.table[FIRST, k] : kernels.table[FIRST, k + 1]]
        factor = kernels.factors[kernels.table[FACTOR_FIRST, k] : kernels.table[FACTOR_FIRST, k + 1]]
        keep, put = kernels.table[KEEP, k], members[:0]  # put : vertices that a relocation puts down
        if form == PLACING:
            put, thetas = members[2 : 2 + len(members) // 2 - 1], members[1 + len(members) // 2 :]
            correction = call_for_number(
                kernels.table[PLACE_AT, k], rng, model.vertices, laws, chain.numbers, chain.pose, chain.relative,
                chain.moved_pose, put, members[0], members[1], thetas, factor, kernels.table[PROPOSE_AT, k]
            )  # fmt: skip
        else:
            correction = call_for_number(
                kernels.table[PROPOSE_AT, k], rng, unknowns, laws, values, chain.tangents, members, factor,
                kernels.numbers[k, SCALE]
            )  # fmt: skip
        if keep >= 0 and not math.isnan(correction):
            correction += call_for_number(
                kernels.table[KEEP_AT, k], model.vertices, model.extents, model.places, laws, values, chain.numbers,
                chain.pose, chain.marks, engine.parameters, chain.relative, keep, put, chain.moved_pose
            )  # fmt: skip
        if math.isnan(correction):
            values[NEXT, PRIOR] = -math.inf
        else:
            evaluate(model, chain, engine)
        log_ratio = -math.inf
        if values[NEXT, PRIOR] > -math.inf:
            log_ratio = values[NEXT, PRIOR] - values[NOW, PRIOR] + correction
            log_ratio += temperature * (values[NEXT, DENSITY] - values[NOW, DENSITY])
        accepted = compiled_log_threshold(rng) < log_ratio
        settle(model, chain, engine, accepted)
        counts[k, 0] += 1
        counts[k, 1] += accepted
        if (taken + 1) % thin == 0:
            for p in range(size + 2):
                kept[taken // thin, p] = values[NOW, p]
    return draws * thin, -1
