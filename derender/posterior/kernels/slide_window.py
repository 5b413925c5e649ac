"""Slide-window: weigh a row of places of one object, its children staying where they are in the world."""

from derender.posterior.kernels.base import kernels
from derender.posterior.kernels.window import WindowType


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
