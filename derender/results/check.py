"""A posterior predictive check by region: what of an image the scene that was found does not explain, in sentences."""

import numpy as np

from derender.results.fit import Fit
from derender.results.trust import Doubt

MOST_UNEXPLAINED = 0.1  # share of the valid pixels from which on an answer is about another scene


def check_fit(fit: Fit, observed: np.ndarray) -> tuple[Doubt, ...]:
    """Return the doubts that an image (H, W) raises about what was found in it.

    observed : metres, NaN where nothing returned.
    """
    doubts = []
    if 1.0 - fit.share > MOST_UNEXPLAINED:
        doubts.append(Doubt(f"{1.0 - fit.share:.0%} of the image is not explained"))
    return tuple(doubts)
