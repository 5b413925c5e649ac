"""Kernels that step among the unknowns: local steps, also under what stands on top; leaps to independent places.

Local steps are of a block or of all unknowns. Leaps come from the prior, or go half the period of an angle: where a box
nearly looks the same then, it jumps alone or with length and width exchanged.
"""

from collections.abc import Sequence

import numpy as np

from derender.compilation.cache import njit
from derender.posterior.compiled.layout import NEXT, NOW, OFFSET, PERIOD
from derender.posterior.compiled.prior import directions, log_prior, move, resample, shaped, wrap
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


@njit(cache=True, nogil=True)
def resimulated(rng, unknowns, laws, values, tangents, members, factor, scale):
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


@njit(cache=True, nogil=True)
def half_turn(unknowns, laws, values, i):
    """Turn angle i of the proposed values by half its period."""
    start, period = unknowns[OFFSET, i], laws[i, PERIOD]
    values[NEXT, start] = wrap(values[NOW, start] + 0.5 * period, period)


@njit(cache=True, nogil=True)
def jumped(rng, unknowns, laws, values, tangents, members, factor, scale):
    """Add half a period to one angle of the block, chosen at random.

    Half a period forward is half a period back, and each angle is chosen with the same probability both ways; adding a
    constant on a circle keeps lengths, so the Jacobian is one:
    log ratio = log posterior(new) - log posterior(old).
    """
    half_turn(unknowns, laws, values, members[int(rng.random() * len(members))])
    return 0.0


@kernels.register("jump")
class JumpType(KernelType):
    """Turn an object by half the period of its angle: a quarter turn for a box, an eighth for a cube."""

    proposal = jumped

    def applies(self, space: Space, block: Block) -> bool:
        return bool(self.members(space, block))

    def moves(self, space: Space, block: Block) -> Sequence[int]:
        return ()  # half periods alone reach two places

    def members(self, space: Space, block: Block) -> Sequence[int]:
        return [i for i in block.unknowns if space.unknowns[i].period is not None]


@njit(cache=True, nogil=True)
def flipped(rng, unknowns, laws, values, tangents, members, factor, scale):
    """theta -> theta + pi/2 (half its period), length <-> width, of one box chosen at random.

    An involution (twice half a period is none, exchanging twice is nothing) that permutes coordinates of one unit and
    shifts an angle: its Jacobian is one.
    log ratio = log posterior(new) - log posterior(old); on a plane the likelihoods are equal.
    """
    chosen = 3 * int(rng.random() * (len(members) // 3))
    half_turn(unknowns, laws, values, members[chosen])
    length, width = unknowns[OFFSET, members[chosen + 1]], unknowns[OFFSET, members[chosen + 2]]
    values[NEXT, length], values[NEXT, width] = values[NOW, width], values[NOW, length]
    return 0.0


def flips_of(space: Space) -> list[tuple[int, int, int]]:
    """Return (theta, length, width), as unknowns, of every box of which all three are unknown."""
    index = {unknown.address: i for i, unknown in enumerate(space.unknowns)}
    found = []
    for address, theta in index.items():
        name, _, rest = address.partition(".")
        if rest == "contact.theta" and space.unknowns[theta].period is not None:
            length, width = index.get(f"{name}.length"), index.get(f"{name}.width")
            if length is not None and width is not None:
                found.append((theta, length, width))
    return found


@kernels.register("flip")
class FlipType(KernelType):
    """Turn a box by a quarter and exchange its length and width."""

    per_block = False
    proposal = flipped

    def applies(self, space: Space, block: Block) -> bool:
        return bool(flips_of(space))

    def moves(self, space: Space, block: Block) -> Sequence[int]:
        return ()

    def members(self, space: Space, block: Block) -> Sequence[int]:
        return [unknown for triple in flips_of(space) for unknown in triple]
