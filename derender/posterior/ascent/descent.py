"""Ascent of the likelihood of one structure: Levenberg-Marquardt and the paper's fixed steps.

The images and their derivatives are compiled; the few steps on the way are not.
"""

import math
from typing import NamedTuple

import numpy as np

from derender.compilation.cache import njit
from derender.posterior.ascent.placement import Domain, Placement, find_motions, place
from derender.render.raycast.normal_equations import Misfit, cost, normal_equations
from derender.render.raycast.records import MOTION

DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-7, 1e6  # of the Hessian's diagonal: at the start, and its limits
AFTER_FAILURE = 1e-2  # least damping after a step that did not lower the cost: smaller ones would fail again
FLAT, SINGULAR = 1e-6, 1e-10  # shares of the largest diagonal element taken for one that is 0, and added to all


@njit(cache=True, nogil=True)
def solve_positive(matrix, vector, held, step):
    """Solve matrix step = -vector on the parameters not held (Cholesky); False if the matrix is not positive."""
    count = vector.shape[0]
    factor = np.zeros((count, count))
    for i in range(count):
        if held[i]:
            factor[i, i] = 1.0
            step[i] = 0.0
            continue
        for j in range(i + 1):
            value = matrix[i, j] if not held[j] else 0.0
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            if i == j:
                if value <= 0.0:
                    return False
                factor[i, i] = math.sqrt(value)
            else:
                factor[i, j] = value / factor[j, j]
        step[i] = -vector[i]
    for i in range(count):
        for k in range(i):
            step[i] -= factor[i, k] * step[k]
        step[i] /= factor[i, i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            step[i] -= factor[k, i] * step[k]
        step[i] /= factor[i, i]
    return True


@njit(cache=True, nogil=True)
def _costs_at(misfit, placement, places, poses, sizes, costs):
    for n in range(places.shape[0]):
        place(placement, places[n], poses, sizes)
        costs[n] = cost(misfit, poses, sizes)


@njit(cache=True, nogil=True)
def _equations_at(misfit, placement, values, poses, sizes, motions, edges, gradient, hessian):
    find_motions(placement, values, motions)
    normal_equations(misfit, poses, sizes, motions, edges, gradient, hessian)


class Cost:
    """Minus the log likelihood of a structure's numbers, up to a constant, and its derivatives.

    edges : False leaves out the occlusion edges of the derivative: wrong, for comparison.
    """

    def __init__(self, misfit: Misfit, placement: Placement, edges: bool = True) -> None:
        self._arrays, self._edges = (misfit, placement), edges
        count, solids = len(placement.vertex), len(misfit.kinds)
        self._placed = np.empty((solids, 4, 4)), np.empty((solids, 3))
        self._motions = np.empty((count, solids, MOTION))

    def at(self, places: np.ndarray) -> np.ndarray:
        """Return the costs (S,) at places (S, P)."""
        costs = np.empty(len(places))
        _costs_at(*self._arrays, np.ascontiguousarray(places, np.float64), *self._placed, costs)  # type: ignore[call-arg]
        return costs

    def equations(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return gradient (P,) and Gauss-Newton Hessian (P, P) at values (P,), the last at which the cost was asked."""
        gradient, hessian = np.empty(len(values)), np.empty((len(values), len(values)))
        _equations_at(*self._arrays, values, *self._placed, self._motions, self._edges, gradient, hessian)  # type: ignore[call-arg]
        return gradient, hessian

    def differences(self, values: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Return the gradient (P,) by central differences of these steps (P,): for comparison."""
        costs = self.at(np.concatenate([values + np.diag(steps), values - np.diag(steps)])).reshape(2, -1)
        return (costs[0] - costs[1]) / (2.0 * steps)


class Ascent(NamedTuple):
    """path : (T + 1, P) the states on the way, from the start in the domain on. costs : (T + 1,) theirs."""

    path: np.ndarray
    costs: np.ndarray


def levenberg(cost: Cost, start: np.ndarray, domain: Domain, iterations: int, tolerance: float) -> Ascent:
    """Minimise by Levenberg-Marquardt from `start` (P,), in at most `iterations` steps tried.

    tolerance : nats; a smaller gain ends it.
    """
    values = domain.bring(start)
    value = cost.at(values[None])[0]
    gradient, hessian = cost.equations(values)
    path, costs, damping, step = [values], [value], DAMPING, np.zeros(len(values))
    for _ in range(iterations):
        outward = ((values <= domain.lower) & (gradient > 0.0)) | ((values >= domain.upper) & (gradient < 0.0))
        diagonal = np.diag(hessian)
        largest = max(diagonal.max(), 1e-12)
        damped = hessian + np.diag(damping * np.maximum(diagonal, FLAT * largest) + SINGULAR * largest)
        if not solve_positive(damped, gradient, (domain.period == 0.0) & outward, step):
            damping = max(damping * 10.0, DAMPING)
            continue
        foreseen = -float(step @ (gradient + 0.5 * hessian @ step))
        trial = domain.bring(values + step)
        gained = value - cost.at(trial[None])[0]
        if gained > 0.0:
            values, value = trial, value - gained
            damping = max(damping * (0.1 if gained > 0.5 * foreseen else 0.5), LEAST_DAMPING)
            gradient, hessian = cost.equations(values)
            path.append(values)
            costs.append(value)
            if gained < tolerance:
                break
        elif foreseen < tolerance or damping > MOST_DAMPING:
            break
        else:
            damping = max(damping * 8.0, AFTER_FAILURE)
    return Ascent(np.array(path), np.array(costs))


def fixed_steps(cost: Cost, start: np.ndarray, domain: Domain, iterations: int, length: float,
                difference: float = 0.0) -> Ascent:  # fmt: skip
    """Ascend the log density by steps of fixed length along its gradient in unit coordinates, as in Figure 5.

    Each parameter is measured by its range (an angle by its period), the gradient is normalised: then alpha, `length`,
    is a length. The paper does not say what its alpha multiplies. Of nine readings (the plain gradient with sigma from
    1 cm to 1 m or its mean over pixels, unit length in ranges or in radians, each number by itself) those with unit
    length climb most, nine tenths of the way in 12 steps; plain gradients leap past the top and end below the start;
    none comes within 3 nats in 100 ascents, as steps of fixed length end in a circle about the top.
    difference : 0, or the step of central differences in unit coordinates.
    """
    scale = np.where(domain.period > 0.0, domain.period, np.minimum(domain.upper - domain.lower, 1.0))
    path, costs = [domain.bring(start)], []
    for _ in range(iterations + 1):
        values = path[-1]
        costs.append(cost.at(values[None])[0])
        gradient = scale * (cost.differences(values, difference * scale) if difference else cost.equations(values)[0])
        steepness = np.linalg.norm(gradient)
        if steepness == 0.0:
            break
        path.append(domain.bring(values - length * scale * gradient / steepness))
    return Ascent(np.array(path[: len(costs)]), np.array(costs))
