"""Newton: a step along the gradient, measured by the curvature that the posterior has here."""

import math

import numpy as np

from derender.inference.kernels.base import KernelType, decide, evaluate, kernels


class Newton:
    """Propose tangent t = m(old) + s A(old)^(-1/2) z with m = s^2 / 2 A^-1 g: g and A the gradient and the Gauss-Newton
    precision of the log posterior, z standard normal (Girolami and Calderhead 2011, the simplified manifold MALA).

    `langevin` with a covariance of the place instead of warm-up's. Both m and A depend on where the step starts, so
    with b the tangent back, from new to old,
    log q(new | old) = log |A(old)| / 2 - |A(old)^(1/2) (t - m(old))|^2 / (2 s^2), the same from new with b, and
    log ratio = log posterior(new) - log posterior(old) + log q(old | new) - log q(new | old).
    Refused as in `langevin`: steps of more than half a period, which `difference` would read the short way. Any
    gradient and any positive precision leave the step exact if they depend on the place alone.
    """

    name = "newton all"

    def __init__(self, target, block, derivative, scale, temperature=1.0):
        self.target, self.block, self.derivative = target, block, derivative
        self.scale, self.temperature = scale, temperature
        self.directions = np.concatenate(
            [np.arange(target.space.directions[i], target.space.directions[i + 1]) for i in block.unknowns]
        )

    def expected(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean m (D,) of the tangent from here and the lower factor (D, D) of A."""
        gradient, precision = self.derivative.at(values, self.temperature)
        factor = np.linalg.cholesky(precision[np.ix_(self.directions, self.directions)])
        step = np.linalg.solve(factor.T, np.linalg.solve(factor, gradient[self.directions]))
        return 0.5 * self.scale**2 * step, factor

    def log_proposal(self, tangent, mean, factor) -> float:
        """Return log q of a tangent up to a constant."""
        white = factor.T @ (tangent - mean)
        return float(np.sum(np.log(np.diag(factor)))) - 0.5 * float(white @ white) / self.scale**2

    def __call__(self, rng, state):
        space = self.target.space
        normal = np.array([rng.standard_normal() for _ in self.directions])
        mean, factor = self.expected(state.values)
        tangent = mean + self.scale * np.linalg.solve(factor.T, normal)
        new = evaluate(self.target, space.move(state.values, self.block, tangent))
        correction = 0.0
        if new.log_prior > -math.inf:
            back = space.difference(state.values, new.values, self.block)
            if np.allclose(back, -tangent, rtol=1e-6, atol=1e-9):
                correction = self.log_proposal(back, *self.expected(new.values))
                correction -= self.log_proposal(tangent, mean, factor)
            else:
                new = new._replace(log_prior=-math.inf)
        return decide(rng, state, new, correction, self.temperature, self.name)


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
        from derender.inference.derivative import followed

        return followed(space)

    def build(self, target, block, tuning, options):
        block = block._replace(unknowns=tuple(self.moves(target.space, block)))
        scale = options["scale"] * tuning.scale.get("newton all", 1.0) / max(len(block.unknowns), 1) ** (1 / 6)
        return Newton(target, block, target.derivative(), scale, tuning.temperature)
