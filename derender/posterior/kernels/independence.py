"""Leaps: to places that do not depend on the present one, or by half the period of an angle.

Independent ones come from a t distribution fitted in warm-up, or from the prior. Where a box nearly looks the same when
its angle jumps by half a period, it does so alone or with length and width exchanged.
"""

import math
from collections.abc import Sequence

import numpy as np

from derender.compilation.cache import njit
from derender.posterior.compiled.layout import CODE, NEXT, NOW, OFFSET, PERIOD, ROTATION
from derender.posterior.compiled.prior import difference, directions, log_prior, move, resample, shaped, wrap
from derender.posterior.kernels.base import KernelType, Part, Tuning, kernels
from derender.posterior.space import Block, Space

DEGREES = 5  # of freedom of the t distribution: heavier tails than any posterior that it has to cover


@njit(cache=True, nogil=True)
def log_proposal(unknowns, laws, members, tangent, factor, solved):
    """Return the log density of an independence proposal up to a constant; -inf where it cannot propose."""
    size = directions(unknowns, members)
    squared = 0.0
    for i in range(size):
        rest = tangent[i]
        for j in range(i):
            rest -= factor[i * size + j] * solved[j]
        solved[i] = rest / factor[i * size + i]
        squared += solved[i] * solved[i]
    log_density = -0.5 * (DEGREES + size) * math.log1p(squared / DEGREES)
    direction = 0
    for i in members:
        if unknowns[CODE, i] == ROTATION:
            angle = math.sqrt(tangent[direction] ** 2 + tangent[direction + 1] ** 2 + tangent[direction + 2] ** 2)
            if angle > math.pi:
                return -math.inf
            if angle > 1e-9:
                log_density -= 2.0 * math.log(math.sin(0.5 * angle) / (0.5 * angle))
            direction += 3
        else:
            period = laws[i, PERIOD]
            if period != 0.0 and abs(tangent[direction]) > 0.5 * period:
                return -math.inf
            direction += 1
    return log_density


@njit(cache=True, nogil=True)
def independent(rng, unknowns, laws, values, tangents, members, factor, scale, mean):
    """Propose new = mean moved by tangent t, t from a multivariate t distribution with 5 degrees of freedom.

    With r2 = |factor^-1 t|^2 and D directions its density is q(t) = c (1 + r2 / 5)^(-(5 + D) / 2). On a circle a
    tangent beyond half a period would come back on the other side, where `difference` does not find it again: such
    proposals are refused, which only changes c. A rotation's tangent w has density q(w) per volume of w; per Haar
    measure it is q(w) / sinc(|w| / 2)^2, because Haar measure in these coordinates is sinc(|w| / 2)^2 dw up to a
    constant. The proposal does not look at the old state:
    log ratio = log posterior(new) - log posterior(old) + log q(old) - log q(new).
    """
    tangent, solved = tangents[0], tangents[1]
    size = directions(unknowns, members)
    shaped(rng, factor, size, solved, tangent)
    chi_squared = 0.0
    for _ in range(DEGREES):
        chi_squared += rng.standard_normal() ** 2
    for i in range(size):
        tangent[i] *= math.sqrt(DEGREES / chi_squared)
    forward = log_proposal(unknowns, laws, members, tangent, factor, solved)
    if forward == -math.inf:
        return math.nan
    move(unknowns, laws, members, mean, tangent, 1.0, values[NEXT])
    difference(unknowns, laws, members, values[NOW], mean, tangent)
    return log_proposal(unknowns, laws, members, tangent, factor, solved) - forward


@kernels.register("independence")
class IndependenceType(KernelType):
    """Propose everything from a t distribution fitted in warm-up; bold where the posterior is nearly normal."""

    options = {"inflation": 1.1}
    per_block = False
    proposal = independent

    def factor(self, space: Space, part: Part, tuning: Tuning) -> np.ndarray:
        return part.options["inflation"] * np.linalg.cholesky(tuning.covariance)


@njit(cache=True, nogil=True)
def resimulated(rng, unknowns, laws, values, tangents, members, factor, scale, mean):
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
def jumped(rng, unknowns, laws, values, tangents, members, factor, scale, mean):
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
def flipped(rng, unknowns, laws, values, tangents, members, factor, scale, mean):
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
