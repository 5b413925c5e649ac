"""The unknowns of the materials, as coordinates without units in which the posterior is nearly normal."""

import math
from typing import NamedTuple

import numpy as np

from derender.dynamics.engine import Material
from derender.dynamics.prior import QUARTILE, Prior

# Friction and mass ratio are kept within exp(+-5), restitution within what the engine bounces, and climbing off its
# edge.
LOG_LIMIT, MOST_RESTITUTION, EDGE = 5.0, 0.98, 1e-3
# Seconds: a bounce that takes less is taken for one of the least, which no film tells from it, and the engine's steps
# are for no longer ones. The number of coordinates that there are always.
CONTACT_TIMES, ALWAYS = (0.0015, 0.015), 3


class Parameters(NamedTuple):
    """Coordinates of the unknowns: log friction, restitution, log contact time, and the logs of mass ratios.

    Attributes
    ----------
    names : N names of the moving bodies. The first is the one that mass ratios refer to.
    masses : (N,) float64, kg, that densities say; a mass ratio's prior is about their ratio.
    prior : of the numbers; that of mass ratios is of them divided by the ratios of `masses`.
    """

    names: tuple[str, ...]
    masses: np.ndarray
    prior: Prior

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return ALWAYS + max(len(self.names) - 1, 0)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the numbers, as draws are called."""
        return (
            "friction",
            "restitution",
            "contact_time",
            *(f"mass_ratio.{name}.{self.names[0]}" for name in self.names[1:]),
        )

    def material(self, coordinates: np.ndarray) -> Material:
        """Return what the engine is told."""
        ratios = np.exp(np.concatenate([[0.0], coordinates[ALWAYS:]])) if len(self.names) else np.ones(0)
        low, high = self.prior.restitution.support
        restitution, time = np.clip(coordinates[1], low, high), np.clip(math.exp(coordinates[2]), *CONTACT_TIMES)
        return Material(math.exp(coordinates[0]), float(restitution), self.masses * ratios, float(time))

    def inside(self, coordinates: np.ndarray) -> np.ndarray:
        """Return coordinates (size,) moved to where the engine is defined."""
        result = np.clip(coordinates, -LOG_LIMIT, LOG_LIMIT)
        result[2] = coordinates[2]
        low, high = self.prior.restitution.support
        result[1] = np.clip(result[1], max(low, 0.0) + EDGE, min(high, MOST_RESTITUTION) - EDGE)
        return result

    def values(self, coordinates: np.ndarray) -> np.ndarray:
        """Return friction, restitution, contact time and mass ratios (..., size) of coordinates (..., size)."""
        result = np.exp(coordinates)
        result[..., 1] = coordinates[..., 1]
        result[..., ALWAYS:] *= self.masses[1:] / self.masses[:1]
        return result

    def log_prior(self, coordinates: np.ndarray) -> float:
        """Return the log density of coordinates (size,), the Jacobian of the logarithms included."""
        total = self.prior.friction.log_density(math.exp(coordinates[0])) + coordinates[0]
        total += self.prior.restitution.log_density(coordinates[1])
        total += self.prior.contact_time.log_density(math.exp(coordinates[2])) + coordinates[2]
        for ratio in coordinates[ALWAYS:]:
            total += self.prior.mass_ratio.log_density(math.exp(ratio)) + ratio
        return total

    def sample_prior(self, rng: np.random.Generator) -> np.ndarray:
        """Return coordinates (size,) drawn from the prior."""
        ratios = [math.log(self.prior.mass_ratio.sample(rng)) for _ in range(self.size - ALWAYS)]
        friction, time = (math.log(each.sample(rng)) for each in (self.prior.friction, self.prior.contact_time))
        return np.array([friction, self.prior.restitution.sample(rng), time, *ratios])

    def middle(self) -> np.ndarray:
        """Return the prior's medians (size,) in these coordinates."""
        return self._quantiles(0.5)

    def spread(self) -> np.ndarray:
        """Return the prior's standard deviations (size,) in these coordinates, from its quartiles."""
        return (self._quantiles(0.75) - self._quantiles(0.25)) / (2 * QUARTILE)

    def _quantiles(self, share: float) -> np.ndarray:
        friction, restitution, time, ratio = (prior.quantile(share) for prior in self.prior[:4])
        return np.array([math.log(friction), restitution, math.log(time), *[math.log(ratio)] * (self.size - ALWAYS)])
