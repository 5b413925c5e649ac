"""Distributions over finitely many names or whole numbers: categorical ones; uniform, Poisson and geometric counts."""

import math
from collections.abc import Hashable, Iterable, Mapping
from itertools import accumulate
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.scene.distributions.base import Distribution, distributions


@distributions.register("categorical")
class Categorical:
    """Choices with weights: {choice: weight, ...}, or a list of equally likely ones; weight zero is no choice.

    probabilities : dict of choice to probability, in the order given.
    """

    __slots__ = ("probabilities", "_log", "_choices", "_cumulative")
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
        self._choices = tuple(self.probabilities)
        self._cumulative = tuple(accumulate(self.probabilities.values()))

    def sample(self, rng: np.random.Generator) -> Any:
        """Return one choice."""
        threshold = rng.random() * self._cumulative[-1]
        for choice, reached in zip(self._choices, self._cumulative, strict=True):
            if threshold < reached:
                return choice
        return self._choices[-1]

    def log_density(self, choice: Hashable) -> float:
        """Return the log probability of a choice; -inf for what is none."""
        return self._log.get(choice, -math.inf)

    @property
    def parameters(self) -> tuple:
        return tuple(self.probabilities.items())

    @property
    def choices(self) -> tuple:
        return self._choices

    @property
    def support(self) -> tuple:
        """Return the choices."""
        return self._choices

    def mean(self) -> float:
        """Return the mean of choices that are numbers."""
        return math.fsum(choice * p for choice, p in self.probabilities.items())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Categorical) and self.probabilities == other.probabilities

    def __hash__(self) -> int:
        return hash(self.parameters)

    def __reduce__(self) -> Any:
        return type(self), (self.probabilities,)

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
