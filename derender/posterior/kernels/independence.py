"""Proposals that do not look at the present state: from a t distribution fitted in warm-up, or from the prior."""

import math

import numpy as np

from derender.compilation.cache import njit
from derender.posterior.compiled.layout import CODE, NEXT, NOW, PERIOD, ROTATION
from derender.posterior.compiled.prior import difference, directions, log_prior, move, resample, shaped
from derender.posterior.kernels.base import KernelType, kernels

DEGREES = 5  # of freedom of the t distribution: heavier tails than any posterior that it has to cover


@njit(cache=True, nogil=True)
def log_proposal(unknowns, laws, members, tangent, factor, solved):
    """Return the log density of an independence proposal up to a constant; -inf where it cannot propose."""
    size = directions(unknowns, members)
    squared = 0.0
    for i in range(size):
        rest = tangent[i]
        for j in range(i):
            rest -= factor[i * size + j] * solved[j]
        solved[i] = rest / factor[i * size + i]
        squared += solved[i] * solved[i]
    log_density = -0.5 * (DEGREES + size) * math.log1p(squared / DEGREES)
    direction = 0
    for i in members:
        if unknowns[CODE, i] == ROTATION:
            angle = math.sqrt(tangent[direction] ** 2 + tangent[direction + 1] ** 2 + tangent[direction + 2] ** 2)
            if angle > math.pi:
                return -math.inf
            if angle > 1e-9:
                log_density -= 2.0 * math.log(math.sin(0.5 * angle) / (0.5 * angle))
            direction += 3
        else:
            period = laws[i, PERIOD]
            if period != 0.0 and abs(tangent[direction]) > 0.5 * period:
                return -math.inf
            direction += 1
    return log_density


@njit(cache=True, nogil=True)
def independent(rng, unknowns, laws, values, tangents, members, factor, scale, spread, mean):
    """Propose new = mean moved by tangent t, t from a multivariate t distribution with 5 degrees of freedom.

    With r2 = |factor^-1 t|^2 and D directions its density is q(t) = c (1 + r2 / 5)^(-(5 + D) / 2). On a circle a
    tangent beyond half a period would come back on the other side, where `difference` does not find it again: such
    proposals are refused, which only changes c. A rotation's tangent w has density q(w) per volume of w; per Haar
    measure it is q(w) / sinc(|w| / 2)^2, because Haar measure in these coordinates is sinc(|w| / 2)^2 dw up to a
    constant. The proposal does not look at the old state:
    log ratio = log posterior(new) - log posterior(old) + log q(old) - log q(new).
    """
    tangent, solved = tangents[0], tangents[1]
    size = directions(unknowns, members)
    shaped(rng, factor, size, solved, tangent)
    chi_squared = 0.0
    for _ in range(DEGREES):
        chi_squared += rng.standard_normal() ** 2
    for i in range(size):
        tangent[i] *= math.sqrt(DEGREES / chi_squared)
    forward = log_proposal(unknowns, laws, members, tangent, factor, solved)
    if forward == -math.inf:
        return math.nan
    move(unknowns, laws, members, mean, tangent, 1.0, values[NEXT])
    difference(unknowns, laws, members, values[NOW], mean, tangent)
    return log_proposal(unknowns, laws, members, tangent, factor, solved) - forward


@kernels.register("independence")
class IndependenceType(KernelType):
    """Propose everything from a t distribution fitted in warm-up; bold where the posterior is nearly normal."""

    options = {"inflation": 1.1}
    per_block = False
    proposal = independent

    def factor(self, space, part, tuning):
        return part.options["inflation"] * np.linalg.cholesky(tuning.covariance)


@njit(cache=True, nogil=True)
def resimulated(rng, unknowns, laws, values, tangents, members, factor, scale, spread, mean):
    """Propose the block from its own prior, which knows no constraints between objects.

    proposal(new | old) = own prior(new block), so that prior and proposal cancel up to the constraints:
    log ratio = temperature * (log likelihood(new) - log likelihood(old)) + constraints(new) - constraints(old).
    """
    resample(rng, unknowns, laws, members, values[NEXT])
    return log_prior(unknowns, laws, values[NOW]) - log_prior(unknowns, laws, values[NEXT])


@kernels.register("resimulate")
class ResimulateType(KernelType):
    """Draw one edge's contact, or one object's shape, anew from the prior."""

    proposal = resimulated
