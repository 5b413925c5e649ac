"""Distributions over finitely many names or whole numbers: categorical ones; uniform, Poisson and geometric counts."""

import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from itertools import accumulate
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.registry import Registry

ROW = 4  # floats in a row

WITHIN = 1e-6  # of a range, that a number which lies outside is put within it

distributions: Registry[Any] = Registry("distribution", "derender.distributions", make=lambda family: family)


def bisected(cdf: Callable[[float], float], probability: float, low: float, high: float) -> float:
    """Return where between low and high a distribution function reaches a probability: slow, sure to the last bit."""
    middle = 0.5 * (low + high)
    while low < middle < high:
        low, high = (middle, high) if cdf(middle) < probability else (low, middle)
        middle = 0.5 * (low + high)
    return middle


def within(support: tuple[float, float], value: float) -> tuple[float, float]:
    """Return the number nearest to a value that a distribution with this support can have, and how far it is off."""
    low, high = support
    margin = WITHIN * (high - low) if math.isfinite(high - low) else WITHIN
    inside = min(max(value, low + margin), high - margin)
    return inside, abs(value - inside)


class Distribution:
    """A distribution over one number (or one rotation): a registered family, such as "normal", with its parameters.

    Immutable. A family is a subclass, registered as `@distributions.register("normal")`.

    parameters : tuple of float. row : (4,) float, what `density` and `draw` read.

    Raises DerenderError : parameters that the family cannot have.
    """

    name: str = ""
    names: tuple[str, ...] = ()  # of the parameters, in the order in which YAML lists them
    defaults: tuple[float, ...] = ()  # values of the last parameters, which may then be left out
    dimensionless: tuple[str, ...] = ()  # parameters without a unit; all others have that of the number itself
    positive: tuple[str, ...] = ()  # parameters that have to be above 0
    lowest: float = -math.inf  # the least value, where support is from there upwards
    compiled: bool = False  # whether density and draw can be compiled
    size: int = 1  # how many numbers a value has (1; a rotation's quaternion: 4)
    discrete: bool = False  # the density is with respect to the counting measure

    density: Callable[[Any, Sequence[float]], float]  # log density of x under a row
    draw: Callable[[np.random.Generator, Sequence[float]], Any]  # one draw under a row

    def __init__(self, *parameters: float) -> None:
        missing = len(self.names) - len(parameters)
        remedy = f"it takes [{', '.join(self.names)}]" if self.names else "it takes nothing"
        if missing < 0 or missing > len(self.defaults):
            raise DerenderError(f"{self.name} got {len(parameters)} parameters", remedy=remedy)
        values = (*parameters, *self.defaults[len(self.defaults) - missing :])
        self.parameters = tuple(float(value) for value in values)
        for name, value in zip(self.names, self.parameters, strict=True):
            if not math.isfinite(value):
                raise DerenderError(f"{self.name}: {name} is {value}", remedy="give a finite number")
            if name in self.positive and value <= 0:
                raise DerenderError(f"{self.name}: {name} {value:g} is not positive", remedy=remedy)
        fault = self.fault()
        if fault:
            raise DerenderError(f"{self.name}: {fault}", remedy=remedy)
        self.row = self._row()

    def fault(self) -> str | None:
        """Say what is wrong with the parameters, or None."""
        return None

    def _row(self) -> tuple[float, ...]:
        """Return the row of four floats that `density` and `draw` read: here the parameters, padded with zeros."""
        return self.parameters + (0.0,) * (ROW - len(self.parameters))

    def sample(self, rng: np.random.Generator) -> Any:
        """Return one draw: a float (int where discrete; (4,) floats for a rotation)."""
        return self.draw(rng, self.row)

    def log_density(self, x: Any) -> float:
        """Return the log density at x; -inf outside the support."""
        return self.density(x, self.row)

    @property
    def support(self) -> tuple[float, float]:
        """The least and the greatest value (possibly infinite)."""
        return self.lowest, math.inf

    def cdf(self, x: float) -> float:
        """Return the probability of a value of at most x."""
        raise NotImplementedError

    def quantile(self, probability: float) -> float:
        """Return the x at which the cdf reaches `probability`."""
        raise NotImplementedError

    def mean(self) -> float:
        """Return the mean (on a circle: the mean direction): of many families the first parameter."""
        return self.parameters[0]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Distribution) and (self.name, self.parameters) == (other.name, other.parameters)

    def __hash__(self) -> int:
        return hash((self.name, self.parameters))

    def __repr__(self) -> str:
        return f"{{{self.name}: [{', '.join(map(repr, self.parameters))}]}}"


