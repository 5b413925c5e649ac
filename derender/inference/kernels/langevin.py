"""Langevin: a step along the gradient of the log posterior, corrected (MALA), preconditioned by warm-up."""

import numpy as np

from derender.inference.kernels.base import KernelType, decide, evaluate, kernels


class Langevin:
    """Propose tangent t = s^2 / 2 C g(old) + s L z with C = L L^T, g the gradient of the log posterior in tangents.

    Normal with that mean m(old) and covariance s^2 C, so with b the tangent back, from new to old,
    log q(new | old) = -|L^-1 (t - m(old))|^2 / (2 s^2), log q(old | new) = -|L^-1 (b - m(new))|^2 / (2 s^2) and
    log ratio = log posterior(new) - log posterior(old) + log q(old | new) - log q(new | old).
    Refused as in `independence`: steps of more than half a period, which `difference` would read the short way.
    Any vector in place of g leaves the step exact; a good gradient makes it fast.
    """

    name = "langevin all"

    def __init__(self, target, block, derivative, factor, scale, temperature=1.0):
        self.target, self.block, self.derivative, self.factor = target, block, derivative, factor
        self.scale, self.temperature = scale, temperature

    def _mean(self, values):
        gradient, _ = self.derivative.at(values, self.temperature)
        return 0.5 * self.scale**2 * (self.factor @ (self.factor.T @ gradient))

    def _log_proposal(self, tangent, mean):
        white = np.linalg.solve(self.factor, tangent - mean)
        return -0.5 * float(white @ white) / self.scale**2

    def __call__(self, rng, state):
        space = self.target.space
        normal = np.array([rng.standard_normal() for _ in range(len(self.factor))])
        mean = self._mean(state.values)
        tangent = mean + self.scale * (self.factor @ normal)
        new = evaluate(self.target, space.move(state.values, self.block, tangent))
        correction = 0.0
        if new.log_prior > -np.inf:
            back = space.difference(state.values, new.values, self.block)
            if np.allclose(back, -tangent, rtol=1e-6, atol=1e-9):
                correction = self._log_proposal(back, self._mean(new.values)) - self._log_proposal(tangent, mean)
            else:
                new = new._replace(log_prior=-np.inf)
        return decide(rng, state, new, correction, self.temperature, self.name)


@kernels.register("langevin")
class LangevinType(KernelType):
    """Step along the gradient of the log posterior in all unknowns (MALA)."""

    options = {"scale": 1.0}
    per_block = False
    adapts = True
    acceptance = 0.57

    def applies(self, space, block):
        # A rotation's tangent has a density per volume that is not that per Haar measure: lines and circles only.
        return bool(block.unknowns) and all(unknown.distribution.size == 1 for unknown in space.unknowns)

    def build(self, target, block, tuning, options):
        size = len(tuning.covariance)
        scale = options["scale"] * tuning.scale.get("langevin all", 1.0) * 1.2 / size ** (1 / 6)
        factor = np.linalg.cholesky(tuning.covariance)
        return Langevin(target, block, target.derivative(), factor, scale, tuning.temperature)
