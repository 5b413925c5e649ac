"""The integral of a density, from draws of it: bridge sampling, with its own error.

Meng and Wong, "Simulating ratios of normalizing constants via a simple identity" (Statistica Sinica 1996). With draws x
of the density p / Z and y of a normalised one g that resembles it, the optimal bridge solves

    Z = mean_y [p / (s1 p + s2 Z g)] / mean_x [g / (s1 p + s2 Z g)],    s1 = n1 / (n1 + n2), s2 = 1 - s1,

n1 being what the draws of p are worth. g is a t distribution fitted to half of the draws and bridged to the other half,
and the other way round, so that no draw is used twice. The relative error is that of Fruehwirth-Schnatter (Econometrics
Journal 2004), and what the two halves differ by.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from derender.sampling.diagnostics import mean_ess

ROUNDS = 100  # of the fixed point's iteration, at most; each halves the error or better
EXACT = 1e-8  # nats between two rounds at which it has converged
LEAST_FREEDOM = 5.0  # degrees of freedom of t: heavier tails than any normal-like density has
ROUNDING = 1e-10  # share of a coordinate's variance by which a covariance is kept from being singular


class Evidence(NamedTuple):
    """An integral."""

    log: float  # its logarithm
    standard_error: float  # of the logarithm


def evidence(
    rng: np.random.Generator,
    target: Callable[[np.ndarray], np.ndarray],
    draws: np.ndarray,
    log_density: np.ndarray,
    count: int,
) -> Evidence:
    """Return the Evidence of a density over R^D.

    target : log densities (m,) of points (m, D).
    draws : (n, D), of the density, in the order of a chain; log_density : (n,), there.
    count : points that are drawn of the fitted density, for each half.
    """
    size = draws.shape[1]
    if size == 0:
        return Evidence(float(target(draws[:1])[0]), 0.0)
    middle = len(draws) // 2
    halves = (slice(0, middle), slice(middle, None))
    found = []
    for fitted, bridged in (halves, halves[::-1]):
        mean, factor = fit(draws[fitted])
        freedom = max(LEAST_FREEDOM, float(size))
        points = draw_t(rng, mean, factor, freedom, count)
        at_draws = log_density[bridged] - log_t(draws[bridged], mean, factor, freedom)
        at_points = target(points) - log_t(points, mean, factor, freedom)
        found.append(bridge(at_draws, at_points))
    logs = [each.log for each in found]
    apart = 0.5 * abs(logs[0] - logs[1])
    within = 0.5 * math.hypot(found[0].standard_error, found[1].standard_error)
    return Evidence(float(np.mean(logs)), max(apart, within))


def bridge(at_draws: np.ndarray, at_points: np.ndarray) -> Evidence:
    """Return the Evidence from log p - log g at draws of p (n1,) and of g (n2,)."""
    shift = float(np.median(at_draws))
    at_draws = np.clip(at_draws - shift, -600.0, 600.0)
    at_points = np.clip(at_points - shift, -600.0, 600.0)
    worth = mean_ess(np.exp(-np.logaddexp(0.0, at_draws))[None])
    worth = len(at_draws) if not np.isfinite(worth) else min(max(worth, 1.0), len(at_draws))
    share = worth / (worth + len(at_points))
    log = 0.0
    for _ in range(ROUNDS):
        first = -np.logaddexp(math.log(share), math.log(1.0 - share) + log - at_points)
        second = -np.logaddexp(math.log(share) + at_draws, math.log(1.0 - share) + log)
        new = _log_mean(first) - _log_mean(second)
        log, before = new, log
        if abs(log - before) < EXACT:
            break
    spread = relative_variance(first) / len(at_points) + relative_variance(second) / worth
    return Evidence(log + shift, math.sqrt(spread))


def _log_mean(logs: np.ndarray) -> float:
    return float(np.logaddexp.reduce(logs) - math.log(len(logs)))


def relative_variance(logs: np.ndarray) -> float:
    """Return Var[w] / E[w]^2 of weights by their logarithms (n,)."""
    weights = np.exp(logs - logs.max())
    return float(weights.var() / max(weights.mean() ** 2, 1e-300))


def fit(draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (D,) of draws (n, D) and the Cholesky factor (D, D) of their covariance."""
    covariance = np.atleast_2d(np.cov(draws.T))
    diagonal = np.maximum(np.diag(covariance), 1e-18)
    return draws.mean(axis=0), np.linalg.cholesky(covariance + ROUNDING * np.diag(diagonal))


def draw_t(rng: np.random.Generator, mean: np.ndarray, factor: np.ndarray, freedom: float, count: int) -> np.ndarray:
    """Return (count, D) draws of a t distribution about `mean` whose scale matrix is factor factor'."""
    normal = rng.standard_normal((count, len(mean)))
    return mean + normal @ factor.T * np.sqrt(freedom / rng.chisquare(freedom, count))[:, None]


def log_t(points: np.ndarray, mean: np.ndarray, factor: np.ndarray, freedom: float) -> np.ndarray:
    """Return the log densities (m,) of that t distribution at points (m, D)."""
    size = len(mean)
    away = np.linalg.solve(factor, (points - mean).T)
    constant = math.lgamma(0.5 * (freedom + size)) - math.lgamma(0.5 * freedom)
    constant -= 0.5 * size * math.log(freedom * math.pi) + float(np.log(np.diag(factor)).sum())
    return constant - 0.5 * (freedom + size) * np.log1p((away**2).sum(axis=0) / freedom)


def shares(
    rng: np.random.Generator, logs: np.ndarray, errors: np.ndarray, draws: int = 1000
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return weights (n,) that sum to one, their standard errors (n,) and 90 % intervals (n, 2), from log evidences.

    errors : (n,) standard errors of the logs, taken as independent and normal.
    """
    logs = np.asarray(logs, float)
    weights = np.exp(logs - np.logaddexp.reduce(logs))
    drawn = logs + np.asarray(errors, float) * rng.standard_normal((draws, len(logs)))
    drawn = np.exp(drawn - np.logaddexp.reduce(drawn, axis=1, keepdims=True))
    spread = np.sqrt(np.mean((drawn - weights) ** 2, axis=0))
    return weights, spread, np.quantile(drawn, [0.05, 0.95], axis=0).T
