"""Sequential Monte Carlo over temperatures: a population that follows posterior_b = prior x likelihood^b from 0 to 1.

Del Moral, Doucet, Jasra, "Sequential Monte Carlo samplers" (2006). Particles start from the prior; each stage raises
the exponent as far as half of the population's weight can bear, resamples, and moves every particle by a mixture of
kernels that leaves the new stage invariant. It finds the one mode that matters among many, and estimates the evidence.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from derender.errors import DerenderError
from derender.posterior.adaptation import first_tuning, rescale
from derender.posterior.kernels.base import Part, Tuning
from derender.posterior.space import Space
from derender.scene.priors.terms import MOST_TRIES

FEW = 20  # draws' worth that must meet the prior's terms before a population is taken from them
ROUNDING = 1e-6  # of log densities
LEAST_STEP = 1.05  # an exponent grows by this factor at least: a population of a few particles cannot stall


class Stop(NamedTuple):
    """A population on the way. values : (n, P) float64; tuning : with the temperature and the scales of then."""

    values: np.ndarray
    tuning: Tuning


class Population(NamedTuple):
    """Particles of equal weight from the posterior.

    Attributes
    ----------
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


def next_temperature(log_likelihood: np.ndarray, present: float, share: float = 0.5) -> float:
    """Return the largest exponent, at most 1, under which the weights' effective number is `share` of the particles."""

    def effective(exponent: float) -> float:
        logs = (exponent - present) * (log_likelihood - np.max(log_likelihood))
        weights = np.exp(logs)
        return float(np.sum(weights) ** 2 / np.sum(weights**2))

    wanted = share * len(log_likelihood)
    if effective(1.0) >= wanted:
        return 1.0
    low, high = present, 1.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective(middle) >= wanted else (low, middle)
    return min(1.0, max(low, present * LEAST_STEP))


def systematic(rng: np.random.Generator, weights: np.ndarray, count: int | None = None) -> np.ndarray:
    """Return (count,) indices (default: as many as there are weights): systematic resampling, which copies each
    particle n w or n w + 1 times."""
    count = len(weights) if count is None else count
    places = (rng.random() + np.arange(count)) / count
    cumulative = np.cumsum(weights) / np.sum(weights)
    return np.minimum(np.searchsorted(cumulative, places, side="right"), len(weights) - 1)


def from_prior(rng: np.random.Generator, space: Space, backend, count: int) -> tuple[np.ndarray, np.ndarray, float]:
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
    backend,
    parts: list[Part],
    particles: int,
    steps: int,
    drawn: int | None = None,
    stops: Sequence[float] = (),
    share: float = 0.5,
) -> Population:
    """Run the sampler.

    Parameters
    ----------
    backend : see `sampler.Backend`.
    parts : the mixture that moves the particles.
    particles : how many. steps : of the mixture for each particle and stage.
    drawn : how many draws from the prior the first stage weighs; at least `particles`, and as many if not given.
    stops : exponents, rising, at which to keep the population.
    share : of the particles, the weights' effective number that a stage leaves: the smaller, the fewer stages.
    """
    values, densities, log_evidence = from_prior(rng, space, backend, max(particles, drawn or particles))
    tuning = first_tuning(space, values[0])
    present = 0.0
    temperatures, kept = [0.0], list[Stop]()
    while present < 1.0:
        following = next_temperature(densities[:, 1], present, share * particles / len(values))
        logs = (following - present) * densities[:, 1]
        weights = np.exp(logs - np.max(logs))
        log_evidence += float(np.max(logs) + np.log(np.mean(weights)))
        if len(values) > particles:  # from the many draws of the prior to the population
            chosen = systematic(rng, weights)[rng.permutation(len(values))[:particles]]
        else:
            chosen = systematic(rng, weights)
        values, densities = values[chosen], densities[chosen]
        present = following
        temperatures.append(present)
        tuning = tuning._replace(temperature=present)
        counts = np.zeros((len(parts), 2), np.int64)
        for n in range(particles):
            stretch = backend.sweep(rng, values[n], tuning, 1, steps)
            values[n], densities[n] = stretch.values[-1], stretch.densities[-1]
            counts += stretch.counts
        tuning = tuning._replace(scale=rescale(tuning.scale, parts, counts, 2.0))
        while len(kept) < len(stops) and present >= stops[len(kept)]:
            kept.append(Stop(values.copy(), tuning))
    return Population(values, densities, log_evidence, tuning, tuple(temperatures), tuple(kept))
