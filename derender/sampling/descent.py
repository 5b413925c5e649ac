"""A damped Gauss-Newton step, as Levenberg (1944) and Marquardt (1963) have it, compiled, for all that descend."""

import math

import numpy as np

from derender.compilation.cache import njit

FLAT, SINGULAR = 1e-6, 1e-10  # shares of the largest diagonal element taken for one that is 0, and added to all
NO_LIMITS = np.empty(0)  # of a step's length


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
def damped_step(precision, gradient, damping, held, limits, step):
    """Write the step (n,) by which a cost falls most whose precision (n, n) is damped on its diagonal; return by how
    much it falls were it quadratic, NaN where the damped precision is not positive.

    damping : share of its own that each diagonal element grows by. held : (n,) bool, coordinates that stay.
    limits : lengths of the parts of three coordinates each with which the step begins; it is shortened to the least.
    """
    count, damped, largest = len(step), precision.copy(), 1e-12
    for p in range(count):
        largest = max(largest, precision[p, p])
    for p in range(count):
        damped[p, p] += damping * max(precision[p, p], FLAT * largest) + SINGULAR * largest
    if not solve_positive(damped, gradient, held, step):
        return math.nan
    share = 1.0
    for part in range(len(limits)):
        x, y, z = step[3 * part], step[3 * part + 1], step[3 * part + 2]
        share = min(share, limits[part] / max(math.sqrt(x * x + y * y + z * z), 1e-12))
    foreseen = 0.0
    for p in range(count):
        step[p] *= share
    for p in range(count):
        foreseen -= step[p] * gradient[p]
        for q in range(count):
            foreseen -= 0.5 * step[p] * precision[p, q] * step[q]
    return foreseen
