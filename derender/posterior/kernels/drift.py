"""Local steps: drift of a block or of all unknowns, also under what stands on top."""

import numpy as np

from derender.compilation.cache import njit
from derender.posterior.compiled.layout import NEXT, NOW
from derender.posterior.compiled.prior import directions, move, shaped
from derender.posterior.kernels.base import KernelType, Part, Tuning, kernels
from derender.posterior.space import Block, Space


@njit(cache=True, nogil=True)
def drifted(rng, unknowns, laws, values, tangents, members, factor, scale):
    """Random-walk Metropolis: tangent = scale * factor @ z with z standard normal.

    The tangent's density is even and does not depend on where the step starts, and `move` is symmetric, so
    proposal(new | old) = proposal(old | new):
    log ratio = log posterior(new) - log posterior(old).
    """
    shaped(rng, factor, directions(unknowns, members), tangents[1], tangents[0])
    move(unknowns, laws, members, values[NOW], tangents[0], scale, values[NEXT])
    return 0.0


def factor_of(covariance: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the lower Cholesky factor of the conditional spread of some directions, the others held fixed.

    Held-fixed spread is the inverse of the block of the precision matrix: a step of one block alone must fit between
    the others, which stay.
    """
    precision = np.linalg.inv(covariance)
    return np.linalg.cholesky(np.linalg.inv(precision[np.ix_(directions, directions)]))


def directions_of(space: Space, block: Block) -> np.ndarray:
    """Return the indices of a block's directions in the tangents of the whole space."""
    return np.concatenate([np.arange(space.directions[i], space.directions[i + 1]) for i in block.unknowns])


class DriftType(KernelType):
    """Random-walk Metropolis."""

    options = {"scale": 1.0}
    adapts = True
    proposal = drifted

    def factor(self, space: Space, part: Part, tuning: Tuning) -> np.ndarray:
        return factor_of(tuning.covariance, directions_of(space, part.block))

    def scale(self, space: Space, part: Part, tuning: Tuning) -> float:
        # 2.4 / sqrt(D): best for a normal posterior (Roberts, Gelman, Gilks 1997)
        return part.options["scale"] * tuning.scale.get(part.name, 1.0) * 2.4 / np.sqrt(space.size(part.block))


@kernels.register("drift")
class BlockDriftType(DriftType):
    """Random-walk step of one edge's contact or one object's shape; its scale is learned in warm-up."""


@kernels.register("drift-all")
class AllDriftType(DriftType):
    """Random-walk step of all unknowns at once, shaped by their learned covariance."""

    per_block = False
    acceptance = 0.234


@kernels.register("slide")
class SlideType(DriftType):
    """Move an object and leave what stands on it where it is.

    The edge's new phi' = phi + even noise, as in `drift`. Each child's contact becomes phi_c' = invert(pose of the
    child in the new frame of its parent), a function of (phi_c, phi, phi'), undone by the step back. For fixed (phi,
    phi') it is a bijection of phi_c; the change of (phi, phi_c) at given noise is triangular, so its Jacobian is the
    product of |d phi_c' / d phi_c| over the children:
    log ratio = log posterior(new) - log posterior(old) + sum of log |d phi_c' / d phi_c|.
    `reattach` finds the contacts and the Jacobian; where a child would lose its contact there is none, and the step
    is refused (as is the way back to there).
    """

    keeps_children = True

    def applies(self, space: Space, block: Block) -> bool:
        return block.name in space.slides

    def factor(self, space: Space, part: Part, tuning: Tuning) -> np.ndarray:
        """Return the factor of the spread of the block's directions, whatever the others do: here they give way."""
        directions = directions_of(space, part.block)
        return np.linalg.cholesky(tuning.covariance[np.ix_(directions, directions)])
