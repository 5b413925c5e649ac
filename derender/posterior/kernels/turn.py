"""Turn: an object turns to any angle where it stands in the world; its children stay where they are."""

import math

from derender.posterior.kernels.base import KernelType, decide, evaluate, kernels

CLOSEST, FARTHEST = 0.1, 10.0  # shift's length in units of that between two places of the archive


class Turn:
    """Propose a place w' = (angle, x, y) on the floor below the object: any angle, and offsets not far from its own.

    What is half hidden may be seen to fit at two angles, whose offsets are a little apart. The angle is uniform over
    its period; the shift is the difference of two random places of the archive, times a random factor. Neither looks at
    the present place, the angles' density is constant and a shift is as likely as its opposite (the two places change
    roles): q(w' | w) = q(w | w'). With J = |dw / dphi|, as in `relocate`,
    log ratio = log posterior(new) - log posterior(old) + log J(old) - log J(new) + sum of log |d phi_c' / d phi_c|.
    """

    def __init__(self, target, name: str, own: str, centres, periods, temperature=1.0):
        self.target, self.own, self.temperature, self.name = target, own, temperature, name
        self.centres, self.periods = centres, periods  # (K, d) of the archive and (d,), 0 of lengths

    def __call__(self, rng, state):
        first, second = (self.centres[int(rng.random() * len(self.centres))] for _ in range(2))
        factor = FARTHEST * math.exp(rng.random() * math.log(CLOSEST / FARTHEST))
        place = self.target.placement(state.values, self.own) + factor * (first - second)
        for i, period in enumerate(self.periods):
            if period:
                place[i] = rng.random() * period
        put = self.target.put(state.values, {self.own: place})
        if put is None:
            return decide(rng, state, state._replace(log_prior=-math.inf), 0.0, self.temperature, self.name)
        moved, log_jacobian = put
        return decide(rng, state, evaluate(self.target, moved), log_jacobian, self.temperature, self.name)


@kernels.register("turn")
class TurnType(KernelType):
    """Turn an object to any angle about where it stands, and leave what stands on it where it is."""

    keeps_children = True
    code = 7

    def applies(self, space, block):
        return block.name in space.relocations

    def build(self, target, block, tuning, options):
        (own,) = block.objects
        periods = target.placement_periods(own)
        return Turn(target, f"{self.name} {block.name}", own, target.placements(own, tuning.places), periods,
                    tuning.temperature)  # fmt: skip
