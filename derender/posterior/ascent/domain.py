"""Where parameters may be."""

import math
from typing import NamedTuple

import numpy as np

from derender.compilation.cache import njit


class Domain(NamedTuple):
    """Where parameters may be. lower, upper : (P,) float64; period : (P,) float64, 0 = none (then they are ignored)."""

    lower: np.ndarray
    upper: np.ndarray
    period: np.ndarray

    def bring(self, values: np.ndarray) -> np.ndarray:
        """Return the nearest values inside."""
        moved = np.array(values, np.float64)
        bring(moved, *self)
        return moved


@njit(cache=True, nogil=True)
def bring(values, lower, upper, period):
    """Move values to their domain: wrapped where periodic, clipped elsewhere."""
    for p in range(values.shape[0]):
        if period[p] > 0.0:
            values[p] -= period[p] * math.floor(values[p] / period[p])
        else:
            values[p] = min(max(values[p], lower[p]), upper[p])
