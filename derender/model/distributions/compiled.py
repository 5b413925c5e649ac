"""The built-in distributions for compiled samplers: one dispatch by integer code over rows of four floats.

`log_density(code, row, x)` and `sample(rng, code, row)` compile the very functions that the readable types use; the
same generator gives both the same draws.  Importing this module imports numba.

numba's cache watches this file only, by its content: after a change to a density or a draw, raise REVISION.
"""

import math

from derender.kernel_cache import njit
from derender.model.distributions import (
    beta,
    exponential,
    gamma,
    log_normal,
    log_uniform,
    normal,
    truncated_normal,
    uniform,
    von_mises,
)

REVISION = 1

_uniform = njit(uniform.density)
_normal = njit(normal.density)
_truncated_normal = njit(truncated_normal.density)
_log_normal = njit(log_normal.density)
_log_uniform = njit(log_uniform.density)
_exponential = njit(exponential.density)
_gamma = njit(gamma.density)
_beta = njit(beta.density)
_von_mises = njit(von_mises.density)

_draw_uniform = njit(uniform.draw)
_draw_normal = njit(normal.draw)
_draw_truncated_normal = njit(truncated_normal.draw)
_draw_log_normal = njit(log_normal.draw)
_draw_log_uniform = njit(log_uniform.draw)
_draw_exponential = njit(exponential.draw)
_draw_gamma = njit(gamma.draw)
_draw_beta = njit(beta.draw)
_draw_von_mises = njit(von_mises.draw)


@njit(cache=True, nogil=True)
def log_density(code, row, x):
    """Return the log density at x (float64) of distribution `code` with the row (4,) float64; NaN if there is none."""
    if code == 1:
        return _uniform(x, row)
    if code == 2:
        return _normal(x, row)
    if code == 3:
        return _truncated_normal(x, row)
    if code == 4:
        return _log_normal(x, row)
    if code == 5:
        return _log_uniform(x, row)
    if code == 6:
        return _exponential(x, row)
    if code == 7:
        return _gamma(x, row)
    if code == 8:
        return _beta(x, row)
    if code == 9:
        return _von_mises(x, row)
    return math.nan


@njit(cache=True, nogil=True)
def sample(rng, code, row):
    """Return one draw (float64) by the numpy Generator `rng`: the same number as the readable type draws."""
    if code == 1:
        return _draw_uniform(rng, row)
    if code == 2:
        return _draw_normal(rng, row)
    if code == 3:
        return _draw_truncated_normal(rng, row)
    if code == 4:
        return _draw_log_normal(rng, row)
    if code == 5:
        return _draw_log_uniform(rng, row)
    if code == 6:
        return _draw_exponential(rng, row)
    if code == 7:
        return _draw_gamma(rng, row)
    if code == 8:
        return _draw_beta(rng, row)
    if code == 9:
        return _draw_von_mises(rng, row)
    return math.nan
