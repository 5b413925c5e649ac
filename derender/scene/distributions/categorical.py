"""A distribution over finitely many names or whole numbers: faces, parents, shape types, counts."""

import math
from collections.abc import Hashable, Mapping
from typing import Any

from derender.errors import DerenderError
from derender.scene.distributions.base import DistributionType, distributions


class Categorical:
    """Choices with probabilities.  Weights are normalised; a choice of weight zero is no choice.

    Attributes
    ----------
    probabilities : dict of choice to probability, in the order given.
    """

    __slots__ = ("probabilities", "_log", "_choices", "_cumulative")
    name = "categorical"
    compiled = False
    size = 1
    discrete = True

    def __init__(self, weights: Mapping[Any, float]) -> None:
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
        sums = []
        running = 0.0
        for p in self.probabilities.values():
            running += p
            sums.append(running)
        self._cumulative = tuple(sums)

    def sample(self, rng) -> Any:
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

    def __reduce__(self):
        return type(self), (self.probabilities,)

    def __repr__(self) -> str:
        return "{categorical: {" + ", ".join(f"{c}: {p!r}" for c, p in self.probabilities.items()) + "}}"


@distributions.register("categorical")
class CategoricalType(DistributionType):
    """Choices with weights: {choice: weight, ...}, or a list of equally likely ones."""

    discrete = True

    def __call__(self, weights):  # type: ignore[override]
        """Return a `Categorical` from {choice: weight} or a list of equally likely choices."""
        if not isinstance(weights, Mapping):
            weights = dict.fromkeys(weights, 1.0)
        return Categorical(weights)

    def describe(self):
        return "categorical: {choice: weight, ...}"
