"""Whether chains agree and how much they know: R-hat, effective sample sizes, Monte Carlo standard errors.

Vehtari, Gelman, Simpson, Carpenter, Buerkner, "Rank-normalization, folding, and localization: an improved R-hat"
(Bayesian Analysis 2021), without scipy: the figures are ArviZ's to 1e-6 without its second and a half of import.
Every function takes `draws` : (chains, draws) float of one parameter and returns a float, nan for fewer than four draws
or for values that are not finite; `far_apart` judges all parameters.
"""

from functools import lru_cache
from statistics import NormalDist

import numpy as np

from derender.compilation.cache import njit

RESOLUTION = 1e-15  # between the draws of what does not move, at most


def r_hat(draws: np.ndarray) -> float:
    """Return the rank-normalised split R-hat, the larger of bulk and folded. One chain has none: nan."""
    return r_hat_and_ess(draws)[0]


def bulk_ess(draws: np.ndarray) -> float:
    """Return the effective sample size in the bulk: that of the rank-normalised split chains."""
    return r_hat_and_ess(draws)[1]


def r_hat_and_ess(draws: np.ndarray) -> tuple[float, float]:
    """Return `r_hat` and `bulk_ess`, which look at the same ranks."""
    if not _usable(draws):
        return np.nan, np.nan
    halves = _split(draws)
    ranks, folded = _rank_normalise(halves), _rank_normalise(np.abs(halves - np.median(halves)))
    return max(_r_hat(ranks), _r_hat(folded)) if len(draws) > 1 else np.nan, _effective_sample_size(ranks)


def tail_ess(draws: np.ndarray) -> float:
    """Return the effective sample size in the tails: the smaller of those of the 5 % and the 95 % quantile."""
    if not _usable(draws):
        return np.nan
    ends = np.quantile(draws, (0.05, 0.95))
    return min(_effective_sample_size(_split(draws <= end)) for end in ends)


def mean_ess(draws: np.ndarray) -> float:
    """Return the effective sample size for the mean (of the split chains as they are)."""
    return _effective_sample_size(_split(draws)) if _usable(draws) else np.nan


def mean_mcse(draws: np.ndarray) -> float:
    """Return the Monte Carlo standard error of the mean."""
    return float(np.std(draws, ddof=1) / np.sqrt(mean_ess(draws))) if _usable(draws) else np.nan


def unwrap(draws: np.ndarray, period: float | None) -> np.ndarray:
    """Return angles as deviations from their circular mean, within half a period, and that mean added back.

    A chain at theta near 0 and near one period is at one place; taken as a plain number it seems to have two modes.
    The mean is on the turn on which most draws are, as their prior has it, or on the first from 0 up.

    draws : (...) float.
    period : of the parameter, or None for one that lives on a line: then `draws` come back as they are.
    """
    if not period:
        return draws
    turns = np.exp(2j * np.pi * draws / period)
    centre = np.angle(np.mean(turns)) * period / (2 * np.pi)
    centre = within_a_turn(centre + period * np.round((np.median(draws) - centre) / period), period)
    return centre + (draws - centre + period / 2) % period - period / 2


def within_a_turn(angle: float, period: float) -> float:
    """Return an angle, as it is where that is less than a period either way, else on the first turn from 0 up."""
    return angle if abs(angle) <= period else angle % period


def summary(draws: np.ndarray, period: float | None = None) -> dict[str, float]:
    """Return mean, sd, 5/50/95 % quantiles, R-hat, bulk and tail ESS and the MCSE of one parameter."""
    draws = unwrap(np.asarray(draws, float), period)
    low, median, high = np.quantile(draws, (0.05, 0.5, 0.95))
    hat, bulk = r_hat_and_ess(draws)
    return {
        "mean": float(np.mean(draws)),
        "sd": float(np.std(draws, ddof=1)) if draws.size > 1 else 0.0,
        "q05": float(low),
        "median": float(median),
        "q95": float(high),
        "r_hat": hat,
        "ess_bulk": bulk,
        "ess_tail": tail_ess(draws),
        "mcse_mean": mean_mcse(draws),
    }


def _usable(draws: np.ndarray) -> bool:
    return draws.ndim == 2 and draws.shape[1] >= 4 and bool(np.all(np.isfinite(draws)))


