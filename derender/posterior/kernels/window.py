"""Enumerative steps: weigh a row of equally spaced places through the present one and choose among them."""

from derender.compilation.cache import njit
from derender.posterior.compiled.layout import DIRECTION
from derender.posterior.compiled.prior import directions
from derender.posterior.kernels.base import ROW, KernelType, kernels

FINEST = 1e-4  # of the prior's spread: the shortest spacing


@njit(cache=True, nogil=True)
def row_direction(rng, unknowns, laws, values, tangents, members, factor, scale, spread, mean):
    """Gibbs draw among `count` places on a line through the state, coarse to fine; this draws the line's direction.

    A spacing is drawn log-uniformly between FINEST and `reach` times the prior's spread, a direction at random (each
    coordinate takes part with probability 1/2), and the place j of the present state in the row uniformly. The row is
    values + (k - j) * spacing * direction, k = 0 .. count - 1; the next state is its k-th place with probability
    proportional to the posterior there. Spacing and direction do not depend on the state. From the chosen place k the
    same row arises with j' = k, which has the same probability 1 / count, so with w the posterior,

        w(j) (1 / count) w(k) / sum(w)  =  w(k) (1 / count) w(j) / sum(w)

    is detailed balance: there is nothing left to accept, log ratio = 0. (On circles and lines only: directions in the
    group of rotations do not commute, there the row moves along one axis through the state, which it leaves in place.)
    """
    tangent, takes_part = tangents[0], tangents[1]
    size = directions(unknowns, members)
    direction = 0
    for i in members:
        for way in range(unknowns[DIRECTION, i], unknowns[DIRECTION, i + 1]):
            tangent[direction] = rng.standard_normal() * spread[way]
            direction += 1
    used = 0
    for i in range(size):
        takes_part[i] = 1.0 if rng.random() < 0.5 else 0.0
        used += takes_part[i] == 1.0
    for i in range(size):
        tangent[i] *= takes_part[i] if used else 1.0
    return 0.0


@kernels.register("window")
class WindowType(KernelType):
    """Choose among a row of places by their posterior, spaced from the prior's width to a ten-thousandth of it."""

    options = {"count": 8, "reach": 0.5}
    form = ROW
    proposal = row_direction


@kernels.register("slide-window")
class SlideWindowType(WindowType):
    """Choose among a row of places of an object by their posterior, and leave what stands on it where it is.

    The row of `window`, each place with the children's contacts that keep their poses, as in `slide`. With T_s the map
    that moves the edge by s and keeps the children, T_s T_t = T_(s + t): the row is a piece of the orbit of a group.
    Choosing its k-th place with probability proportional to posterior(T_s x) |dT_s / dx|, where s = (k - j) spacing,
    is a Gibbs draw along the orbit: from the chosen place the same row arises with all its weights divided by the same
    Jacobian. Nothing is left to accept, log ratio = 0.
    """

    keeps_children = True

    def applies(self, space, block):
        return block.name in space.slides
