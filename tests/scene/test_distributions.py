"""Every registered distribution: its sampler matches its density, which integrates to one; its compiled twin agrees."""

import math
import pickle

import numpy as np
import pytest
from scipy import integrate, stats

from derender.errors import DerenderError
from derender.scene.distributions import Categorical, distributions, within

CASES = {
    "uniform": [(-0.3, 1.7)],
    "normal": [(0.4, 0.02)],
    "truncated-normal": [
        (0.0, 1.0, -0.5, 2.0),
        (0.0, 1.0, 3.0, 9.0),
        (1.0, 0.1, -5.0, 0.9),
        (0, 1, -0.2, 0.3),
        (0, 1, -300, -0.01),
    ],
    "log-normal": [(0.1, 0.6)],
    "log-uniform": [(0.02, 0.4)],
    "exponential": [(0.3,)],
    "gamma": [(0.7, 2.0), (6.0, 0.1)],
    "beta": [(2.0, 5.0), (1.5, 1.2, -1.0, 3.0)],
    "von-mises": [(1.0, 0.0), (1.0, 3.0, math.pi / 2), (0.1, 400.0, math.pi)],
    "poisson": [(0.4,), (6.0,)],
    "geometric": [(0.3,)],
    "uniform-integer": [(2, 5)],
    "uniform-rotation": [()],
}
SCALAR = [
    (name, row)
    for name in CASES
    for row in CASES[name]
    if not distributions[name].discrete and distributions[name].size == 1
]
DISCRETE = [(name, row) for name in CASES for row in CASES[name] if distributions[name].discrete]


def finite_range(distribution):
    """The support, its infinite ends cut where less than 1e-13 is lost."""
    lower, upper = distribution.support
    return (
        lower if math.isfinite(lower) else distribution.quantile(1e-13),
        upper if math.isfinite(upper) else distribution.quantile(1 - 1e-13),
    )


def total_mass(distribution):
    lower, upper = finite_range(distribution)
    near = [distribution.quantile(p) for p in (0.001, 0.01, 0.1, 0.5, 0.9, 0.99, 0.999)]
    knots = sorted({lower, *near, upper})
    return sum(
        integrate.quad(lambda x: math.exp(distribution.log_density(x)), a, b, epsabs=1e-11, limit=200)[0]
        for a, b in zip(knots, knots[1:], strict=False)
    )


def misfit(distribution, draws):
    """p-value of a Kolmogorov-Smirnov test of the draws against the cdf."""
    return stats.kstest(draws, np.vectorize(distribution.cdf)).pvalue


def test_every_registered_distribution_has_a_case():
    assert set(CASES) | {"categorical"} == set(distributions)


@pytest.mark.parametrize("name,parameters", SCALAR)
def test_density_integrates_to_one_and_is_the_derivative_of_the_cdf(name, parameters):
    distribution = distributions[name](*parameters)
    assert total_mass(distribution) == pytest.approx(1.0, abs=1e-7)  # quadrature's own error near a singular end
    for p in np.linspace(0.03, 0.97, 13):
        x = distribution.quantile(p)
        assert distribution.cdf(x) == pytest.approx(p, abs=1e-9)
        step = 1e-5 * (distribution.quantile(0.9) - distribution.quantile(0.1))
        slope = (distribution.cdf(x + step) - distribution.cdf(x - step)) / (2 * step)
        assert slope == pytest.approx(math.exp(distribution.log_density(x)), rel=1e-4)


@pytest.mark.parametrize("name,parameters", SCALAR)
def test_sampler_matches_density(name, parameters):
    distribution = distributions[name](*parameters)
    rng = np.random.default_rng(11)
    draws = np.array([distribution.sample(rng) for _ in range(4000)])
    lower, upper = distribution.support
    assert (lower <= draws).all() and (draws <= upper).all()
    assert misfit(distribution, draws) > 1e-3  # fixed seed; a true sampler fails once in a thousand seeds
    spread = distribution.quantile(0.75) - distribution.quantile(0.25)
    assert misfit(distribution, draws + 0.1 * spread) < 1e-3, "a sampler shifted by a tenth must be seen"


def test_a_wrong_density_is_seen():
    class Broken(distributions["normal"]):
        density = staticmethod(lambda x, row: -0.5 * ((x - row[0]) / row[1]) ** 2)  # the constant is gone

    assert abs(total_mass(Broken(0.0, 2.0)) - 1.0) > 1


@pytest.mark.parametrize("name,parameters", DISCRETE)
def test_discrete_sampler_matches_density(name, parameters):
    distribution = distributions[name](*parameters)
    numbers = np.arange(60)
    probabilities = np.exp([distribution.log_density(int(k)) for k in numbers])
    assert probabilities.sum() == pytest.approx(1.0, abs=1e-12)
    assert (probabilities * numbers).sum() == pytest.approx(distribution.mean(), abs=1e-9)
    rng = np.random.default_rng(5)
    draws = [distribution.sample(rng) for _ in range(5000)]
    assert all(isinstance(draw, int) for draw in draws)
    assert chi_square(np.bincount(draws, minlength=60)[:60], probabilities) > 1e-3
    assert chi_square(np.bincount(np.array(draws) + 1, minlength=60)[:60], probabilities) < 1e-6
    assert distribution.log_density(0.5) == -math.inf and distribution.log_density(-1) == -math.inf