@distributions.register("categorical")
class Categorical:
    """Choices with weights: {choice: weight, ...}, or a list of equally likely ones; weight zero is no choice.

    probabilities : dict of choice to probability, in the order given.
    """

    name = "categorical"
    names: tuple[str, ...] = ()
    size = 1
    discrete = True

    def __init__(self, weights: Mapping[Any, float] | Iterable[Any]) -> None:
        if not isinstance(weights, Mapping):
            weights = dict.fromkeys(weights, 1.0)
        if not weights:
            raise DerenderError("categorical has no choices", remedy="give {choice: weight, ...}")
        for choice, weight in weights.items():
            if not (math.isfinite(weight) and weight >= 0):
                raise DerenderError(f"categorical: the weight {weight} of {choice!r} is not a number from 0 up")
        total = math.fsum(weights.values())
        if not (total > 0 and math.isfinite(total)):
            raise DerenderError("categorical: no choice has a weight above 0")
        self.probabilities = {choice: weight / total for choice, weight in weights.items() if weight > 0}
        self._log = {choice: math.log(p) if p > 0 else -math.inf for choice, p in self.probabilities.items()}
        self.choices = tuple(self.probabilities)
        self._cumulative = tuple(accumulate(self.probabilities.values()))

    def sample(self, rng: np.random.Generator) -> Any:
        """Return one choice."""
        threshold = rng.random() * self._cumulative[-1]
        for choice, reached in zip(self.choices, self._cumulative, strict=True):
            if threshold < reached:
                return choice
        return self.choices[-1]

    def log_density(self, choice: Hashable) -> float:
        """Return the log probability of a choice; -inf for what is none."""
        return self._log.get(choice, -math.inf)

    def mean(self) -> float:
        """Return the mean of choices that are numbers."""
        return math.fsum(choice * p for choice, p in self.probabilities.items())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Categorical) and self.probabilities == other.probabilities

    def __hash__(self) -> int:
        return hash(tuple(self.probabilities.items()))

    def __repr__(self) -> str:
        return "{categorical: {" + ", ".join(f"{c}: {p!r}" for c, p in self.probabilities.items()) + "}}"


@distributions.register("uniform-integer")
class UniformInteger(Distribution):
    """lower, lower + 1, ..., upper."""

    names = ("lower", "upper")
    discrete = True

    @staticmethod
    def density(x: float, row: Any) -> float:
        if x < row[0] or x > row[1] or x != math.floor(x):
            return -math.inf
        return -math.log(row[1] - row[0] + 1.0)

    @staticmethod
    def draw(rng: np.random.Generator, row: Any) -> int:
        return int(row[0]) + int((row[1] - row[0] + 1.0) * rng.random())

    def fault(self) -> str | None:
        lower, upper = self.parameters
        if lower != math.floor(lower) or upper != math.floor(upper):
            return "lower and upper have to be whole numbers"
        return None if lower <= upper <= lower + 1e6 else f"it is not true that {lower:g} <= upper <= lower + 1e6"

    @property
    def support(self) -> tuple[float, float]:
        return self.parameters[0], self.parameters[1]

    def mean(self) -> float:
        return 0.5 * (self.parameters[0] + self.parameters[1])


@distributions.register("poisson")
class Poisson(Distribution):
    """0, 1, 2, ... with a mean."""

    lowest = 0.0
    names = ("mean",)
    discrete = True

    @staticmethod
    def density(x: float, row: Any) -> float:
        if x < 0 or x != math.floor(x):
            return -math.inf
        return x * math.log(row[0]) - row[0] - math.lgamma(x + 1.0)

    @staticmethod
    def draw(rng: np.random.Generator, row: Any) -> int:
        return int(rng.poisson(row[0]))

    def fault(self) -> str | None:
        return None if 0 < self.parameters[0] <= 1e4 else f"mean {self.parameters[0]:g} is not in (0, 1e4]"


@distributions.register("geometric")
class Geometric(Distribution):
    """0, 1, 2, ...: after each one, another follows with probability `more`."""

    lowest = 0.0
    names = ("more",)
    discrete = True

    @staticmethod
    def density(x: float, row: Any) -> float:
        if x < 0 or x != math.floor(x):
            return -math.inf
        return x * math.log(row[0]) + math.log1p(-row[0])

    @staticmethod
    def draw(rng: np.random.Generator, row: Any) -> int:
        return int(rng.geometric(1.0 - row[0])) - 1

    def fault(self) -> str | None:
        return None if 0 < self.parameters[0] < 1 else f"more {self.parameters[0]:g} is not between 0 and 1"

    def mean(self) -> float:
        return self.parameters[0] / (1.0 - self.parameters[0])
