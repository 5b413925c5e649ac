"""Levenberg-Marquardt in a box, for costs whose Gauss-Newton equations are at hand."""

from collections.abc import Callable
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


def levenberg_marquardt(
    cost: Callable[[np.ndarray], float],
    equations: Callable[[np.ndarray], tuple[float, np.ndarray, np.ndarray]],
    values: np.ndarray,
    domain: Domain,
    iterations: int = 20,
    tolerance: float = 1e-2,
    damping: float = 1e-3,
) -> Minimum:
    """Minimise a cost from `values` on.

    cost : values -> cost. equations : values -> (cost, gradient (P,), hessian (P, P)).
    tolerance : stop when a step lowers the cost by less than this and less than is foreseen (in nats, for log densities).
    A step that leaves the box is cut back to it, parameter by parameter; those held by a bound leave the equations.
    """
    values = domain.bring(np.asarray(values, float))
    value, gradient, hessian = equations(values)
    costs = [value]
    steps = 0
    while steps < iterations:
        held = (domain.period == 0) & (
            ((values <= domain.lower) & (gradient > 0)) | ((values >= domain.upper) & (gradient < 0))
        )
        free = np.flatnonzero(~held)
        if len(free) == 0:
            break
        part = hessian[np.ix_(free, free)]
        diagonal = np.maximum(np.diag(part), 1e-9 * np.diag(part).max(initial=1e-12))
        step = np.zeros_like(values)
        step[free] = -np.linalg.solve(part + np.diag(damping * diagonal), gradient[free])
        foreseen = -(gradient @ step + 0.5 * step @ hessian @ step)
        trial = domain.bring(values + step)
        steps += 1
        trial_value = cost(trial)
        if trial_value < value:
            gained = value - trial_value
            values = trial
            value, gradient, hessian = equations(values)
            costs.append(value)
            damping = max(damping * (0.1 if gained > 0.5 * foreseen else 0.5), 1e-7)
            if gained < tolerance:
                break
        else:
            if foreseen < tolerance or damping > 1e6:
                break
            damping = max(damping * 8.0, 1e-3)
    return Minimum(values, value, gradient, hessian, tuple(costs), steps)
