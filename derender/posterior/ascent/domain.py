"""Where parameters may be."""

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
