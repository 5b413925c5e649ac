"""The unknown numbers of a film: what is believed of them before it, from YAML, and coordinates of the materials.

In the coordinates, which are without units, the posterior is nearly normal.
"""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from derender.dynamics.engine import Material
from derender.registry import Parameter
from derender.scene.codec.yaml_tree import Section, parse_yaml, read_yaml
from derender.scene.distributions import Distribution
from derender.scene.friction import MEDIAN, SPREAD
from derender.scene.priors.objects import check_range
from derender.scene.priors.reading import read_value

# Restitution may be any, a bounce takes one millisecond (wood)
# to ten (rubber), and densities differ by a factor of three either way.
# Errors: of an impact, as a share of its change of velocity; of resting and sliding contacts between two frames, as a
# share of gravity's; and by how much the poses' stated errors are to be multiplied (centres of balls by .4 on made
# films, turns of boxes by more than one). The first two are as wide as from films that an engine made, which err
# little, to real tosses, which err some ten times as much: a factor of e either way is one standard deviation.
DEFAULT = f"""
dynamics:
  friction: {{log-normal: [{MEDIAN}, {SPREAD}]}}
  restitution: {{uniform: [0, 0.95]}}
  contact_time: {{log-normal: [0.003, 0.7]}}
  mass_ratio: {{log-normal: [1, 1.1]}}  # over that of the volumes
  impact_error: {{log-normal: [0.06, 1]}}
  steady_error: {{log-normal: [0.015, 1]}}
  tracking_error: {{log-normal: [0.6, 0.7]}}  # of centres
  turning_error: {{log-normal: [0.6, 0.7]}}
"""
# Friction and mass ratio are kept within exp(+-5), restitution within what the engine bounces, and climbing off its
# edge.
LOG_LIMIT, MOST_RESTITUTION, EDGE = 5.0, 0.98, 1e-3
# Seconds: a bounce that takes less is taken for one of the least, which no film tells from it, and the engine's steps
# are for no longer ones. The number of coordinates that there are always.
CONTACT_TIMES, ALWAYS = (0.0015, 0.015), 3
QUARTILE = 0.6745  # of the standard normal distribution


class Prior(NamedTuple):
    """Independent distributions over the numbers of a film's dynamics; see DEFAULT for what they mean."""

    friction: Distribution
    restitution: Distribution
    contact_time: Distribution
    mass_ratio: Distribution
    impact_error: Distribution
    steady_error: Distribution
    tracking_error: Distribution
    turning_error: Distribution

    @property
    def errors(self) -> tuple[Distribution, ...]:
        """The last four."""
        return self[4:]

    def log_scales(self) -> tuple[np.ndarray, np.ndarray]:
        """Return medians (4,) and spreads (4,) of the errors' logarithms, the spreads from their quartiles."""
        low, middle, high = (np.log([error.quantile(p) for error in self.errors]) for p in (0.25, 0.5, 0.75))
        return middle, (high - low) / (2 * QUARTILE)

    def log_density_of_scales(self, logarithms: np.ndarray) -> float:
        """Return the log density of the errors' logarithms (4,), the Jacobian included."""
        pairs = zip(self.errors, logarithms, strict=True)
        return sum(error.log_density(float(np.exp(each))) + float(each) for error, each in pairs)


class Parameters(NamedTuple):
    """Coordinates of the unknowns: log friction, restitution, log contact time, and the logs of mass ratios."""

    names: tuple[str, ...]  # N names of the moving bodies. The first is the one that mass ratios refer to.
    masses: np.ndarray  # (N,) float64, kg, that densities say; a mass ratio's prior is about their ratio
    prior: Prior  # of the numbers; that of mass ratios is of them divided by the ratios of `masses`

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


def read_dynamics_prior(path: str | Path | None = None) -> Prior:
    """Return the prior of a YAML file's section `dynamics`; what it leaves out, and without a file all, is DEFAULT.

    Raises DerenderError : whatever is wrong with the file, its line and address named.
    """
    found = _read(parse_yaml(DEFAULT, "the default prior"))
    if path is not None:
        found.update(_read(read_yaml(path).allow("derender", "dynamics")))
    return Prior(**found)


def _read(top: Section) -> dict[str, Distribution]:
    found: dict[str, Distribution] = {}
    for key, node in top["dynamics"].section().allow(*Prior._fields).items():
        value = read_value(node)
        if not isinstance(value, Distribution):
            raise node.fault("a fixed number leaves nothing to infer", "write {log-normal: [0.3, 0.01]} or so")
        check_range(value, Parameter(key, "", 0.0, 0.99 if key == "restitution" else np.inf), node)
        found[key] = value
    return found
