"""Likelihoods: normalised, matched by their samplers, and no surer on a finer image than they say."""

import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from scipy import stats

from derender.camera.intrinsics import Camera
from derender.errors import DerenderError
from derender.render.blur import blur, blur_radius, blur_taps
from derender.render.likelihoods import likelihoods
from derender.render.raycast.depth import render_depth
from derender.render.raycast.evaluator import DepthEvaluator
from derender.scene.pose import rotation_x, translation
from derender.scene.solids import BOX, PLANE, Solids

CASES = [
    ("gaussian", {}),
    ("gaussian", {"effective_pixels": 4.0}),
    ("robust", {}),
    ("robust", {"effective_pixels": 4.0}),
    ("robust", {"sigma_growth": 0.004, "outlier": 0.1}),
    pytest.param("robust", {"sigma_growth": 0.004, "effective_pixels": 9.0, "sigma": 0.02}, marks=pytest.mark.slow),
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
    breaks = np.unique(np.concatenate([[-3.0, 0.1, 10.0, 13.0], *near]))
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
    if name == "gaussian" and values:  # the gaussian counts only pixels with a return; here all of them have one
        assert likelihoods[name].counted_pixels(CLEAN) == CLEAN.size
    # Where sigma grows, the log normaliser of a tempered pixel is a polynomial fitted in depth, good to 3e-4.
    tolerance = 5e-4 if values.get("sigma_growth") and values.get("effective_pixels") else 1e-6
    np.testing.assert_allclose(integral(name, values), 1.0, rtol=tolerance)


def test_the_quadrature_notices_a_wrong_normaliser(monkeypatch):
    """The broken twin: a power without its normaliser does not integrate to one."""
    robust = likelihoods["robust"]
    monkeypatch.setattr(type(robust), "normaliser", lambda *_: np.zeros(8))
    assert np.abs(integral("robust", {"effective_pixels": 4.0}) - 1.0).min() > 0.1


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
    grid = np.unique(np.concatenate([np.linspace(0.0, 12.0, 300), 1.5 + np.linspace(-0.5, 0.5, 801)]))[1:]
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


def cube_on_a_table(shift=0.0):
    root = translation(0.0, 0.05, 0.8) @ rotation_x(np.radians(130.0))
    cube = root @ translation(0.02 + shift, 0.01, 0.05)
    return Solids(
        np.array([PLANE, BOX], np.int32),
        np.array([root, cube]),
        np.array([np.zeros(3), np.full(3, 0.1)]),
        np.array([-1, -1], np.int32),
    )


def posterior_width(name, values, camera, seed):
    """Return the posterior standard deviation of a cube's sideways shift under a flat prior, on a grid."""
    rng = np.random.default_rng(seed)
    clean, _ = render_depth(cube_on_a_table(), camera, antialias=4)
    plain = {key: value for key, value in values.items() if key != "effective_pixels"}
    observed = likelihoods[name].sample(rng, clean, plain)
    evaluator = DepthEvaluator(camera, observed, name, values)
    shifts = np.linspace(-0.03, 0.03, 601)
    log = np.array([evaluator.log_likelihood(cube_on_a_table(shift)) for shift in shifts])
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    mean = weight @ shifts
    return np.sqrt(weight @ (shifts - mean) ** 2)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gaussian", "robust"])
def test_the_posterior_is_as_wide_on_a_finer_image_when_effective_pixels_say_so(name):
    coarse, fine = Camera(75, 75, 39.5, 29.5, 80, 60), Camera(150, 150, 79.5, 59.5, 160, 120)

    # The blur is the same in the world: half a coarse pixel, one fine one.
    def widths(**more):
        return [
            np.mean([posterior_width(name, {"sigma": 0.02, "blur": b, **more}, camera, seed) for seed in range(8)])
            for camera, b in ((coarse, 0.7), (fine, 1.4))
        ]

    tempered = widths(effective_pixels=200.0)
    plain = widths()
    assert tempered[1] == pytest.approx(tempered[0], rel=0.25)
    assert plain[1] < 0.75 * plain[0]  # what effective_pixels is there to prevent: half as wide
    assert tempered[0] > 2.0 * plain[0]


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
