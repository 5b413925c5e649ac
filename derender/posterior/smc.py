"""Tempered populations of one structure: they follow prior x likelihood^b from b = 0 to 1 (`sampling/smc.py`).

Particles start from the prior and are moved by a mixture of kernels. It finds the one mode that matters among many, and
estimates the evidence.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from derender.errors import DerenderError
from derender.posterior.kernels.base import Part, Tuning, first_tuning, rescale
from derender.posterior.space import Space
from derender.sampling.smc import anneal, systematic
from derender.scene.priors.terms import MOST_TRIES

if TYPE_CHECKING:
    from derender.posterior.compiled.backend import CompiledBackend
    from derender.posterior.compiled.interpreted import InterpretedBackend

FEW = 20  # draws' worth that must meet the prior's terms before a population is taken from them
ROUNDING = 1e-6  # of log densities
GAIN = 2.0  # change of a log scale for an acceptance rate wrong by 1, at each stage


class Stop(NamedTuple):
    """A population on the way. values : (n, P) float64; tuning : with the temperature and the scales of then."""

    values: np.ndarray
    tuning: Tuning


class Population(NamedTuple):
    """Particles of equal weight from the posterior.

    values : (n, P) float64. densities : (n, 2) float64, log prior and log likelihood.
    log_evidence : estimate of log p(image); unbiased on the natural scale but for the adaptation.
    tuning : scales that the moves ended with.
    temperatures : the exponents gone through.
    stops : the populations at the exponents that were asked for, or just above.
    """

    values: np.ndarray
    densities: np.ndarray
    log_evidence: float
    tuning: Tuning
    temperatures: tuple[float, ...]
    stops: tuple[Stop, ...] = ()


def from_prior(
    rng: np.random.Generator, space: Space, backend: "CompiledBackend | InterpretedBackend", count: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return values (count, P) from the prior with its terms, their densities (count, 2), and the log of what the terms
    leave of the unknowns' own prior: draws of that one weighed by the terms and resampled, more where few count.

    Raises DerenderError where no draw meets the terms.
    """
    values, densities, terms = (np.empty((0, *shape)) for shape in ((space.offsets[-1],), (2,), ()))
    while True:
        drawn = np.array([space.sample(rng) for _ in range(count)])
        found = np.array([backend.evaluate(value) for value in drawn])
        own = np.array([space.log_prior(value) for value in drawn])
        values, densities = np.concatenate([values, drawn]), np.concatenate([densities, found])
        terms = np.concatenate([terms, found[:, 0] - own])
        if np.abs(terms).max() < ROUNDING:
            return values, densities, 0.0
        most = terms.max()
        weights = np.exp(terms - most) if most > -np.inf else np.zeros(len(terms))
        if np.sum(weights) ** 2 >= FEW * np.sum(weights**2) > 0.0 or len(values) >= MOST_TRIES:
            break
    if most == -np.inf:
        remedy = "spread the objects out or ask for fewer"
        raise DerenderError(f"none of {len(values)} scenes drawn meets the constraints", remedy=remedy)
    chosen = systematic(rng, weights, count)[rng.permutation(count)]
    return values[chosen], densities[chosen], float(most + np.log(np.mean(weights)))


def tempered(
    rng: np.random.Generator,
    space: Space,
    backend: "CompiledBackend | InterpretedBackend",
    parts: list[Part],
    particles: int,
    steps: int,
    drawn: int | None = None,
    stops: Sequence[float] = (),
    share: float = 0.5,
) -> Population:
    """Run the sampler.

    backend : see `sampler.Backend`.
    parts : the mixture that moves the particles.
    particles : how many. steps : of the mixture for each particle and stage.
    drawn : how many draws from the prior the first stage weighs; at least `particles`, and as many if not given.
    stops : exponents, rising, at which to keep the population.
    share : of the particles, the weights' effective number that a stage leaves: the smaller, the fewer stages.
    """
    values, densities, log_evidence = from_prior(rng, space, backend, max(particles, drawn or particles))
    tuning = first_tuning(space, values[0])
    kept = list[Stop]()

    def advance(chosen: np.ndarray, exponent: float) -> np.ndarray:
        nonlocal values, densities, tuning
        values, densities = values[chosen], densities[chosen]
        tuning = tuning._replace(temperature=exponent)
        counts = np.zeros((len(parts), 2), np.int64)
        for n in range(particles):
            stretch = backend.sweep(rng, values[n], tuning, 1, steps)
            values[n], densities[n] = stretch.values[-1], stretch.densities[-1]
            counts += stretch.counts
        tuning = tuning._replace(scale=rescale(tuning.scale, parts, counts, GAIN))
        while len(kept) < len(stops) and exponent >= stops[len(kept)]:
            kept.append(Stop(values.copy(), tuning))
        return densities[:, 1]

    log_ratio, temperatures = anneal(rng, densities[:, 1], advance, particles, share)
    return Population(values, densities, log_evidence + log_ratio, tuning, tuple(temperatures), tuple(kept))
