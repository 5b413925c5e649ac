"""Relocate: an object is put down anew where warm-up has seen it in the world; its children stay where they are."""

import math

import numpy as np

from derender.inference.kernels.base import KernelType, decide, evaluate_kept, kernels
from derender.inference.kernels.place_mixture import DEGREES, PlaceMixture, fitted
from derender.inference.space import wrap


class Relocate:
    """Propose a place w' = (angle, x, y) on the floor below the object, from a mixture q over the places of an archive.

    The archive was filled in warm-up by all chains and is frozen; q (`place_mixture`) does not look at the present
    place. A tangent beyond half an angle's period is refused: that is a proposal to stay, and q elsewhere is what it
    was. In the world's coordinates what is seen of one object hardly depends on where the others are, as it does in
    those of its contact, which hang on the parent.

    The contact's numbers phi are another chart of w: per phi the proposal has the density q(w(phi)) |dw / dphi|, where
    the Jacobian is the touching area of (u, v) (Figure 2), or one for metres. The children's contacts are kept as in
    `slide`. With J = |dw / dphi|,
    log ratio = log posterior(new) - log posterior(old) + log q(w) J(old) - log q(w') J(new)
                + sum of log |d phi_c' / d phi_c|.
    """

    def __init__(self, target, block, places: PlaceMixture, temperature=1.0):
        self.target, self.block, self.places, self.temperature = target, block, places, temperature
        self.name = f"relocate {block.name}"

    def log_proposal(self, place: np.ndarray) -> float:
        """Return log q(place) up to its constant."""
        return math.log(self.places.density(place))

    def __call__(self, rng, state):
        period = self.places.period
        component = int(rng.random() * len(self.places.centres))
        centre = self.places.centres[component]
        normal = np.array([rng.standard_normal() for _ in range(len(centre))])
        chi_squared = 0.0
        for _ in range(DEGREES):
            chi_squared += rng.standard_normal() ** 2
        tangent = (self.places.factors[component] @ normal) * math.sqrt(DEGREES / chi_squared)
        place = centre + tangent
        place[0] = wrap(place[0], period)
        moved = self.target.put(state.values, self.block, place) if abs(tangent[0]) <= 0.5 * period else None
        if moved is None:
            return decide(rng, state, state._replace(log_prior=-math.inf), 0.0, self.temperature, self.name)
        old, log_area = self.target.placement(state.values, self.block)
        _, new_log_area = self.target.placement(moved, self.block)
        correction = self.log_proposal(old) + log_area - self.log_proposal(place) - new_log_area
        new, log_jacobian = evaluate_kept(self.target, state, moved, self.block)
        return decide(rng, state, new, correction + log_jacobian, self.temperature, self.name)


def places_of(target, block, archive: np.ndarray) -> PlaceMixture:
    """Return the mixture over an object's places in an archive (K, P) of values."""
    return fitted(target.placements(block, archive), target.placement_period(block))


@kernels.register("relocate")
class RelocateType(KernelType):
    """Put an object down anew where warm-up has seen it in the world, and leave what stands on it where it is."""

    keeps_children = True
    code = 6

    def applies(self, space, block):
        return block.name in getattr(space, "relocations", ())

    def build(self, target, block, tuning, options):
        return Relocate(target, block, places_of(target, block, tuning.places), tuning.temperature)