def chi_square(counts, probabilities):
    """p-value, cells of fewer than five expected pooled."""
    expected = probabilities * counts.sum()
    enough = expected >= 5
    observed = np.append(counts[enough], counts[~enough].sum())
    expected = np.append(expected[enough], max(expected[~enough].sum(), 1e-9))
    if expected[-1] < 1e-3:
        return stats.chisquare(observed[:-1], expected[:-1] * observed[:-1].sum() / expected[:-1].sum()).pvalue * (
            observed[-1] == 0
        )
    return stats.chisquare(observed, expected * observed.sum() / expected.sum()).pvalue


def test_categorical():
    choice = distributions["categorical"]({"+z": 3, "-z": 1, "+x": 0})
    assert choice.choices == ("+z", "-z") and choice.log_density("+x") == -math.inf
    assert math.exp(choice.log_density("+z")) == pytest.approx(0.75)
    rng = np.random.default_rng(2)
    counts = sum(choice.sample(rng) == "+z" for _ in range(4000))
    assert stats.binomtest(counts, 4000, 0.75).pvalue > 1e-3
    assert distributions["categorical"](["a", "b"]) == Categorical({"a": 1, "b": 1})
    for wrong in ({}, {"a": -1.0}, {"a": 0.0}, {"a": math.nan}):
        with pytest.raises(DerenderError):
            Categorical(wrong)


def test_uniform_rotation_is_haar():
    """The angle of a Haar rotation has the cdf (t - sin t) / pi, and its axis is uniform."""
    distribution = distributions["uniform-rotation"]()
    rng = np.random.default_rng(3)
    q = np.array([distribution.sample(rng) for _ in range(4000)])
    np.testing.assert_allclose((q**2).sum(1), 1, atol=1e-12)
    assert (q[:, 0] >= 0).all() and distribution.log_density(q[0]) == 0.0
    angle = 2 * np.arccos(np.clip(q[:, 0], -1, 1))
    assert stats.kstest(angle, lambda t: (t - np.sin(t)) / np.pi).pvalue > 1e-3
    axis = q[:, 1:] / np.linalg.norm(q[:, 1:], axis=1)[:, None]
    for k in range(3):
        assert (
            stats.kstest(axis[:, k], stats.uniform(-1, 2).cdf).pvalue > 1e-3
        )  # Archimedes: each coordinate is uniform
    assert distribution.log_density((1, 1, 0, 0)) == -math.inf


def test_compiled_twins_equal_the_readable_ones():
    from derender.posterior.compiled.prior import density_and_draw

    for name, parameters in SCALAR:
        distribution = distributions[name](*parameters)
        density, draw = density_and_draw(type(distribution))
        row = np.array(distribution.row)
        assert row.shape == (4,)
        here, there = np.random.default_rng(7), np.random.default_rng(7)
        for _ in range(300):
            x = distribution.sample(here)
            assert draw(there, row) == pytest.approx(x, rel=1e-12, abs=1e-15)
            for y in (x, x + 0.7, x - 0.7, 0.0):
                assert density(float(y), row) == pytest.approx(distribution.log_density(y), rel=1e-11, abs=1e-11)


@pytest.mark.parametrize(
    "name, parameters, support",
    [
        ("normal", (0, 1), (-math.inf, math.inf)),
        ("gamma", (2, 1), (0.0, math.inf)),
        ("poisson", (3,), (0.0, math.inf)),
        ("beta", (2, 3, -1, 4), (-1.0, 4.0)),
        ("truncated-normal", (0, 1, -2, 1), (-2.0, 1.0)),
        ("von-mises", (0, 1, 3), (0.0, 3.0)),
    ],
)
def test_the_support_holds_every_draw_and_no_more(name, parameters, support):
    distribution, rng = distributions[name](*parameters), np.random.default_rng(3)
    assert distribution.support == support
    draws = [distribution.sample(rng) for _ in range(300)]
    assert support[0] <= min(draws) and max(draws) <= support[1]
    for outside in (support[0] - 1e-6, support[1] + 1e-6):
        assert math.isinf(outside) or distribution.log_density(outside) == -math.inf


WRONG = [
    ("uniform", (1, 1)),
    ("uniform", (0, math.inf)),
    ("normal", (0, 0)),
    ("normal", (0,)),
    ("normal", (0, 1, 2)),
    ("normal", (math.nan, 1)),
    ("log-uniform", (0, 1)),
    ("log-normal", (0, 1)),
    ("beta", (0, 1)),
    ("gamma", (1, 0)),
    ("exponential", (-1,)),
    ("truncated-normal", (0, 1, 40, 50)),
    ("von-mises", (0, -1)),
    ("poisson", (0,)),
    ("geometric", (1,)),
    ("uniform-integer", (1.5, 3)),
]


@pytest.mark.parametrize("name,parameters", WRONG)
def test_wrong_parameters_are_one_line(name, parameters):
    with pytest.raises(DerenderError) as caught:
        distributions[name](*parameters)
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_distributions_pickle_and_compare():
    for name, parameters in SCALAR:
        distribution = distributions[name](*parameters)
        assert pickle.loads(pickle.dumps(distribution)) == distribution


def test_a_number_outside_is_put_within_by_as_little_as_can_be():
    law = distributions["uniform"](0.02, 0.05)
    assert within(law.support, 0.03) == (0.03, 0.0)
    inside, beyond = within(law.support, 0.07)
    assert law.log_density(inside) > -math.inf and beyond == pytest.approx(0.02, abs=1e-6)
