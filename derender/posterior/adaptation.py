"""What warm-up learns from where the chain has been: a centre, a covariance, a scale for each kernel. Then it stops."""

from collections.abc import Mapping

import numpy as np

from derender.posterior.kernels.base import Part, Tuning, kernels
from derender.posterior.space import Space
from derender.sampling.metropolis import adapted_scale

PRIOR_SHARE = 1e-4  # of the prior's variance, with the weight of five draws: keeps a covariance of few draws regular


def first_tuning(space: Space, values: np.ndarray, temperature: float = 1.0) -> Tuning:
    """Return the tuning of a chain that knows only its prior: a tenth of its spread."""
    return Tuning(values, np.diag((0.1 * space.scales) ** 2), {}, temperature)


def centre_of(space: Space, history: np.ndarray) -> np.ndarray:
    """Return (P,) a typical place: means on lines; on circles and rotations the mean step from the last place.

    Parameters
    ----------
    history : (n, P) float, places in the order of the chain.
    """
    last = history[-1]
    centre = last
    for _ in range(2):  # the second time from a better origin, for rotations
        centre = space.move(centre, space.everything, space.differences(history, centre).mean(axis=0))
    return centre


def covariance_of(space: Space, history: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return (D, D) the covariance of tangents from `centre`, kept regular by a little of the prior's."""
    steps = space.differences(history, centre)
    count = len(steps)
    seen = steps.T @ steps / count
    return (count * seen + 5 * PRIOR_SHARE * np.diag(space.scales**2)) / (count + 5)


def rescale(scale: Mapping[str, float], parts: list[Part], counts: np.ndarray, gain: float) -> dict[str, float]:
    """Return the kernels' scales after a stretch: up where more steps were accepted than wanted, down where fewer.

    Parameters
    ----------
    counts : (K, 2), steps and accepted ones in the stretch, in the order of `parts`.
    gain : how far log scale goes for an acceptance rate that is wrong by 1.
    """
    scale = dict(scale)
    for part, (steps, accepted) in zip(parts, counts.tolist(), strict=True):
        kind = kernels[part.type]
        if kind.adapts and steps > 0:
            trust = min(1.0, steps / 20)
            former = scale.get(part.name, 1.0)
            scale[part.name] = adapted_scale(former, accepted / steps, kind.acceptance, gain * trust)
    return scale
