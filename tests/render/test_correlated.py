"""Noise that neighbours share: its density against the matrix, its sampler against that, what it makes of steps."""

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import multivariate_normal

from derender import data_path
from derender.cli import group
from derender.detection.calibration import Fit, fit_sensor, log_density, sensor_text
from derender.document import document_from, read_document
from derender.errors import DerenderError
from derender.render.likelihoods import correlated, likelihoods
from derender.render.likelihoods.correlated import offset_variances, tree_log_density, whitened
from derender.render.raycast.evaluator import DepthEvaluator
from derender.scene.codec.yaml_tree import parse_yaml

NOISE = likelihoods["correlated"]
VALUES = NOISE.complete({"sigma": 0.01, "sigma_growth": 0.004, "white": 0.3, "reach": 3.0, "bias": 0.7})
SENSORS = sorted(data_path("sensors").glob("*.yaml"))


def covariance(shape, values):
    """Return the (pixels, pixels) covariance of unit noise, written down directly."""
    places = np.argwhere(np.ones(shape, bool))
    found = values["white"] * np.eye(len(places))
    for level, variance in enumerate(offset_variances(shape, values), start=1):
        block = places // 2**level
        found += variance * (block[:, None] == block[None]).all(axis=-1)
    return found


@pytest.mark.parametrize("shape", [(5, 7), (8, 8), (1, 3), (9, 4)])
def test_the_tree_is_the_normal_density_of_the_matrix(shape):
    rng = np.random.default_rng(0)
    noise = rng.normal(size=shape)
    noise.flat[1] = np.nan
    seen = np.isfinite(noise).ravel()
    matrix = covariance(shape, VALUES)[np.ix_(seen, seen)]
    total, weighted = tree_log_density(noise, VALUES["white"], offset_variances(shape, VALUES))
    assert total == pytest.approx(multivariate_normal(cov=matrix).logpdf(noise.ravel()[seen]), rel=1e-9)
    np.testing.assert_allclose(weighted.ravel()[seen], np.linalg.solve(matrix, noise.ravel()[seen]), atol=1e-9)


def test_a_density_with_depth_is_that_of_the_scaled_matrix_and_a_log_density_is_its_pixels_sum():
    rng = np.random.default_rng(1)
    depth = np.where(np.arange(6) < 3, 0.6, 1.1)[None].repeat(5, axis=0)
    observed = NOISE.sample(rng, depth, VALUES)
    observed[2, 2] = np.nan
    spread = VALUES["sigma"] + VALUES["sigma_growth"] * depth**2
    seen = np.isfinite(observed).ravel()
    matrix = (covariance(depth.shape, VALUES) * np.outer(spread, spread))[np.ix_(seen, seen)]
    expected = multivariate_normal(mean=depth.ravel()[seen], cov=matrix).logpdf(observed.ravel()[seen])
    assert NOISE.log_density(observed, depth, VALUES) == pytest.approx(expected, rel=1e-9)
    assert np.all(NOISE.per_pixel(observed, depth, VALUES).ravel()[~seen] == 0.0)


def test_draws_have_the_covariance_of_the_density():
    """And the density's own expectation: minus its entropy. The broken twin is white noise of the same variance."""
    rng, depth = np.random.default_rng(2), np.full((6, 6), 0.9)
    spread = VALUES["sigma"] + VALUES["sigma_growth"] * 0.81
    draws = np.array([NOISE.sample(rng, depth, VALUES) for _ in range(4000)])
    matrix = covariance(depth.shape, VALUES)
    found = np.cov(((draws - depth) / spread).reshape(len(draws), -1).T)
    assert np.abs(found - matrix).max() < 6.0 * matrix.max() * np.sqrt(2.0 / len(draws))
    logs = np.array([NOISE.log_density(draw, depth, VALUES) for draw in draws[:600]])
    entropy = 0.5 * np.linalg.slogdet(2.0 * np.pi * np.e * matrix * spread**2)[1]
    assert abs(logs.mean() + entropy) < 5.0 * logs.std() / np.sqrt(len(logs))
    white = rng.normal(depth, spread * np.sqrt(matrix[0, 0]), (600, 6, 6))
    assert np.mean([NOISE.log_density(draw, depth, VALUES) for draw in white]) < logs.mean() - 10.0


