"""Flip: a box turns by a quarter and exchanges its length and width, which leaves it where it is."""

from derender.compilation.cache import njit
from derender.posterior.compiled.layout import NEXT, NOW, OFFSET
from derender.posterior.kernels.base import KernelType, kernels
from derender.posterior.kernels.jump import half_turn


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