def _split(draws: np.ndarray) -> np.ndarray:
    """Return the (2 * chains, draws // 2) halves of the chains; of an odd number the middle draw is left out."""
    half = draws.shape[1] // 2
    return np.concatenate([draws[:, :half], draws[:, -half:]]).astype(float)


def _rank_normalise(draws: np.ndarray) -> np.ndarray:
    """Return the normal scores of the ranks among all draws, ties sharing their average rank (Blom's 3/8)."""
    flat = draws.ravel()
    order = np.argsort(flat, kind="stable")
    ordered = flat[order]
    starts = np.concatenate([[True], ordered[1:] != ordered[:-1]])
    group = np.cumsum(starts) - 1
    first = np.flatnonzero(starts)
    last = np.append(first[1:], len(flat)) - 1
    score = np.empty(len(flat))
    score[order] = _normal_scores(len(flat))[(first + last)[group]]
    return score.reshape(draws.shape)


@lru_cache(maxsize=4)
def _normal_scores(count: int) -> np.ndarray:
    """Return the normal scores of the ranks 1, 1.5, 2 ... count: the same for each parameter of a posterior."""
    probabilities = (np.arange(2, 2 * count + 1) / 2 - 3 / 8) / (count + 1 / 4)
    return np.array([NormalDist().inv_cdf(probability) for probability in probabilities.tolist()])


@njit(cache=True, nogil=True)
def _means(draws):
    """Return the means of chains (chains,), and (chains, draws) how far the draws are from them."""
    means, off = np.zeros(len(draws)), draws.copy()
    for chain in range(len(draws)):
        for value in draws[chain]:
            means[chain] += value / draws.shape[1]
        off[chain] -= means[chain]
    return means, off


@njit(cache=True, nogil=True)
def _covariance(off, lag):
    """Return the biased autocovariance of chains, off their means, the mean of all."""
    total = 0.0
    for own in off:
        for k in range(len(own) - lag):
            total += own[k] * own[k + lag]
    return total / off.size


@njit(cache=True, nogil=True)
def _r_hat(draws):
    """Return the R-hat of chains as they are."""
    chains, count = draws.shape
    means, off = _means(draws)
    within = _covariance(off, 0) * count / (count - 1.0)
    if within == 0.0:
        return np.nan
    between = count * np.var(means) * chains / (chains - 1.0)
    return np.sqrt((between / within + count - 1) / count)


@njit(cache=True, nogil=True)
def _effective_sample_size(draws):
    """Return the effective sample size by Geyer's initial monotone sequence of the averaged autocorrelations, which are
    looked at as far as that goes."""
    chains, count = draws.shape
    total = float(draws.size)
    if draws.max() - draws.min() < RESOLUTION:
        return total
    if count < 2:
        return np.nan
    means, off = _means(draws)
    least = _covariance(off, 0)
    variance = least + (np.var(means) * chains / (chains - 1.0) if chains > 1 else 0.0)
    within = least * count / (count - 1.0)

    rho = np.zeros(count)
    rho[0] = even = 1.0
    rho[1] = odd = 1.0 - (within - _covariance(off, 1)) / variance
    lag = 1
    while lag < count - 3 and even + odd > 0:
        even = 1.0 - (within - _covariance(off, lag + 1)) / variance
        odd = 1.0 - (within - _covariance(off, lag + 2)) / variance
        if even + odd >= 0:
            rho[lag + 1], rho[lag + 2] = even, odd
        lag += 2
    last = lag - 2
    if even > 0:
        rho[last + 1] = even
    for lag in range(1, last - 1, 2):
        if rho[lag + 1] + rho[lag + 2] > rho[lag - 1] + rho[lag]:
            rho[lag + 1] = rho[lag + 2] = (rho[lag - 1] + rho[lag]) / 2
    tau = -1.0 + 2.0 * rho[: last + 1].sum() + rho[last + 1 : last + 2].sum()
    return total / max(tau, 1 / np.log10(total))


FAR = 1.3  # R-hat of chains in modes of their own


def far_apart(values: np.ndarray) -> bool:
    """Whether chains (C, D, N) that have gone on are so far from agreeing that going on again will not help."""
    return any(r_hat(column) > FAR for column in np.moveaxis(values, -1, 0))
