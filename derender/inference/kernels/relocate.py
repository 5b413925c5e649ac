"""Relocate: an object is put down anew where warm-up has seen it in the world; its children stay where they are."""

import math

import numpy as np

from derender.inference.kernels.base import KernelType, decide, evaluate_kept, kernels
from derender.inference.space import wrap

DEGREES = 5  # of freedom of each component: heavier tails than an image's posterior
BANDWIDTH = 0.5  # of a component, as a share of the spread of all places
LEAST = 1e-5  # radians and metres, a floor of the spread
UNSEEN = (0.2, 0.02, 0.02)  # spread about a single known place


class Relocate:
    """Propose a place w' = (angle, x, y) on the floor below the object, from a mixture q over the places of an archive.

    The archive was filled in warm-up by all chains and is frozen; q does not look at the present place. Its components
    are t distributions with 5 degrees of freedom and one shape, an angle's tangent beyond half a period being refused,
    which changes all components' constants alike. In the world's coordinates what is seen of one object hardly depends
    on where the others are, as it does in those of its contact, which hang on the parent.

    The contact's numbers phi are another chart of w: per phi the proposal has the density q(w(phi)) |dw / dphi|, where
    the Jacobian is the touching area of (u, v) (Figure 2), or one for metres. The children's contacts are kept as in
    `slide`. With J = |dw / dphi|,
    log ratio = log posterior(new) - log posterior(old) + log q(w) J(old) - log q(w') J(new)
                + sum of log |d phi_c' / d phi_c|.
    """

    def __init__(self, target, block, centres, factor, temperature=1.0):
        self.target, self.block, self.temperature = target, block, temperature
        self.centres, self.factor = centres, factor
        self.period = target.placement_period(block)
        self.name = f"relocate {block.name}"

    def log_proposal(self, place: np.ndarray) -> float:
        """Return log q(place) up to its constant."""
        total = 0.0
        for centre in self.centres:
            tangent = place - centre
            tangent[0] = wrap(tangent[0] + 0.5 * self.period, self.period) - 0.5 * self.period
            white = np.linalg.solve(self.factor, tangent)
            total += (1.0 + float(white @ white) / DEGREES) ** (-0.5 * (DEGREES + len(place)))
        return math.log(total)

    def __call__(self, rng, state):
        centre = self.centres[int(rng.random() * len(self.centres))]
        normal = np.array([rng.standard_normal() for _ in range(len(centre))])
        chi_squared = 0.0
        for _ in range(DEGREES):
            chi_squared += rng.standard_normal() ** 2
        tangent = (self.factor @ normal) * math.sqrt(DEGREES / chi_squared)
        place = centre + tangent
        place[0] = wrap(place[0], self.period)
        moved = self.target.put(state.values, self.block, place) if abs(tangent[0]) <= 0.5 * self.period else None
        if moved is None:
            return decide(rng, state, state._replace(log_prior=-math.inf), 0.0, self.temperature, self.name)
        old, log_area = self.target.placement(state.values, self.block)
        _, new_log_area = self.target.placement(moved, self.block)
        correction = self.log_proposal(old) + log_area - self.log_proposal(place) - new_log_area
        new, log_jacobian = evaluate_kept(self.target, state, moved, self.block)
        return decide(rng, state, new, correction + log_jacobian, self.temperature, self.name)


def proposal_of(target, block, archive: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the centres (K, 3) and the lower factor (3, 3) of a component, from an archive (K, P) of values."""
    centres = target.placements(block, archive)
    if len(centres) < 5:
        return centres, np.diag(UNSEEN[: centres.shape[1]])
    period = target.placement_period(block)
    turn = np.angle(np.mean(np.exp(2j * np.pi * centres[:, 0] / period))) * period / (2 * np.pi)
    steps = centres - np.array([turn, *np.mean(centres[:, 1:], axis=0)])
    steps[:, 0] = (steps[:, 0] + 0.5 * period) % period - 0.5 * period
    covariance = steps.T @ steps / len(steps)
    return centres, BANDWIDTH * np.linalg.cholesky(covariance + LEAST**2 * np.eye(covariance.shape[0]))


@kernels.register("relocate")
class RelocateType(KernelType):
    """Put an object down anew where warm-up has seen it in the world, and leave what stands on it where it is."""

    keeps_children = True
    code = 6

    def applies(self, space, block):
        return block.name in getattr(space, "relocations", ())

    def build(self, target, block, tuning, options):
        centres, factor = proposal_of(target, block, tuning.places)
        return Relocate(target, block, centres, factor, tuning.temperature)
