"""Where parameters may be, and where a descent ended."""

from typing import NamedTuple

import numpy as np


class Domain(NamedTuple):
    """Where parameters may be. lower, upper : (P,) float64; period : (P,) float64, 0 = none (then they are ignored)."""

    lower: np.ndarray
    upper: np.ndarray
    period: np.ndarray

    def bring(self, values: np.ndarray) -> np.ndarray:
        """Return the nearest values inside: wrapped where periodic, clipped elsewhere."""
        clipped = np.clip(values, self.lower, self.upper)
        period = np.where(self.period > 0, self.period, 1.0)
        return np.where(self.period > 0, values - period * np.floor(values / period), clipped)


class Minimum(NamedTuple):
    """Where a descent ended.

    Attributes
    ----------
    values : (P,) float64. cost : float. gradient : (P,), hessian : (P, P) Gauss-Newton, both at `values`.
    costs : of every accepted state, the first one at the start. steps : how many steps were tried.
    """

    values: np.ndarray
    cost: float
    gradient: np.ndarray
    hessian: np.ndarray
    costs: tuple[float, ...]
    steps: int
