"""Resimulation: draw a block anew from its prior (the paper's section 3)."""

from derender.compilation.cache import njit
from derender.posterior.compiled.layout import NEXT, NOW
from derender.posterior.compiled.prior import log_prior, resample
from derender.posterior.kernels.base import KernelType, kernels


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
