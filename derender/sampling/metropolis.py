"""The one Metropolis-Hastings decision, the one adaptation of step scales, and the one compiled walk of both.

The decision and the adaptation are plain Python that numba compiles as it stands: compiled code takes the forms made of
the same source. A step is `kernel(rng, state) -> (state, info)`.

What is walked on is a target: arrays in a NamedTuple, and two kernels that know them. One attempts a step, of which it
returns the log ratio, the other settles it. So a walk knows no scene.
"""

import math
from typing import NamedTuple, TypeVar

import numpy as np

from derender.compilation.cache import call_for_nothing, call_for_number, njit

State = TypeVar("State")
MOST_CHANGE = 1.5  # of a log scale at one adaptation: early rates, from few steps, are hardly known


class Info(NamedTuple):
    """What diagnostics need of a step."""

    accepted: bool  # whether the state changed
    name: str  # of the kernel


def log_threshold(rng: np.random.Generator) -> float:
    """Return the log of a number uniform in (0, 1]: a step is accepted where that is below its log ratio."""
    return math.log(1.0 - rng.random())


def adapted_scale(scale: float, rate: float, wanted: float, gain: float) -> float:
    """Return a step's scale after a stretch (Robbins-Monro on its logarithm).

    rate, wanted : shares of accepted steps, seen and aimed at. gain : change of log scale for a rate wrong by 1.
    """
    return scale * math.exp(max(-MOST_CHANGE, min(MOST_CHANGE, gain * (rate - wanted))))


def decide(rng: np.random.Generator, old: State, new: State, log_ratio: float, name: str) -> tuple[State, Info]:
    """Return the new state with probability min(1, exp(log ratio)), else the old one, and what happened."""
    accepted = log_threshold(rng) < log_ratio
    return (new if accepted else old), Info(accepted, name)


compiled_log_threshold = njit(cache=True, nogil=True)(log_threshold)
compiled_adapted_scale = njit(cache=True, nogil=True)(adapted_scale)

ATTEMPT, SETTLE = range(2)  # places among a walk's calls
PRIOR, DENSITY = -2, -1  # the last two of a walk's place: log prior and log likelihood


class Steps(NamedTuple):
    """What a walk chooses from: K kernels."""

    cumulative: np.ndarray  # (K,) float64, running sum of the weights
    scale: np.ndarray  # (K,) float64, of their steps; a walk with a gain adapts them in place
    wanted: np.ndarray  # (K,) float64, shares of accepted steps that are aimed at; 0 where the scale stays as it is
    most: np.ndarray  # (K,) float64, largest scales


class Stretch(NamedTuple):
    """Steps of a mixture."""

    values: np.ndarray  # (n, P)
    densities: np.ndarray  # (n, 2), log prior and log likelihood
    counts: np.ndarray  # (K, 2), steps and accepted ones of each kernel
    scale: np.ndarray  # (K,), to which the steps' scales adapted


@njit(cache=True, nogil=True)
def pick(rng, cumulative):
    """Return the number of the next kernel, by weight."""
    threshold, k = rng.random() * cumulative[-1], 0
    while k < len(cumulative) - 1 and cumulative[k] <= threshold:  # numba takes three seconds for searchsorted
        k += 1
    return k


@njit(cache=True, nogil=True)
def walk(rng, calls, target, steps, now, temperature, gain, done, thin, kept, counts):
    """Take len(kept) * thin steps, of which `done` are done, and keep every `thin`-th place; return how many are done,
    and the number of the kernel whose step the caller has to take, or -1.

    calls : (2,) int64, the addresses of attempt(rng, target, k, scale, temperature), which returns the log ratio of a
        step of kernel k, NaN where the caller has to take it, and of settle(target, accepted), which makes it the
        present place or forgets it.
    steps : Steps. now : (P + 2,) float64, values, log prior and log likelihood, as `settle` leaves them.
    temperature : exponent of the likelihood. gain : of the adaptation of steps.scale; 0: none.
    kept : (draws, P + 2) float64, written. counts : (K, 2) int64 (steps, accepted ones), added to.
    """
    count = len(kept) * thin
    for taken in range(done, count):
        k = pick(rng, steps.cumulative)
        log_ratio = call_for_number(calls[ATTEMPT], rng, target, k, steps.scale[k], temperature)
        if math.isnan(log_ratio):
            return taken, k
        accepted = compiled_log_threshold(rng) < log_ratio
        call_for_nothing(calls[SETTLE], target, accepted)
        counts[k, 0] += 1
        counts[k, 1] += accepted
        if gain > 0.0 and steps.wanted[k] > 0.0:
            rate = 1.0 if accepted else 0.0
            scale = compiled_adapted_scale(steps.scale[k], rate, steps.wanted[k], gain)
            steps.scale[k] = min(scale, steps.most[k])
        if (taken + 1) % thin == 0:
            for p in range(len(now)):
                kept[taken // thin, p] = now[p]
    return count, -1


def mean_scale(scales: list[np.ndarray]) -> np.ndarray:
    """Return (K,) the geometric means of the scales (K,) to which walks side by side adapted."""
    return np.exp(np.mean(np.log(scales), axis=0))
