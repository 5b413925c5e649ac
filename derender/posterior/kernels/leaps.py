"""Leaps: to places that do not depend on the present one, or by half the period of an angle.

Independent ones come from the prior. Where a box nearly looks the same when its angle jumps by half a period, it does
so alone or with length and width exchanged.
"""

from collections.abc import Sequence

from derender.compilation.cache import njit
from derender.posterior.compiled.layout import NEXT, NOW, OFFSET, PERIOD
from derender.posterior.compiled.prior import log_prior, resample, wrap
from derender.posterior.kernels.base import KernelType, kernels
from derender.posterior.space import Block, Space


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
