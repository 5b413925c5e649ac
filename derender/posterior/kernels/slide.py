"""Slide: one object moves under its children, which stay where they are in the world."""

import numpy as np

from derender.posterior.kernels.base import KernelType, decide, evaluate_kept, kernels
from derender.posterior.kernels.drift import directions_of


class Slide:
    """Random-walk step of an edge, after which its object's children get the contacts that keep their poses.

    The edge's new phi' = phi + even noise, as in `drift`. Each child's contact becomes phi_c' = invert(pose of the
    child in the new frame of its parent), a function of (phi_c, phi, phi'), undone by the step back. For fixed (phi,
    phi') it is a bijection of phi_c; the change of (phi, phi_c) at given noise is triangular, so its Jacobian is the
    product of |d phi_c' / d phi_c| over the children:
    log ratio = log posterior(new) - log posterior(old) + sum of log |d phi_c' / d phi_c|.
    The target knows the inverse and its Jacobian (`keep_children`); where a child would lose its contact there is none,
    and the step is refused (as is the way back to there).
    """

    def __init__(self, target, block, factor, scale, temperature=1.0):
        self.target, self.block, self.factor = target, block, factor
        self.scale, self.temperature = scale, temperature
        self.name = f"slide {block.name}"

    def __call__(self, rng, state):
        normal = np.array([rng.standard_normal() for _ in range(len(self.factor))])
        moved = self.target.space.move(state.values, self.block, self.scale * (self.factor @ normal))
        new, log_jacobian = evaluate_kept(self.target, state, moved, self.block)
        return decide(rng, state, new, log_jacobian, self.temperature, self.name)


def marginal_factor(covariance: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the lower Cholesky factor of the spread of some directions, whatever the others do: here they give way."""
    return np.linalg.cholesky(covariance[np.ix_(directions, directions)])


@kernels.register("slide")
class SlideType(KernelType):
    """Move an object and leave what stands on it where it is."""

    options = {"scale": 1.0}
    adapts = True
    keeps_children = True
    code = 1

    def applies(self, space, block):
        return block.name in space.slides

    def build(self, target, block, tuning, options):
        factor = marginal_factor(tuning.covariance, directions_of(target.space, block))
        scale = options["scale"] * tuning.scale.get(f"slide {block.name}", 1.0) * 2.4 / np.sqrt(len(factor))
        return Slide(target, block, factor, scale, tuning.temperature)
