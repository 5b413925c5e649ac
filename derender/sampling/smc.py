"""Sequential Monte Carlo by tempering (Del Moral, Doucet, Jasra 2006): the loop, for any population.

A population of n particles is to gain weight: particle i the log increment `gain[i]` in all, such as its log likelihood
on the way from prior to posterior. An exponent on that increment rises from 0 to 1 as far as the weights' effective
number bears; at each stage particles are resampled and moved by kernels that leave the stage invariant. The product of
the mean weights estimates the ratio of the normalising constants; adaptive stages bias it by O(1 / n).
"""

from collections.abc import Callable

import numpy as np

LEAST_STEP = 1.05  # an exponent grows by this factor at least: a population of a few particles cannot stall
BISECTIONS = 60  # halve [present, 1] to below the spacing of floating point numbers

Advance = Callable[[np.ndarray, float], np.ndarray]


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
) -> tuple[float, list[float]]:
    """Raise the exponent on a population's gain from 0 to 1.

    gain : (n,) log increments of the particles, -inf allowed.
    advance : called at each stage with the indices of the particles that are kept, copies among them, and the exponent;
        moves them and returns their gains in full.
    count : of particles after the first stage; None: n.
    share : of the particles, the effective number that a stage leaves: the smaller, the fewer stages.

    Returns log of the estimated mean weight; the exponents, from 0 to 1.
    """
    count = len(gain) if count is None else count
    log_mean, exponents = 0.0, [0.0]
    while exponents[-1] < 1.0:
        present = exponents[-1]
        following = next_temperature(gain, present, share * count / len(gain))
        with np.errstate(invalid="ignore"):  # 0 times -inf, where nothing is
            logs = np.where(gain > -np.inf, (following - present) * gain, -np.inf)
        weights = np.exp(logs - np.max(logs))
        log_mean += float(np.max(logs) + np.log(np.mean(weights)))
        chosen = systematic(rng, weights)
        if len(gain) > count:  # from many draws to the population
            chosen = chosen[rng.permutation(len(gain))[:count]]
        exponents.append(following)
        gain = advance(chosen, following)
    return log_mean, exponents
