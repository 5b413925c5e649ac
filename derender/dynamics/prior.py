"""What is believed of materials, and of the errors of engine and tracking, before a film: read from YAML."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from derender.registry import Parameter
from derender.scene.codec.yaml_tree import Section, parse_yaml, read_yaml
from derender.scene.distributions import Distribution
from derender.scene.priors.reading import read_value
from derender.scene.priors.values import check_range

# Friction of dry household things on table tops is .2-.8, restitution may be any, a bounce takes one millisecond (wood)
# to ten (rubber), and densities differ by a factor of three either way.
# Errors: of an impact, as a share of its change of velocity; of resting and sliding contacts between two frames, as a
# share of gravity's; and by how much the poses' stated errors are to be multiplied (centres of balls by .4 on made
# films, turns of boxes by more than one). The first two are as wide as from films that an engine made, which err
# little, to real tosses, which err some ten times as much: a factor of e either way is one standard deviation.
DEFAULT = """
dynamics:
  friction: {log-normal: [0.35, 0.8]}
  restitution: {uniform: [0, 0.95]}
  contact_time: {log-normal: [0.003, 0.7]}
  mass_ratio: {log-normal: [1, 1.1]}  # over that of the volumes
  impact_error: {log-normal: [0.06, 1]}
  steady_error: {log-normal: [0.015, 1]}
  tracking_error: {log-normal: [0.6, 0.7]}  # of centres
  turning_error: {log-normal: [0.6, 0.7]}
"""
NUMBERS = {
    name: Parameter(name, "", 0.0, 0.99 if name == "restitution" else np.inf)
    for name in (
        "friction",
        "restitution",
        "contact_time",
        "mass_ratio",
        "impact_error",
        "steady_error",
        "tracking_error",
        "turning_error",
    )
}
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


def read_dynamics_prior(path: str | Path | None = None) -> Prior:
    """Return the prior of a YAML file's section `dynamics`; what it leaves out, and without a file all, is DEFAULT.

    Raises
    ------
    DerenderError : whatever is wrong with the file, its line and address named.
    """
    found = _read(parse_yaml(DEFAULT, "the default prior"))
    if path is not None:
        found.update(_read(read_yaml(path).allow("derender", "dynamics")))
    return Prior(**found)


def _read(top: Section) -> dict[str, Distribution]:
    found: dict[str, Distribution] = {}
    for key, node in top["dynamics"].section().allow(*NUMBERS).items():
        value = read_value(node)
        if not isinstance(value, Distribution):
            raise node.fault("a fixed number leaves nothing to infer", "write {log-normal: [0.3, 0.01]} or so")
        check_range(value, NUMBERS[key], node)
        found[key] = value
    return found
