"""Slide-window: weigh a row of places of one object, its children staying where they are in the world."""

from derender.posterior.kernels.base import KernelType, evaluate_kept, kernels
from derender.posterior.kernels.window import Window


class SlideWindow(Window):
    """The row of `window`, each place with the children's contacts that keep their poses, as in `slide`.

    With T_s the map that moves the edge by s and keeps the children, T_s T_t = T_(s + t): the row is a piece of the
    orbit of a group. Choosing its k-th place with probability proportional to posterior(T_s x) |dT_s / dx|, where
    s = (k - j) spacing, is a Gibbs draw along the orbit: from the chosen place the same row arises with all its
    weights divided by the same Jacobian. Nothing is left to accept, log ratio = 0.
    """

    def place(self, state, tangent):
        moved = self.target.space.move(state.values, self.block, tangent)
        return evaluate_kept(self.target, state, moved, self.block)


@kernels.register("slide-window")
class SlideWindowType(KernelType):
    """Choose among a row of places of an object by their posterior, and leave what stands on it where it is."""

    options = {"count": 8, "reach": 0.5}
    keeps_children = True
    code = 3

    def applies(self, space, block):
        return block.name in space.slides

    def build(self, target, block, tuning, options):
        from derender.posterior.kernels.drift import directions_of

        scales = target.space.scales[directions_of(target.space, block)]
        count, reach = int(options["count"]), options["reach"]
        return SlideWindow(target, block, scales, count, reach, tuning.temperature, "slide-window")
