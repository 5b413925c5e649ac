"""The one Metropolis-Hastings decision and the one adaptation of step scales, for kernels, jumps and compiled code.

Each function is plain Python that numba compiles as it stands: compiled code takes the forms made of the same source
at the end of this file. A step is `kernel(rng, state) -> (state, info)`.
"""

import math
from typing import NamedTuple, TypeVar

import numpy as np

from derender.compilation.cache import njit

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
