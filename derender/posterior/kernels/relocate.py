"""Relocate: an object is put down anew where warm-up has seen it in the world; its children stay where they are."""

import math
from collections.abc import Mapping

import numpy as np

from derender.posterior.kernels.base import KernelType, decide, evaluate, kernels
from derender.posterior.kernels.place_mixture import DEGREES, PlaceMixture, fitted


class Relocate:
    """Propose a place w' = (angle, x, y) on the floor below the object, from a mixture q over the places of an archive.

    The archive was filled in warm-up by all chains and is frozen; q (`place_mixture`) does not look at the present
    place. A tangent beyond half an angle's period is refused: that is a proposal to stay, and q elsewhere is what it
    was. In the world's coordinates what is seen of one object hardly depends on where the others are, as it does in
    those of its contact, which hang on the parent.

    The contact's numbers phi are another chart of w: per phi the proposal has the density q(w(phi)) |dw / dphi|, where
    the Jacobian is the touching area of (u, v) (Figure 2), or one for metres. The children's contacts are kept as in
    `slide`. With J = |dw / dphi|,
    log ratio = log posterior(new) - log posterior(old) + log q(w) - log q(w') + log J(old) - log J(new)
                + sum of log |d phi_c' / d phi_c|.
    The target puts the objects there (`put`) and knows the last three terms; where one would lose its contact there is
    no density, and the step is refused (as is the way back from there). Several objects are put down by one w of all.
    """

    def __init__(self, target, name: str, objects: tuple[str, ...], places: PlaceMixture, temperature=1.0):
        self.target, self.objects, self.places, self.temperature = target, objects, places, temperature
        self.name = name

    def log_proposal(self, place: np.ndarray) -> float:
        """Return log q(place) up to its constant."""
        return math.log(self.places.density(place))

    def __call__(self, rng, state):
        component = int(rng.random() * len(self.places.centres))
        centre = self.places.centres[component]
        normal = np.array([rng.standard_normal() for _ in range(len(centre))])
        chi_squared = 0.0
        for _ in range(DEGREES):
            chi_squared += rng.standard_normal() ** 2
        tangent = (self.places.factors[component] @ normal) * math.sqrt(DEGREES / chi_squared)
        place = centre + tangent
        put = None
        if not self.places.too_far(tangent):
            place = self.places.wrapped(place)
            ends = np.cumsum([len(self.target.placement_periods(name)) for name in self.objects])[:-1]
            put = self.target.put(state.values, dict(zip(self.objects, np.split(place, ends), strict=True)))
        if put is None:
            return decide(rng, state, state._replace(log_prior=-math.inf), 0.0, self.temperature, self.name)
        moved, log_jacobian = put
        old = np.concatenate([self.target.placement(state.values, name) for name in self.objects])
        correction = self.log_proposal(old) - self.log_proposal(place) + log_jacobian
        return decide(rng, state, evaluate(self.target, moved), correction, self.temperature, self.name)


def mixture_of(target, objects: tuple[str, ...], places: Mapping[str, np.ndarray]) -> PlaceMixture:
    """Return the mixture over the places of one or several objects, given (K, d) places of each by name."""
    periods = [period for name in objects for period in target.placement_periods(name)]
    return fitted(np.concatenate([places[name] for name in objects], axis=1), tuple(periods))


@kernels.register("relocate")
class RelocateType(KernelType):
    """Put an object down anew where warm-up has seen it in the world, and leave what stands on it where it is."""

    keeps_children = True
    code = 6

    def applies(self, space, block):
        return block.name in space.relocations

    def build(self, target, block, tuning, options):
        places = {name: target.placements(name, tuning.places) for name in block.objects}
        found = mixture_of(target, block.objects, places)
        return Relocate(target, f"{self.name} {block.name}", block.objects, found, tuning.temperature)
