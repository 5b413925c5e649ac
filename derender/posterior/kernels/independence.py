"""Independence: propose everything from a fitted multivariate t distribution (a heavy-tailed Laplace approximation)."""

import math

import numpy as np

from derender.posterior.kernels.base import KernelType, decide, evaluate, kernels

DEGREES = 5  # of freedom of the t distribution: heavier tails than any posterior that it has to cover


class Independence:
    """Propose new = mean moved by tangent t, t from a multivariate t distribution with 5 degrees of freedom.

    With r2 = |factor^-1 t|^2 and D directions its density is q(t) = c (1 + r2 / 5)^(-(5 + D) / 2). On a circle a
    tangent beyond half a period would come back on the other side, where `difference` does not find it again: such
    proposals are refused, which only changes c. A rotation's tangent w has density q(w) per volume of w; per Haar
    measure it is q(w) / sinc(|w| / 2)^2, because Haar measure in these coordinates is sinc(|w| / 2)^2 dw up to a
    constant. The proposal does not look at the old state:
    log ratio = log posterior(new) - log posterior(old) + log q(old) - log q(new).
    """

    name = "independence all"

    def __init__(self, target, block, mean, factor, temperature=1.0):
        self.target, self.block, self.mean, self.factor = target, block, mean, factor
        self.temperature = temperature

    def log_proposal(self, tangent: np.ndarray) -> float:
        """Return log q up to its constant; -inf where it cannot propose."""
        space = self.target.space
        squared = 0.0
        solved = np.empty(len(tangent))
        for i in range(len(tangent)):
            solved[i] = (tangent[i] - self.factor[i, :i] @ solved[:i]) / self.factor[i, i]
            squared += solved[i] * solved[i]
        log_density = -0.5 * (DEGREES + len(tangent)) * math.log1p(squared / DEGREES)
        direction = 0
        for i in self.block.unknowns:
            unknown = space.unknowns[i]
            if unknown.distribution.size == 4:
                angle = math.sqrt(sum(tangent[direction + k] ** 2 for k in range(3)))
                if angle > math.pi:
                    return -math.inf
                if angle > 1e-9:
                    log_density -= 2.0 * math.log(math.sin(0.5 * angle) / (0.5 * angle))
                direction += 3
                continue
            if unknown.ways == 0:
                continue
            if unknown.period is not None and abs(tangent[direction]) > 0.5 * unknown.period:
                return -math.inf
            direction += 1
        return log_density

    def __call__(self, rng, state):
        space = self.target.space
        normal = np.array([rng.standard_normal() for _ in range(len(self.factor))])
        chi_squared = 0.0
        for _ in range(DEGREES):
            chi_squared += rng.standard_normal() ** 2
        tangent = (self.factor @ normal) * math.sqrt(DEGREES / chi_squared)
        proposed = self.log_proposal(tangent)
        if proposed == -math.inf:
            new = state._replace(log_prior=-math.inf)
            return decide(rng, state, new, 0.0, self.temperature, self.name)
        centre = self.mean.copy()
        for i in self.block.unknowns:  # a discrete unknown has no tangent: it stays as it is
            if space.unknowns[i].ways == 0:
                centre[space.offsets[i]] = state.values[space.offsets[i]]
        new = evaluate(self.target, space.move(centre, self.block, tangent))
        old = self.log_proposal(space.difference(state.values, self.mean, self.block))
        return decide(rng, state, new, old - proposed, self.temperature, self.name)


@kernels.register("independence")
class IndependenceType(KernelType):
    """Propose everything from a t distribution fitted in warm-up; bold where the posterior is nearly normal."""

    options = {"inflation": 1.1}
    per_block = False
    code = 2

    def build(self, target, block, tuning, options):
        factor = options["inflation"] * np.linalg.cholesky(tuning.covariance)
        return Independence(target, block, tuning.mean, factor, tuning.temperature)
