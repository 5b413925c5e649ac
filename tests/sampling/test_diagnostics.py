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


# ArviZ's own figures of these cases: bulk, tail and mean ESS, the mean's standard error, R-hat.
OF_ARVIZ = {
    "independent": [4039.14679, 3404.13835, 4040.22416, 0.0157823277, 1.00156993],
    "sticky": [120.699224, 299.930307, 119.247578, 0.0981370069, 1.03964133],
    "antithetic": [4764.13689, 1397.90889, 4764.13689, 0.0143274521, 1.00405819],
    "one chain": [180.663317, 151.666683, 179.681659, 0.0687184034, np.nan],
    "apart": [6.92670845, 45.2020546, 6.80934741, 0.58661732, 1.59767576],
    "ties": [738.746058, 1308.84255, 737.30355, 0.0740145143, 1.00349421],
    "heavy tails": [4015.21656, 3811.30914, 4018.11838, 1.07372404, 1.00018623],
    "short": [12.950175, 12.950175, 12.950175, 0.225207871, 1.04714726],
    "repeats": [239.047078, 224.711535, 240.880796, 0.060080029, 1.02163144],
}


@pytest.mark.parametrize("name, draws", list(cases()), ids=[name for name, _ in cases()])
def test_figures_are_those_that_arviz_gave(name, draws):
    figures = (
        diagnostics.bulk_ess,
        diagnostics.tail_ess,
        diagnostics.mean_ess,
        diagnostics.mean_mcse,
        diagnostics.r_hat,
    )
    np.testing.assert_allclose([figure(draws) for figure in figures], OF_ARVIZ[name], rtol=1e-6)


@pytest.mark.slow  # ArviZ takes four seconds to load
@pytest.mark.parametrize("name, draws", list(cases()), ids=[name for name, _ in cases()])
def test_equal_to_arviz(arviz, name, draws):
    pairs = [
        (diagnostics.bulk_ess(draws), arviz.ess(draws, method="bulk")),
        (diagnostics.tail_ess(draws), arviz.ess(draws, method="tail", prob=(0.05, 0.95))),
        (diagnostics.mean_ess(draws), arviz.ess(draws, method="mean")),
        (diagnostics.mean_mcse(draws), arviz.mcse(draws, method="mean")),
    ]
    if len(draws) > 1:
        pairs.append((diagnostics.r_hat(draws), arviz.rhat(draws)))
    np.testing.assert_allclose([ours for ours, _ in pairs], [float(theirs) for _, theirs in pairs], rtol=1e-6)


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
