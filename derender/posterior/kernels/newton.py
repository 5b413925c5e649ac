"""Newton: a step along the gradient, measured by the curvature that the posterior has here."""

import numpy as np

from derender.posterior.kernels.base import KernelType, kernels
from derender.posterior.kernels.informed import Informed


class Newton(Informed):
    """Propose tangent t = m(old) + s A(old)^(-1/2) z with m = s^2 / 2 A^-1 g: g and A the gradient and the Gauss-Newton
    precision of the log posterior, z standard normal (Girolami and Calderhead 2011, the simplified manifold MALA).

    `langevin` with a covariance of the place instead of warm-up's:
    log q(t | place) = log |A| / 2 - |A^(1/2) (t - m)|^2 / (2 s^2); the log ratio is that of `Informed`.
    Any positive precision leaves the step exact if it depends on the place alone.
    """

    name = "newton all"

    def known(self, values):
        """Return the mean m (D,) of the tangent from here and the lower factor (D, D) of A."""
        space = self.target.space
        ways = np.concatenate([np.arange(space.directions[i], space.directions[i + 1]) for i in self.block.unknowns])
        gradient, precision = self.derivative.at(values, self.temperature)
        factor = np.linalg.cholesky(precision[np.ix_(ways, ways)])
        step = np.linalg.solve(factor.T, np.linalg.solve(factor, gradient[ways]))
        return 0.5 * self.scale**2 * step, factor

    def tangent(self, normal, known):
        mean, factor = known
        return mean + self.scale * np.linalg.solve(factor.T, normal)

    def log_proposal(self, tangent, known):
        mean, factor = known
        white = factor.T @ (tangent - mean)
        return float(np.sum(np.log(np.diag(factor)))) - 0.5 * float(white @ white) / self.scale**2


@kernels.register("newton")
class NewtonType(KernelType):
    """Step along the gradient of the image, measured by its curvature here, in all contacts and shapes at once."""

    options = {"scale": 0.3}
    per_block = False
    adapts = True
    acceptance = 0.5

    def applies(self, space, block):
        return bool(self.moves(space, block))

    def moves(self, space, block):
        from derender.posterior.derivative import followed

        return followed(space)

    def build(self, target, block, tuning, options):
        block = block._replace(unknowns=tuple(self.moves(target.space, block)))
        scale = options["scale"] * tuning.scale.get("newton all", 1.0) / max(len(block.unknowns), 1) ** (1 / 6)
        return Newton(target, block, target.derivative(), scale, tuning.temperature)
