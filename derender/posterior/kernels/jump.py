"""Jumps of an angle by half its period, where a box nearly looks the same, alone or with length and width exchanged."""

from derender.compilation.cache import njit
from derender.posterior.compiled.layout import NEXT, NOW, OFFSET, PERIOD
from derender.posterior.compiled.prior import wrap
from derender.posterior.kernels.base import KernelType, kernels


@njit(cache=True, nogil=True)
def half_turn(unknowns, laws, values, i):
    """Turn angle i of the proposed values by half its period."""
    start, period = unknowns[OFFSET, i], laws[i, PERIOD]
    values[NEXT, start] = wrap(values[NOW, start] + 0.5 * period, period)


@njit(cache=True, nogil=True)
def jumped(rng, unknowns, laws, values, tangents, members, factor, scale, spread, mean):
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

    def applies(self, space, block):
        return bool(self.members(space, block))

    def moves(self, space, block):
        return ()  # half periods alone reach two places

    def members(self, space, block):
        return [i for i in block.unknowns if space.unknowns[i].period is not None]


@njit(cache=True, nogil=True)
def flipped(rng, unknowns, laws, values, tangents, members, factor, scale, spread, mean):
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


def flips_of(space) -> list[tuple[int, int, int]]:
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

    def applies(self, space, block):
        return bool(flips_of(space))

    def moves(self, space, block):
        return ()

    def members(self, space, block):
        return [unknown for triple in flips_of(space) for unknown in triple]
