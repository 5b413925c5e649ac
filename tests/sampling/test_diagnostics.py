"""Diagnostics against ArviZ, which is only a witness here, and against chains whose effective size is known."""

import numpy as np
import pytest

from derender.sampling import diagnostics


def autoregressive(rng, chains, count, correlation):
    draws = np.empty((chains, count))
    draws[:, 0] = rng.standard_normal(chains)
    for i in range(1, count):
        draws[:, i] = correlation * draws[:, i - 1] + np.sqrt(1 - correlation**2) * rng.standard_normal(chains)
    return draws


def cases():
    rng = np.random.default_rng(1)
    yield "independent", rng.standard_normal((4, 1000))
    yield "sticky", autoregressive(rng, 4, 1500, 0.95)
    yield "antithetic", autoregressive(rng, 3, 501, -0.6)
    yield "one chain", autoregressive(rng, 1, 400, 0.5)
    yield "apart", autoregressive(rng, 4, 300, 0.3) + np.arange(4)[:, None]
    yield "ties", np.round(2 * autoregressive(rng, 4, 1000, 0.7))
    yield "heavy tails", rng.standard_cauchy((4, 1000))
    yield "short", rng.standard_normal((2, 7))
    yield "repeats", np.repeat(rng.standard_normal((4, 60)), 17, axis=1)


@pytest.fixture(scope="module")
def arviz():
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        arviz = pytest.importorskip("arviz")
    numba_switch = getattr(arviz.utils, "Numba", None) if hasattr(arviz, "utils") else None
    if numba_switch:  # ArviZ 0.23's own numba path of mcse does not run under NumPy 2.4
        numba_switch.disable_numba()
    return arviz


@pytest.mark.parametrize("name, draws", list(cases()), ids=[name for name, _ in cases()])
def test_equal_to_arviz(arviz, name, draws):
    pairs = [
        (diagnostics.bulk_ess(draws), arviz.ess(draws, method="bulk")),
        (diagnostics.tail_ess(draws), arviz.ess(draws, method="tail")),
        (diagnostics.mean_ess(draws), arviz.ess(draws, method="mean")),
        (diagnostics.mean_mcse(draws), arviz.mcse(draws, method="mean")),
    ]
    if len(draws) > 1:
        pairs.append((diagnostics.r_hat(draws), arviz.rhat(draws)))
    np.testing.assert_allclose([ours for ours, _ in pairs], [float(theirs) for _, theirs in pairs], rtol=1e-6)


def test_normal_quantile_inverts_the_normal_distribution():
    from scipy.special import ndtri

    probability = np.concatenate([10.0 ** -np.arange(1, 300, 7), np.linspace(1e-3, 1 - 1e-3, 999)])
    np.testing.assert_allclose(diagnostics.normal_quantile(probability), ndtri(probability), rtol=2e-14, atol=1e-16)


def test_known_effective_size():
    """An AR(1) chain of correlation r has ESS N (1 - r) / (1 + r); 100,000 draws give it to a few percent."""
    draws = autoregressive(np.random.default_rng(2), 4, 25_000, 0.8)
    assert diagnostics.bulk_ess(draws) == pytest.approx(draws.size / 9, rel=0.06)


def test_chains_that_disagree_are_seen():
    draws = np.random.default_rng(3).standard_normal((4, 500))
    assert diagnostics.r_hat(draws) < 1.01
    draws[0] += 0.5
    assert diagnostics.r_hat(draws) > 1.02
    draws[0] = 3 * (draws[0] - 0.5)  # same centre, other spread: only the folded ranks see it
    assert diagnostics.r_hat(draws) > 1.02


def test_an_angle_across_its_seam_is_one_mode():
    rng = np.random.default_rng(4)
    angle = (0.02 * rng.standard_normal((4, 500))) % (np.pi / 2)
    assert diagnostics.summary(angle, period=np.pi / 2)["sd"] == pytest.approx(0.02, rel=0.1)
    assert diagnostics.summary(angle)["sd"] > 0.5


@pytest.mark.parametrize("draws", [np.zeros((4, 3)), np.full((4, 10), np.nan)])
def test_too_little_is_nan(draws):
    assert np.isnan([diagnostics.r_hat(draws), diagnostics.bulk_ess(draws), diagnostics.mean_mcse(draws)]).all()
