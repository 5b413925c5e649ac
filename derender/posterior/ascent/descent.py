"""Ascent of the likelihood of one structure, compiled: Levenberg-Marquardt and the paper's fixed steps."""

import math

import numpy as np

from derender.compilation.cache import njit
from derender.posterior.ascent.placement import bring, find_motions, place
from derender.render.raycast.normal_equations import cost, cost_gradient, normal_equations
from derender.render.raycast.records import MOTION


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
def cost_at(misfit, placement, values, poses, sizes):
    """Minus the log likelihood, up to a constant."""
    place(placement, values, poses, sizes)
    return cost(misfit, poses, sizes)


@njit(cache=True, nogil=True)
def costs_at(misfit, placement, places):
    """Return the costs (S,) at places (S, P)."""
    solids = misfit.kinds.shape[0]
    poses, sizes, found = np.empty((solids, 4, 4)), np.empty((solids, 3)), np.empty(places.shape[0])
    for n in range(places.shape[0]):
        found[n] = cost_at(misfit, placement, places[n], poses, sizes)
    return found


@njit(cache=True, nogil=True)
def equations_at(misfit, placement, values, poses, sizes, motions, edges, gradient, hessian):
    """Write gradient (P,) and Gauss-Newton Hessian (P, P) of the cost where `cost_at` has been called last."""
    find_motions(placement, values, motions)
    normal_equations(misfit, poses, sizes, motions, edges, gradient, hessian)


@njit(cache=True, nogil=True)
def differences_at(misfit, placement, values, poses, sizes, scale, step, gradient):
    """Write the gradient by central differences of the cost with steps `step * scale[p]`: for comparison."""
    for p in range(values.shape[0]):
        h, kept = step * scale[p], values[p]
        values[p] = kept + h
        after = cost_at(misfit, placement, values, poses, sizes)
        values[p] = kept - h
        gradient[p] = (after - cost_at(misfit, placement, values, poses, sizes)) / (2.0 * h)
        values[p] = kept


@njit(cache=True, nogil=True)
def levenberg(
    misfit,
    placement,
    values,
    lower,
    upper,
    period,
    iterations,
    tolerance,
    edges,
    path,
    costs,
    gradient,
    hessian,
):
    """Minimise by Levenberg-Marquardt, in place, and return (cost, accepted states, tried steps).

    values : (P,) float64, start and end. lower, upper, period : the domain.
    iterations : most steps to try. tolerance : nats; a smaller gain ends it. path : (iterations + 1, P) and costs :
    (iterations + 1,), written: the accepted states. gradient, hessian : those of the last state.
    """
    count, solids = values.shape[0], misfit.kinds.shape[0]
    poses, sizes = np.empty((solids, 4, 4)), np.empty((solids, 3))
    motions = np.empty((count, solids, MOTION))
    step, trial, held = np.zeros(count), np.empty(count), np.zeros(count, np.bool_)
    damped = np.empty((count, count))
    bring(values, lower, upper, period)
    value = cost_at(misfit, placement, values, poses, sizes)
    equations_at(misfit, placement, values, poses, sizes, motions, edges, gradient, hessian)
    path[0], costs[0] = values, value
    accepted, tried, damping = 0, 0, 1e-3
    while tried < iterations:
        largest = 1e-12
        for p in range(count):
            held[p] = period[p] == 0.0 and (
                (values[p] <= lower[p] and gradient[p] > 0.0) or (values[p] >= upper[p] and gradient[p] < 0.0)
            )
            largest = max(largest, hessian[p, p])
        damped[:] = hessian
        for p in range(count):
            damped[p, p] += damping * max(hessian[p, p], 1e-6 * largest) + 1e-10 * largest
        if not solve_positive(damped, gradient, held, step):
            damping = max(damping * 10.0, 1e-3)
            tried += 1
            continue
        for p in range(count):
            trial[p] = values[p] + step[p]
        bring(trial, lower, upper, period)
        foreseen = 0.0
        for p in range(count):
            curved = 0.0
            for q in range(count):
                curved += hessian[p, q] * step[q]
            foreseen -= step[p] * (gradient[p] + 0.5 * curved)
        tried += 1
        trial_value = cost_at(misfit, placement, trial, poses, sizes)
        if trial_value < value:
            gained = value - trial_value
            values[:] = trial
            accepted += 1
            damping = max(damping * (0.1 if gained > 0.5 * foreseen else 0.5), 1e-7)
            value = trial_value
            equations_at(misfit, placement, values, poses, sizes, motions, edges, gradient, hessian)
            path[accepted], costs[accepted] = values, value
            if gained < tolerance:
                break
        else:
            if foreseen < tolerance or damping > 1e6:
                break
            damping = max(damping * 8.0, 1e-2)
    return value, accepted, tried


@njit(cache=True, nogil=True)
def fixed_step(misfit, placement, values, lower, upper, period, iterations, step, edges, difference, path, costs):
    """Ascend the log density by steps of fixed length along its gradient in unit coordinates, as in Figure 5.

    Each parameter is measured by its range (an angle by its period), the gradient is normalised: then alpha, `step`,
    is a length. The paper does not say what its alpha multiplies. Of nine readings (the plain gradient with sigma from
    1 cm to 1 m or its mean over pixels, unit length in ranges or in radians, each number by itself) those with unit
    length climb most, nine tenths of the way in 12 steps; plain gradients leap past the top and end below the start;
    none comes within 3 nats in 100 ascents, as steps of fixed length end in a circle about the top.
    difference : 0, or the step of central differences in unit coordinates.
    path, costs : as in `levenberg`, (iterations + 1, ...).
    """
    count, solids = values.shape[0], misfit.kinds.shape[0]
    poses, sizes = np.empty((solids, 4, 4)), np.empty((solids, 3))
    motions, totals = np.empty((count, solids, MOTION)), np.empty((solids, MOTION))
    gradient, scale, active = np.empty(count), np.empty(count), np.ones(solids, np.bool_)
    for p in range(count):
        scale[p] = period[p] if period[p] > 0.0 else min(upper[p] - lower[p], 1.0)
    for n in range(iterations + 1):
        bring(values, lower, upper, period)
        place(placement, values, poses, sizes)
        if difference > 0.0:
            costs[n] = cost_at(misfit, placement, values, poses, sizes)
            differences_at(misfit, placement, values, poses, sizes, scale, difference, gradient)
        else:
            find_motions(placement, values, motions)
            for k in range(solids):
                active[k] = np.any(motions[:, k] != 0.0)
            costs[n] = cost_at(misfit, placement, values, poses, sizes)
            cost_gradient(misfit, poses, sizes, active, edges, totals)
            for p in range(count):
                gradient[p] = 0.0
                for k in range(solids):
                    for c in range(MOTION):
                        gradient[p] += motions[p, k, c] * totals[k, c]
        path[n] = values
        length = 0.0
        for p in range(count):
            length += (gradient[p] * scale[p]) ** 2
        length = math.sqrt(length)
        if length == 0.0:
            path[n:] = values
            costs[n:] = costs[n]
            break
        for p in range(count):
            values[p] -= step * scale[p] * scale[p] * gradient[p] / length