def test_a_slow_bias_costs_little_and_a_step_keeps_its_evidence():
    """Off by its own noise everywhere a frame is nearly as likely; a step of the same height at an edge is not."""
    rng, depth = np.random.default_rng(3), np.full((64, 64), 0.9)
    values = {"sigma": 0.002, "white": 0.1, "reach": 8.0, "bias": 1.0}
    observed = NOISE.sample(rng, depth, values)
    whole = NOISE.log_density(observed, depth, values)
    biased = whole - NOISE.log_density(observed, depth + 0.002, values)
    step = whole - NOISE.log_density(observed, depth + 0.01 * (np.arange(64) % 16 < 5), values)
    plain = likelihoods["gaussian"]
    assert abs(biased) < 3.0 and step > 300.0
    independent = plain.log_density(observed, observed, {"sigma": 0.002}) - plain.log_density(
        observed, observed + 0.002, {"sigma": 0.002}
    )
    assert independent > 1000.0  # what noise of single pixels would say of the same bias


def test_whitened_differences_are_standard_normal():
    rng, shape = np.random.default_rng(4), (120, 160)
    noise = (NOISE.sample(rng, np.ones(shape), VALUES) - 1.0) / (VALUES["sigma"] + VALUES["sigma_growth"])
    noise[rng.random(shape) < 0.2] = np.nan
    for level, apart in enumerate(whitened(noise, VALUES["white"], offset_variances(shape, VALUES))):
        found = apart[np.isfinite(apart)]
        assert abs(found.std() - 1.0) < 4.0 / np.sqrt(len(found)) + 0.01
        if level < 3:
            assert abs(np.mean(np.abs(found) > 2.5758) - 0.01) < 0.005
    wrong = next(iter(whitened(noise, 0.5 * VALUES["white"], offset_variances(shape, VALUES))))
    assert np.nanstd(wrong) > 1.3  # the broken twin


def test_numbers_of_a_sensor_are_found_again():
    """Those that explain a frame of known noise best explain it as well as the true ones, and are near those."""
    rng, depth = np.random.default_rng(5), np.linspace(0.5, 1.0, 96)[:, None].repeat(128, axis=1)
    true = {"sigma": 0.0005, "sigma_growth": 0.004, "white": 0.1, "reach": 10.0, "bias": 1.0}
    residual = NOISE.sample(rng, depth, true) - depth
    fit = fit_sensor([(residual, depth)])
    assert log_density(residual, depth, fit.values) > log_density(residual, depth, true) - 0.5
    at = [values["sigma"] + values["sigma_growth"] * 0.75**2 for values in (fit.values, true)]
    assert at[0] == pytest.approx(at[1], rel=0.25) and fit.values["white"] == pytest.approx(0.1, abs=0.06)
    assert fit.correlation[0] > 0.6 and abs(fit.correlation[1]) < 0.1 and abs(fit.beyond - 0.01) < 0.005


@pytest.mark.parametrize("path", SENSORS, ids=lambda path: path.stem)
def test_each_sensor_draws_tables_and_calibrate_reads_them(path, tmp_path):
    runner = CliRunner()
    done = runner.invoke(group, ["sample", str(path), "--seed", "1", "-o", str(tmp_path), "-q"])
    assert done.exit_code == 0, done.output
    if path.stem == "active-stereo":  # one is enough for the slow part
        image = str(tmp_path / "sample_000.npz")
        done = runner.invoke(group, ["calibrate", image, "-o", str(tmp_path / "mine.yaml"), "-q"])
        assert done.exit_code == 0, done.output
        assert read_document(tmp_path / "mine.yaml").likelihood.type == "correlated"


def test_what_calibrate_writes_is_a_prior_of_the_fit():
    camera = read_document(SENSORS[0]).camera
    fit = Fit({key: VALUES[key] for key in ("sigma", "sigma_growth", "white", "reach", "bias")}, 1000, (0.9, 0.0), 0.01)
    text = sensor_text(fit, camera, 2)
    document = document_from(parse_yaml(text.encode(), "mine.yaml"), data_path("sensors"))
    middle = {key: value.quantile(0.5) for key, value in document.likelihood.values.items()}
    assert middle == pytest.approx({**fit.values}, rel=0.1)


def test_the_engine_says_that_it_does_not_know_it():
    camera = read_document(SENSORS[0]).camera
    with pytest.raises(DerenderError, match="whole images only"):
        DepthEvaluator(camera, np.ones(camera.shape), "correlated").log_likelihood(
            read_document(SENSORS[0]).prior.sample(np.random.default_rng(0)).solids()
        )
    assert correlated.Correlated.code == -1
