"""The noise of depths from residuals."""

import numpy as np
import pytest

from derender.detection.noise import noise_of, spread_of


def residuals(step, others=0.0, count=20_000):
    """Return noise of 1 mm, rounded to steps, some of it others of up to 2 m instead, and its own spread."""
    rng = np.random.default_rng(0)
    noise = rng.normal(size=count) * 0.001
    if step:
        noise = np.round(noise / step) * step
    return np.where(rng.random(count) < others, rng.uniform(0.0, 2.0, count), noise), noise.std()


@pytest.mark.parametrize("step", [0.0, 0.0005, 0.001, 0.0015, 0.002])
@pytest.mark.parametrize("others", [0.0, 0.1])
def test_spread_is_that_of_the_noise(step, others):
    found, true = residuals(step, others)
    assert spread_of(found) == pytest.approx(true, rel=0.06)  # its own error is .5 % of 20,000 normal numbers


@pytest.mark.parametrize("step", [0.0015, 0.002])
def test_median_does_not_tell_the_spread_of_rounded_noise(step):
    """The broken twin."""
    found, true = residuals(step)
    assert abs(1.4826 * np.median(np.abs(found)) / true - 1.0) > 0.3


def test_a_few_residuals_are_enough():
    assert spread_of(np.zeros(3)) == 0.0
    assert spread_of(np.array([0.3])) == pytest.approx(0.3, rel=0.02)


def test_growth_of_a_rounding_sensor_s_noise():
    rng = np.random.default_rng(1)
    depth = rng.uniform(0.6, 1.4, 20_000)
    true = 0.0005 + 0.0012 * depth**2
    step = 0.002 * depth**2
    residual = np.round((depth + true * rng.normal(size=depth.size)) / step) * step - depth
    sigma, growth = noise_of(residual, depth)
    for near, far in ((0.65, 0.75), (1.2, 1.3)):
        there = (depth > near) & (depth < far)
        assert (sigma + growth * depth[there] ** 2).mean() == pytest.approx(residual[there].std(), rel=0.06)
