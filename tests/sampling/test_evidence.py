"""Integrals against those that are known, and their own errors against what these really are."""

import math

import numpy as np
import pytest

from derender.sampling import evidence as module
from derender.sampling.evidence import Evidence, evidence, shares

SIZE, DRAWS, REPEATS = 5, 150, 60


def sheared_edge(rng):
    """Return (log density, log integral, draws) of a density with an edge: exponential one way, normal the others."""
    matrix = rng.normal(size=(SIZE, SIZE))
    factor = np.linalg.cholesky(matrix @ matrix.T / SIZE + 0.1 * np.eye(SIZE))

    def target(points):
        own = np.linalg.solve(factor, points.T)
        return np.where(own[0] > 0.0, -own[0], -np.inf) - 0.5 * (own[1:] ** 2).sum(axis=0)

    own = rng.standard_normal((DRAWS, SIZE))
    own[:, 0] = rng.exponential(size=DRAWS)
    log = 0.5 * (SIZE - 1) * math.log(2.0 * math.pi) + float(np.log(np.diag(factor)).sum())
    return target, log, own @ factor.T


def errors():
    """Return (REPEATS, 2) how far off the logarithm is, and the error that is stated."""
    rng = np.random.default_rng(0)
    found = []
    for _ in range(REPEATS):
        target, log, draws = sheared_edge(rng)
        each = evidence(rng, target, draws)
        found.append([each.log - log, each.standard_error])
    return np.array(found)


def test_integrals_are_right_within_the_error_that_is_stated():
    off, stated = errors().T
    assert abs(off.mean()) < 3.0 * off.std() / math.sqrt(REPEATS)
    assert np.mean(np.abs(off) < 2.0 * stated) > 0.85
    assert 0.5 < np.sqrt(np.mean(stated**2)) / off.std() < 2.0


def test_the_check_above_notices_a_wrong_proposal_density(monkeypatch):
    """The broken twin: the density of a normal where a t distribution is drawn from."""

    def log_normal(points, mean, factor, freedom):
        away = np.linalg.solve(factor, (points - mean).T)
        return -0.5 * (away**2).sum(axis=0) - np.log(np.diag(factor)).sum() - 0.5 * len(mean) * math.log(2 * math.pi)

    monkeypatch.setattr(module, "log_t", log_normal)
    off, _ = errors().T
    assert abs(off.mean()) > 4.0 * off.std() / math.sqrt(REPEATS)


def test_modes_that_a_chain_met_out_of_proportion_count_as_they_are():
    """A chain that went over once had four fifths of its draws in the lesser mode: a bridge to them was a nat off."""
    rng, found = np.random.default_rng(2), []
    shares, apart = np.array([0.8, 0.2]), np.array([0.0, 12.0])

    def target(points):
        return np.logaddexp.reduce(
            [math.log(share) - 0.5 * np.square(points - at).sum(axis=1) for share, at in
             zip(shares, apart, strict=True)], axis=0)  # fmt: skip

    for _ in range(20):
        draws = rng.standard_normal((DRAWS, SIZE))
        draws[DRAWS // 5 :] += apart[1]
        each = evidence(rng, target, draws)
        found.append((each.log - 0.5 * SIZE * math.log(2.0 * math.pi), each.standard_error))
    off, stated = np.array(found).T
    assert np.all(np.abs(off) < 4.0 * stated + 0.02) and np.sqrt(np.mean(off**2)) < 0.2


def test_a_round_in_which_a_few_points_have_all_the_weight_can_be_fitted():
    """The sixth largest of 1e-200, to which weights are cut, had no square: shares were no numbers."""
    rng = np.random.default_rng(3)
    mixture = module.about(rng.standard_normal((DRAWS, SIZE)))
    points, under = mixture.draw(rng, 200)
    fitted = module.refitted(mixture, points, under, np.array([1.0, *np.full(199, 1e-200)]))
    assert fitted.shares.sum() == pytest.approx(1.0) and np.isfinite(fitted.spreads).all()


def test_what_is_impossible_everywhere_has_no_integral():
    draws = np.random.default_rng(1).random((50, 2))
    found = evidence(np.random.default_rng(0), lambda p: np.full(len(p), -np.inf), draws)
    assert found == Evidence(-np.inf, np.inf)


def test_an_integral_over_nothing_is_the_density_itself():
    found = evidence(np.random.default_rng(0), lambda p: np.full(len(p), -3.5), np.empty((4, 0)))
    assert found == Evidence(-3.5, 0.0)


def test_shares_have_the_spread_that_errors_of_evidences_make():
    weights, error, interval = shares(np.random.default_rng(0), np.array([0.0, -1.0, -20.0]), np.array([0.0, 0.5, 2.0]))
    assert weights.sum() == pytest.approx(1.0) and weights[1] == pytest.approx(1.0 / (1.0 + math.e), abs=1e-6)
    assert error[1] == pytest.approx(0.5 * weights[0] * weights[1], rel=0.15)  # the derivative of the logistic function
    assert interval[1, 0] < weights[1] < interval[1, 1] and error[2] < 1e-6
