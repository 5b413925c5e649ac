"""What a probability distribution over one number is: a registered type and, with its parameters, a distribution.

`density` and `draw` of a built-in type are plain scalar functions of a *row*: four floats that hold the parameters (and
a constant worth computing once). The compiled prior (posterior/compiled/prior.py) hands the same functions to numba.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.registry import Registry

ROW = 4  # floats in a row

distributions: Registry["DistributionType"] = Registry("distribution", "derender.distributions")


def bisected(cdf: Callable[[float], float], probability: float, low: float, high: float) -> float:
    """Return where between low and high a distribution function reaches a probability: slow, sure to the last bit."""
    middle = 0.5 * (low + high)
    while low < middle < high:
        low, high = (middle, high) if cdf(middle) < probability else (low, middle)
        middle = 0.5 * (low + high)
    return middle


class DistributionType:
    """A family of distributions, such as "normal"; calling it with parameters gives a `Distribution`.

    Attributes
    ----------
    parameters : names of the parameters, in the order in which YAML lists them.
    defaults : values of the last parameters, which may then be left out.
    dimensionless : parameters without a unit; all others have that of the number itself.
    lowest : the least value, where support is from there upwards.
    compiled : whether density and draw can be compiled.
    size : how many numbers a value has (1; a rotation's quaternion: 4).
    discrete : the density is with respect to the counting measure.
    """

    name: str = ""
    parameters: tuple[str, ...] = ()
    defaults: tuple[float, ...] = ()
    dimensionless: tuple[str, ...] = ()
    lowest: float = -math.inf
    compiled: bool = False
    size: int = 1
    discrete: bool = False

    density: Callable[[float, Sequence[float]], float]  # log density of x under a row
    draw: Callable[[np.random.Generator, Sequence[float]], float]  # one draw under a row

    def __call__(self, *parameters: float) -> "Distribution":
        missing = len(self.parameters) - len(parameters)
        if missing < 0 or missing > len(self.defaults):
            wanted = ", ".join(self.parameters) or "nothing"
            raise DerenderError(f"{self.name} got {len(parameters)} parameters", remedy=f"it takes [{wanted}]")
        if missing:
            parameters += self.defaults[len(self.defaults) - missing :]
        values = tuple(float(value) for value in parameters)
        for name, value in zip(self.parameters, values, strict=True):
            if not math.isfinite(value):
                raise DerenderError(f"{self.name}: {name} is {value}", remedy="give a finite number")
        fault = self.fault(values)
        if fault:
            raise DerenderError(f"{self.name}: {fault}", remedy=f"it takes [{', '.join(self.parameters)}]")
        return Distribution(self, values)

    def fault(self, parameters: Sequence[float]) -> str | None:
        """Say what is wrong with the parameters, or None."""
        return None

    def row(self, parameters: Sequence[float]) -> tuple[float, ...]:
        """Return the row of four floats that `density` and `draw` read: here the parameters, padded with zeros."""
        return tuple(parameters) + (0.0,) * (ROW - len(parameters))

    def support(self, parameters: Sequence[float]) -> tuple[float, float]:
        """Return the least and the greatest value (possibly infinite)."""
        return self.lowest, math.inf

    def cdf(self, x: float, parameters: Sequence[float]) -> float:
        """Return the probability of a value of at most x."""
        raise NotImplementedError

    def quantile(self, probability: float, parameters: Sequence[float]) -> float:
        """Return the x at which the cdf reaches `probability`."""
        raise NotImplementedError

    def mean(self, parameters: Sequence[float]) -> float:
        """Return the mean (on a circle: the mean direction)."""
        raise NotImplementedError

    def describe(self) -> str:
        """Return how YAML writes it, for `derender types`."""
        return f"{self.name}: [{', '.join(self.parameters)}]"


class Distribution:
    """A distribution over one number (or one rotation): a type with its parameters.  Immutable.

    Attributes
    ----------
    type : DistributionType.
    parameters : tuple of float.
    row : four floats for the compiled twin.
    """

    __slots__ = ("type", "parameters", "row", "_density", "_draw")

    def __init__(self, type: DistributionType, parameters: tuple[float, ...]) -> None:
        self.type = type
        self.parameters = parameters
        self.row = type.row(parameters)
        self._density = type.density
        self._draw = type.draw

    @property
    def name(self) -> str:
        return self.type.name

    @property
    def compiled(self) -> bool:
        return self.type.compiled

    @property
    def discrete(self) -> bool:
        return self.type.discrete

    @property
    def size(self) -> int:
        return self.type.size

    def sample(self, rng: np.random.Generator) -> Any:
        """Return one draw: a float (int where discrete; (4,) floats for a rotation)."""
        return self._draw(rng, self.row)

    def log_density(self, x: Any) -> float:
        """Return the log density at x; -inf outside the support."""
        return self._density(x, self.row)

    @property
    def support(self) -> tuple[float, float]:
        return self.type.support(self.parameters)

    def cdf(self, x: float) -> float:
        return self.type.cdf(x, self.parameters)

    def quantile(self, probability: float) -> float:
        return self.type.quantile(probability, self.parameters)

    def mean(self) -> float:
        return self.type.mean(self.parameters)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Distribution) and (self.name, self.parameters) == (other.name, other.parameters)

    def __hash__(self) -> int:
        return hash((self.name, self.parameters))

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str, tuple[float, ...]]]:
        return _restore, (self.name, self.parameters)

    def __repr__(self) -> str:
        return f"{{{self.name}: [{', '.join(map(repr, self.parameters))}]}}"


def _restore(name: str, parameters: tuple[float, ...]) -> Distribution:
    """Rebuild a pickled distribution (its functions are the registry's)."""
    return Distribution(distributions[name], parameters)
