"""Likelihoods: normalised, and matched by their samplers."""

import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from scipy import stats

from derender.camera.intrinsics import Camera
from derender.errors import DerenderError
from derender.render.blur import blur, blur_radius, blur_taps
from derender.render.likelihoods import likelihoods
from derender.render.raycast.evaluator import DepthEvaluator

CASES = [
    ("gaussian", {}),
    ("robust", {}),
    ("robust", {"sigma_growth": 0.004, "outlier": 0.1}),
    ("robust", {"sigma": 0.01, "flying": 0.4}),
]
# A step of 0.5 m: pixels at an edge and away from one; 3 x 6 pixels.
CLEAN = np.array([[1.0, 1.0, 1.0, 1.5, 1.5, 1.5]] * 3)


def pixel_density(name, values, x):
    """Return exp(log density) of every pixel of CLEAN when all have the value x."""
    observed = np.full(CLEAN.shape, x)
    return np.exp(likelihoods[name].per_pixel(observed, CLEAN, values))


def integral(name, values):
    """Return each pixel's integral over depths plus the atom of no return, by quadrature."""
    near = (c + np.linspace(-0.9, 0.9, 181) for c in (1.0, 1.5))
    breaks = np.unique(np.concatenate([[-3.0, 0.1, 1.0, 1.5, 10.0, 13.0], *near]))
    nodes, weights = leggauss(6)
    total = np.zeros(CLEAN.shape)
    for low, high in zip(breaks, breaks[1:], strict=False):
        for node, weight in zip(nodes, weights, strict=True):
            x = 0.5 * (low + high) + 0.5 * (high - low) * node
            if x > 0:  # below, a pixel counts as without return; no density to speak of lies there
                total += 0.5 * (high - low) * weight * pixel_density(name, values, x)
    if name == "robust":
        total += pixel_density(name, values, np.nan)
    return total


@pytest.mark.parametrize("name, values", CASES)
def test_each_pixel_integrates_to_one(name, values):
    np.testing.assert_allclose(integral(name, values), 1.0, rtol=1e-6)


@pytest.mark.parametrize("name, values", CASES)
def test_the_sampler_matches_the_density(name, values):
    rng = np.random.default_rng(7)
    draws = np.array([likelihoods[name].sample(rng, CLEAN, values) for _ in range(1500)])
    column = 3  # at the edge, where m is 1.5
    values_drawn = draws[:, :, column].ravel()
    if name == "robust":
        expected = pixel_density(name, values, np.nan)[0, column]
        lost = np.isnan(values_drawn)
        assert stats.binomtest(int(lost.sum()), lost.size, expected).pvalue > 1e-4
    found = np.sort(values_drawn[np.isfinite(values_drawn)])
    fine = np.concatenate([1.0 + np.linspace(-0.1, 0.1, 401), 1.5 + np.linspace(-0.5, 0.5, 801)])
    grid = np.unique(np.concatenate([np.linspace(0.0, 12.0, 300), fine]))[1:]
    density = np.array([pixel_density(name, values, x)[0, column] for x in grid])
    steps = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(grid))])
    assert stats.kstest(found, lambda x: np.interp(x, grid, steps / steps[-1])).pvalue > 1e-4


def test_eq_6_by_hand():
    observed = np.array([[1.0, 1.02], [np.nan, 2.0]])
    depth = np.array([[1.01, 1.01], [1.0, np.nan]])
    sigma = 0.02
    expected = stats.norm.logpdf([1.0, 1.02, 2.0], [1.01, 1.01, 3.0], sigma).sum()
    value = likelihoods["gaussian"].log_density(observed, depth, {"sigma": sigma, "background": 3.0})
    assert value == pytest.approx(expected, rel=1e-12)


def test_blur_is_scipys_gaussian_with_replicated_edges():
    from scipy.ndimage import correlate1d

    image = np.random.default_rng(0).uniform(size=(12, 17))
    for sigma in (0.0, 0.3, 1.0, 2.2):
        taps = blur_taps(sigma)
        assert len(taps) == blur_radius(sigma) + 1
        assert taps[0] + 2.0 * taps[1:].sum() == pytest.approx(1.0, abs=1e-15)
        weights = np.concatenate([taps[:0:-1], taps])
        expected = correlate1d(correlate1d(image, weights, 0, mode="nearest"), weights, 1, mode="nearest")
        np.testing.assert_allclose(blur(image, sigma), expected, atol=1e-14)


@pytest.mark.parametrize(
    "values, word",
    [
        ({"sigma": -1.0}, "sigma"),
        ({"nearr": 1.0}, "nearr"),
        ({"near": 2.0, "far": 1.0}, "far"),
        ({"blur": 50.0}, "blur"),
    ],
)
def test_wrong_values_are_named(values, word):
    with pytest.raises(DerenderError, match=word):
        likelihoods["robust"].complete(values)


def test_an_image_of_another_size_is_refused():
    with pytest.raises(DerenderError, match="camera"):
        DepthEvaluator(Camera(75, 75, 39.5, 29.5, 80, 60), np.ones((50, 80)))
