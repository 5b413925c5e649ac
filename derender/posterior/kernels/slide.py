"""Slide: one object moves under its children, which stay where they are in the world."""

import numpy as np

from derender.posterior.kernels.base import kernels
from derender.posterior.kernels.drift import DriftType, directions_of


@kernels.register("slide")
class SlideType(DriftType):
    """Move an object and leave what stands on it where it is.

    The edge's new phi' = phi + even noise, as in `drift`. Each child's contact becomes phi_c' = invert(pose of the
    child in the new frame of its parent), a function of (phi_c, phi, phi'), undone by the step back. For fixed (phi,
    phi') it is a bijection of phi_c; the change of (phi, phi_c) at given noise is triangular, so its Jacobian is the
    product of |d phi_c' / d phi_c| over the children:
    log ratio = log posterior(new) - log posterior(old) + sum of log |d phi_c' / d phi_c|.
    `touch_anew` finds the contacts and the Jacobian; where a child would lose its contact there is none, and the step
    is refused (as is the way back to there).
    """

    keeps_children = True

    def applies(self, space, block):
        return block.name in space.slides

    def factor(self, space, part, tuning):
        """Return the factor of the spread of the block's directions, whatever the others do: here they give way."""
        directions = directions_of(space, part.block)
        return np.linalg.cholesky(tuning.covariance[np.ix_(directions, directions)])
