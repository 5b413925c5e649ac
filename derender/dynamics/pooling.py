"""What several films of the same thing tell together: a population of materials, each film's with its own error."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from derender.dynamics.inference import Draws


class Population(NamedTuple):
    """Normal distribution of coordinates and scales' logarithms over films.

    Attributes
    ----------
    mean : (P + 3,). error : (P + 3, P + 3), covariance of that mean. spread : (P + 3,), variances between films.
    """

    mean: np.ndarray
    error: np.ndarray
    spread: np.ndarray

    def sample(self, rng: np.random.Generator) -> np.ndarray:
        """Return what a new film may have, (P + 3,)."""
        return rng.multivariate_normal(self.mean, self.error + np.diag(self.spread))


def pool(found: Sequence[Draws]) -> Population:
    """Return the population behind several films' draws: random effects by moments (DerSimonian and Laird 1986)."""
    moments = [_moments(draws) for draws in found]
    means, variances = (np.array(part) for part in zip(*moments, strict=True))
    weights = 1 / variances
    centre = np.sum(weights * means, axis=0) / np.sum(weights, axis=0)
    scatter = np.sum(weights * (means - centre) ** 2, axis=0)
    freedom = np.sum(weights, axis=0) - np.sum(weights**2, axis=0) / np.sum(weights, axis=0)
    spread = np.maximum((scatter - (len(means) - 1)) / freedom, 0.0)
    weights = 1 / (variances + spread)
    centre = np.sum(weights * means, axis=0) / np.sum(weights, axis=0)
    return Population(centre, np.diag(1 / np.sum(weights, axis=0)), spread)


def _moments(draws: Draws) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variances (P + 3,) of one film's coordinates and scales' logarithms."""
    points, weights = np.hstack([draws.coordinates, draws.logarithms]), np.exp(draws.log_weights)
    mean = weights @ points
    return mean, weights @ (points - mean) ** 2 + 1e-8
