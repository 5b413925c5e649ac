"""The test that every kernel has to pass: started from the posterior, it must stay there.

Draw values from the prior and data given them: the values are then one exact draw from their posterior given these
data. After some steps of the kernel *on that posterior* they must still be one. So for any function f of values and
data, f(after) - f(before) has expectation zero; its replicates are independent, their mean divided by their own
standard error is nearly a standard normal, and no tolerance has to be guessed. (Geweke 2004; here in the paired
form, in which most of the noise of prior and data cancels, so that small faults show.)
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class State(NamedTuple):
    """values : (P,) float64; log_prior, log_likelihood : at those values."""

    values: np.ndarray
    log_prior: float
    log_likelihood: float


def steps_of(backend, tuning):
    """Return the kernel (rng, state) -> (state, accepted) that is one step of an interpreted mixture."""

    def kernel(rng, state):
        step = backend.walked(rng, np.array([*state.values, state.log_prior, state.log_likelihood]), tuning, 1, 1)
        return State(step.values[0], *map(float, step.densities[0])), bool(step.counts[:, 1].sum())

    return kernel


def evaluate(target, values: np.ndarray) -> State:
    """Return the state at some values; outside the prior's support the likelihood is not asked for."""
    log_prior = target.log_prior(values)
    if not log_prior > -np.inf:
        return State(values, -np.inf, -np.inf)
    return State(values, log_prior, target.log_likelihood(values))


class Verdict(NamedTuple):
    """z : (F,) the test's normal scores, one for each function; moved : share of the steps that changed the state."""

    z: np.ndarray
    moved: float

    @property
    def worst(self) -> float:
        return float(np.max(np.abs(self.z)))


def verdict(
    world, make_kernel: Callable, replicates: int, steps: int, seed: int = 1, until_caught: bool = False
) -> Verdict:
    """Run the test.

    Parameters
    ----------
    world : has `space` and `target(rng, values)`, which draws data given the values and returns the posterior's target;
        and `sample(rng)` where the prior is more than that of the space.
    make_kernel : from a target to a kernel (rng, state) -> (state, whether it accepted).
    until_caught : of a broken twin an eighth, a quarter or half of the replicates may be proof enough.
    """
    draw = getattr(world, "sample", world.space.sample)
    differences: list[np.ndarray] = []
    moved = 0
    for child in np.random.SeedSequence(seed).spawn(replicates):
        if until_caught and len(differences) in (replicates // 8, replicates // 4, replicates // 2):
            found = scores(differences, moved, steps)
            if found.worst > bound(len(found.z)):
                return found
        rng = np.random.default_rng(child)
        values = draw(rng)
        target = world.target(rng, values)
        kernel = make_kernel(target)
        before = state = evaluate(target, values)
        for _ in range(steps):
            state, accepted = kernel(rng, state)
            moved += accepted
        differences.append(features(world, state, target) - features(world, before, target))
    return scores(differences, moved, steps)


def scores(differences: list[np.ndarray], moved: int, steps: int) -> Verdict:
    """Return the Verdict of the differences of so many replicates, in whose steps the state changed `moved` times."""
    spread = np.std(differences, axis=0, ddof=1)
    alive = spread > 0
    z = np.mean(differences, axis=0)[alive] / (spread[alive] / np.sqrt(len(differences)))
    return Verdict(z, moved / (len(differences) * steps))


def features(world, state, target) -> np.ndarray:
    """Return the functions: log densities; each value, its square and its products with a summary of the data."""
    coordinates = []
    for value, period in zip(state.values, world.space.periods, strict=True):
        angle = 2 * np.pi * value / period if period else 0.0
        coordinates.extend([np.sin(angle), np.cos(angle)] if period else [value])
    coordinates = np.array(coordinates)
    summary = target.summary()
    products = np.outer(coordinates, summary).ravel()
    cross = np.outer(coordinates, coordinates)[_pairs(len(coordinates))]
    return np.concatenate([[state.log_prior, state.log_likelihood], coordinates, cross, products])


_pairs = functools.cache(np.triu_indices)


def bound(count: int) -> float:
    """Return the largest |z| that chance allows among `count` normal scores: exceeded once in about 20,000 tests."""
    from statistics import NormalDist

    return -NormalDist().inv_cdf(2.5e-5 / count)
