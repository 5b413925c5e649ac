"""Sequential Monte Carlo by tempering (Del Moral, Doucet, Jasra 2006): populations of scenes of one structure.

They follow prior x likelihood^b: particles start from the prior, and b rises from 0 to 1 as far as the weights'
effective number bears; at each stage particles are resampled and moved by a mixture of kernels. It finds the one mode
that matters among many. The product of the mean weights estimates the evidence; adaptive stages bias it by O(1 / n).
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from derender.errors import DerenderError
from derender.posterior.kernels.base import Part, first_tuning, rescale
from derender.posterior.space import Space
from derender.scene.priors.terms import MOST_TRIES

if TYPE_CHECKING:
    from derender.posterior.compiled.backend import CompiledBackend
    from derender.posterior.compiled.interpreted import InterpretedBackend

FEW = 20  # draws' worth that must meet the prior's terms before a population is taken from them
ROUNDING = 1e-6  # of log densities
GAIN = 2.0  # change of a log scale for an acceptance rate wrong by 1, at each stage
LEAST_STEP = 1.05  # an exponent grows by this factor at least: a population of a few particles cannot stall
BISECTIONS = 60  # halve [present, 1] to below the spacing of floating point numbers

Advance = Callable[[np.ndarray, float], np.ndarray]


class Population(NamedTuple):
    """Particles of equal weight from the posterior.

    values : (n, P) float64. densities : (n, 2) float64, log prior and log likelihood.
    log_evidence : estimate of log p(image); unbiased on the natural scale but for the adaptation.
    stops : (n, P) float64, the populations at the exponents that were asked for, or just above.
    """

    values: np.ndarray
    densities: np.ndarray
    log_evidence: float
    stops: list[np.ndarray]


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


def next_temperature(gain: np.ndarray, present: float, share: float = 0.5) -> float:
    """Return the largest exponent, at most 1, at which the weights' effective number is `share` of the particles.

    Particles that no stage keeps (a gain of -inf) do not count.
    """
    possible = gain[gain > -np.inf]
    if not len(possible):
        raise ValueError("no particle has any weight")

    def effective(exponent: float) -> float:
        weights = np.exp((exponent - present) * (possible - np.max(possible)))
        return float(np.sum(weights) ** 2 / np.sum(weights**2))

    wanted = min(share * len(gain), 0.999 * len(possible))
    if effective(1.0) >= wanted:
        return 1.0
    low, high = present, 1.0
    for _ in range(BISECTIONS):
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


def anneal(
    rng: np.random.Generator, gain: np.ndarray, advance: Advance, count: int | None = None, share: float = 0.5
) -> float:
    """Raise the exponent on a population's gain from 0 to 1; return the log of the estimated mean weight.

    gain : (n,) log increments of the particles, -inf allowed.
    advance : called at each stage with the indices of the particles that are kept, copies among them, and the exponent;
        moves them and returns their gains in full.
    count : of particles after the first stage; None: n.
    share : of the particles, the effective number that a stage leaves: the smaller, the fewer stages.
    """
    count = len(gain) if count is None else count
    log_mean, present = 0.0, 0.0
    while present < 1.0:
        following = next_temperature(gain, present, share * count / len(gain))
        with np.errstate(invalid="ignore"):  # 0 times -inf, where nothing is
            logs = np.where(gain > -np.inf, (following - present) * gain, -np.inf)
        weights = np.exp(logs - np.max(logs))
        log_mean += float(np.max(logs) + np.log(np.mean(weights)))
        chosen = systematic(rng, weights)
        if len(gain) > count:  # from many draws to the population
            chosen = chosen[rng.permutation(len(gain))[:count]]
        gain, present = advance(chosen, following), following
    return log_mean


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
    kept = list[np.ndarray]()

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
            kept.append(values.copy())
        return densities[:, 1]

    log_ratio = anneal(rng, densities[:, 1], advance, particles, share)
    return Population(values, densities, log_evidence + log_ratio, kept)
