"""Drift: a normal step, shaped by the posterior covariance that warm-up has seen."""

import numpy as np

from derender.posterior.kernels.base import KernelType, decide, evaluate, kernels


class Drift:
    """Random-walk Metropolis: tangent = scale * factor @ z with z standard normal.

    The tangent's density is even and does not depend on where the step starts, and `Space.move` is symmetric, so
    proposal(new | old) = proposal(old | new):
    log ratio = log posterior(new) - log posterior(old).
    """

    def __init__(self, target, block, factor, scale, temperature=1.0, kind="drift"):
        self.target, self.block, self.factor = target, block, factor
        self.scale, self.temperature = scale, temperature
        self.name = f"{kind} {block.name}"

    def __call__(self, rng, state):
        normal = np.array([rng.standard_normal() for _ in range(len(self.factor))])
        values = self.target.space.move(state.values, self.block, self.scale * (self.factor @ normal))
        new = evaluate(self.target, values)
        return decide(rng, state, new, 0.0, self.temperature, self.name)


def factor_of(covariance: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the lower Cholesky factor of the conditional spread of some directions, the others held fixed.

    Held-fixed spread is the inverse of the block of the precision matrix: a step of one block alone must fit between
    the others, which stay.
    """
    precision = np.linalg.inv(covariance)
    return np.linalg.cholesky(np.linalg.inv(precision[np.ix_(directions, directions)]))


def directions_of(space, block) -> np.ndarray:
    """Return the indices of a block's directions in the tangents of the whole space."""
    return np.concatenate([np.arange(space.directions[i], space.directions[i + 1]) for i in block.unknowns])


class DriftType(KernelType):
    """Random-walk Metropolis."""

    options = {"scale": 1.0}
    adapts = True

    def build(self, target, block, tuning, options):
        factor = factor_of(tuning.covariance, directions_of(target.space, block))
        name = f"{self.name} {block.name}"
        scale = options["scale"] * tuning.scale.get(name, 1.0) * 2.4 / np.sqrt(len(factor))
        return Drift(target, block, factor, scale, tuning.temperature, self.name)


@kernels.register("drift")
class BlockDriftType(DriftType):
    """Random-walk step of one edge's contact or one object's shape; its scale is learned in warm-up."""

    code = 1


@kernels.register("drift-all")
class AllDriftType(DriftType):
    """Random-walk step of all unknowns at once, shaped by their learned covariance."""

    code = 1
    per_block = False
    acceptance = 0.234
