"""The integral of a density, from draws of it, with its own error.

Importance sampling that adapts: Cappe, Guillin, Marin and Robert, "Population Monte Carlo" (Journal of Computational
and Graphical Statistics 2004). Points x are drawn of a mixture g of t distributions and weighed by w = p(x) / g(x). The
mixture begins where the draws lie and is fitted to the weighed points, round after round, until these are worth ENOUGH
independent draws. The mean weight of the last round, which no fit has seen, is the integral. Of more than a dozen
coordinates too many points are needed; a bridge to a chain that had not met several modes in proportion was too low.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

# Points of the first round, for each coordinate and at least; times as many in each round; and rounds at most.
POINTS, LEAST, GROWTH, ADAPTATIONS = 50, 200, 1.3, 6
ENOUGH = 50.0  # independent draws that a round's points are to be worth: a seventh of a nat
# Pieces of a chain about which parts of the mixture lie at first, the share of a part's spread that is its piece's own
# and not that of all draws, and times theirs that of one more part.
PIECES, OWN, WIDE = 4, 0.8, 6.0
# Times its points' covariance a part is wide later; its least share; points for each coordinate that its former place
# counts as; and weights that are cut to the next.
WIDER, LEAST_SHARE, HELD, CUT = 1.3, 0.05, 2.0, 5
LEAST_FREEDOM = 5.0  # degrees of freedom of t: heavier tails than any normal-like density has
ROUNDING = 1e-10  # share of a coordinate's variance by which a covariance is kept from being singular


class Evidence(NamedTuple):
    """An integral."""

    log: float  # its logarithm
    standard_error: float  # of the logarithm


class Mixture(NamedTuple):
    """A mixture of K t distributions over R^D."""

    shares: np.ndarray  # (K,), which sum to 1
    means: np.ndarray  # (K, D)
    spreads: np.ndarray  # (K, D, D), their scale matrices
    freedom: float  # degrees

    def draw(self, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return points (count, D), and the log densities (K, count) there of the parts times their shares."""
        factors = np.linalg.cholesky(self.spreads)
        parts = list(zip(self.means, factors, rng.multinomial(count, self.shares), strict=True))
        points = np.concatenate([draw_t(rng, mean, factor, self.freedom, many) for mean, factor, many in parts])
        own = [log_t(points, mean, factor, self.freedom) for mean, factor, _ in parts]
        return points, np.log(self.shares)[:, None] + own


def evidence(
    rng: np.random.Generator, target: Callable[[np.ndarray], np.ndarray], draws: np.ndarray,
    enough: float = ENOUGH, rounds: int = ADAPTATIONS,
) -> Evidence:  # fmt: skip
    """Return the Evidence of a density over R^D.

    target : log densities (m,) of points (m, D). draws : (n, D), of the density, in the order of a chain.
    enough : independent draws that the last round's points are to be worth, if that is reached in so many `rounds`.
    """
    if draws.shape[1] == 0:
        return Evidence(float(target(draws[:1])[0]), 0.0)
    mixture, found = about(draws), Evidence(-np.inf, np.inf)
    first = max(POINTS * draws.shape[1], LEAST)
    for count in (first * GROWTH ** np.arange(rounds)).astype(int):
        points, under = mixture.draw(rng, count)
        logs = target(points) - np.logaddexp.reduce(under, axis=0)
        most = logs.max()
        if most == -np.inf:  # all are impossible
            mixture = mixture._replace(spreads=mixture.spreads / WIDER**2)
            continue
        weights = np.exp(logs - most)
        former, log, worth = found.log, float(most + math.log(weights.mean())), worth_of(weights)
        still_rising = 0.5 * abs(log - former) if former > -np.inf else 0.0  # the rounds have not met all of it
        found = Evidence(log, max(math.sqrt(max(1.0 / worth - 1.0 / count, 0.0)), still_rising))
        if worth >= enough:
            break
        mixture = refitted(mixture, points, under, weights)
    return found


def about(draws: np.ndarray) -> Mixture:
    """Return the Mixture whose parts lie about the pieces of a chain's draws (n, D), each of which may have stayed in
    one mode of several, and one about all of them."""
    mean, factor = fit(draws)
    pieces, spread = np.array_split(draws, PIECES), factor @ factor.T
    means = np.array([*(piece.mean(axis=0) for piece in pieces), mean])
    own = [OWN * np.atleast_2d(np.cov(piece.T)) + (1.0 - OWN) * spread for piece in pieces]
    shares = np.full(len(means), 1.0 / len(means))
    return Mixture(shares, means, np.array([*own, WIDE * spread]), max(LEAST_FREEDOM, float(draws.shape[1])))


def refitted(mixture: Mixture, points: np.ndarray, under: np.ndarray, weights: np.ndarray) -> Mixture:
    """Return the Mixture fitted to points (m, D) with weights (m,), each part by as much as its points are worth.

    under : see `Mixture.draw`.
    """
    most = np.partition(weights, -CUT - 1)[-CUT - 1]
    weights = np.minimum(weights, most) / most if most > 0.0 else weights  # in a first round a few would have it all
    worth = worth_of(weights)
    each = np.exp(under - np.logaddexp.reduce(under, axis=0)) * weights / weights.sum()
    means, spreads = mixture.means.copy(), mixture.spreads.copy()
    for k, own in enumerate(each):
        share = max(own.sum(), 1e-300)
        told = share * worth / (share * worth + HELD * points.shape[1])
        mean = own @ points / share
        spread = (points - mean).T * own @ (points - mean) / share
        means[k] += told * (mean - means[k])
        spreads[k] += told * (WIDER * spread - spreads[k])
    shares = np.maximum(each.sum(axis=1), LEAST_SHARE)
    return Mixture(shares / shares.sum(), means, spreads, mixture.freedom)


def worth_of(weights: np.ndarray) -> float:
    """Return how many independent draws points with these weights (m,) are worth."""
    return float(weights.sum() ** 2 / np.square(weights).sum())


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
