"""Jump: an angle goes on by half its period, where a box nearly looks the same."""

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
