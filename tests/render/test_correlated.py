"""Noise that neighbours share: its density integrates to one, its sampler is the density's, what it makes of steps."""

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.polynomial.legendre import leggauss
from scipy import stats

from derender import data_path
from derender.cli import group
from derender.detection.calibration import ON_TABLE, Fit, correlation, fit_sensor, log_density, sensor_text
from derender.document import document_from, read_document
from derender.render.likelihoods import likelihoods
from derender.render.likelihoods.correlated import independent_share, prediction, shown_share
from derender.scene.codec.yaml_tree import parse_yaml

NOISE = likelihoods["correlated"]
VALUES = NOISE.complete({"sigma": 0.01, "sigma_growth": 0.004, "white": 0.1, "reach": 3.0, "reach_down": 2.0,
                         "bias": 0.7, "outlier": 0.1, "tail": 0.2})  # fmt: skip
GAUSSIAN = {**VALUES, "outlier": 1e-30, "tail": 0.0}
SENSORS = sorted(data_path("sensors").glob("*.yaml"))
STEP = np.where(np.arange(7) < 4, 0.8, 1.2)[None].repeat(5, axis=0)  # two surfaces, (5, 7)


def matern(rows, columns, values):
    """The covariance of two pixels' unit noise, written down from the docstring."""
    h = np.sqrt((columns / values["reach"]) ** 2 + (rows / values["reach_down"]) ** 2)
    found = (1.0 - values["white"]) * (1.0 + h) * np.exp(-h) + values["bias"] ** 2
    return found + (values["white"] if rows == columns == 0 else 0.0)


def dense(depth, seen, values):
    """Return the covariance (pixels, pixels) of unit noise where pixels return, by the docstring's words, one by one.

    Each is a linear function of earlier ones and a normal number of its own: the product of the densities is that of
    one normal vector.
    """
    height, width = depth.shape
    place = {(r, c): n for n, (r, c) in enumerate(np.ndindex(depth.shape))}
    lower, own = np.eye(height * width), np.ones(height * width)
    for (r, c), n in place.items():

        def tells(up, left, r=r, c=c):
            at = r - up, c - left
            return at in place and seen[at] and abs(depth[at] - depth[r, c]) <= values["jump"] * depth[r, c]

        near = [(up, left) for up, left in ((0, 1), (1, 0)) if tells(up, left)]
        four = [(1, 1), (1, -1), (0, 2), (2, 0)]
        near += four if all(tells(up, left) for up, left in four) else []
        matrix = np.array([[matern(a[0] - b[0], a[1] - b[1], values) for b in near] for a in near]).reshape(
            len(near), len(near)
        )
        with_it = np.array([matern(a[0], a[1], values) for a in near])
        weights = np.linalg.solve(matrix, with_it) if near else np.zeros(0)
        own[n] = matern(0, 0, values) - weights @ with_it
        for weight, (up, left) in zip(weights, near, strict=True):
            lower[n, place[r - up, c - left]] = -weight
    inverse = np.linalg.inv(lower)
    some = seen.ravel()
    return (inverse * own @ inverse.T)[np.ix_(some, some)]


def test_without_outliers_it_is_the_normal_density_of_a_matrix():
    rng = np.random.default_rng(0)
    for depth in (np.full((6, 5), 0.9), STEP):
        spread = GAUSSIAN["sigma"] + GAUSSIAN["sigma_growth"] * depth**2
        seen = rng.random(depth.shape) > 0.15
        observed = np.where(seen, depth + spread * rng.normal(size=depth.shape), np.nan)
        about = GAUSSIAN["sigma"] + GAUSSIAN["sigma_growth"] * depth * observed  # by the depth, and by the observed one
        residual = ((observed - depth) / about)[seen]
        expected = stats.multivariate_normal(cov=dense(depth, seen, GAUSSIAN)).logpdf(residual)
        expected += np.log(spread[seen] / about[seen] ** 2).sum()
        assert NOISE.log_density(observed, depth, GAUSSIAN) == pytest.approx(expected, rel=1e-9)
        assert np.all(NOISE.per_pixel(observed, depth, GAUSSIAN)[~seen] == 0.0)


def test_neighbours_correlate_as_the_field_does():
    """Six neighbours tell nearly what all earlier ones do: near ones' correlations in mid-image are within a tenth."""
    shape = (9, 9)
    found = dense(np.full(shape, 0.9), np.ones(shape, bool), GAUSSIAN)
    found /= np.sqrt(np.outer(np.diag(found), np.diag(found)))
    middle = 4 * 9 + 4
    for rows, columns in ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0), (2, 2)):
        expected = matern(rows, columns, GAUSSIAN) / matern(0, 0, GAUSSIAN)
        assert found[middle, middle + 9 * rows + columns] == pytest.approx(expected, abs=0.1)


EDGES = {**VALUES, "edge": 1.6, "flying": 0.25}  # where either surface may show


def integral(values, before, row, column, depth):
    """Return the integral over the value of a pixel, given those before it in the order of reading."""
    prefix = before.copy()
    prefix.ravel()[row * depth.shape[1] + column :] = np.nan
    known, total = NOISE.log_density(prefix, depth, values), 0.0
    nodes, weights = leggauss(4)
    near = np.concatenate([side + np.linspace(-0.35, 0.35, 71) for side in np.unique(depth)])
    breaks = np.unique(np.concatenate([[0.05, 0.1, 10.0], near, np.unique(depth)]))
    for low, high in zip(breaks, breaks[1:], strict=False):
        for node, weight in zip(nodes, weights, strict=True):
            prefix[row, column] = 0.5 * (low + high) + 0.5 * (high - low) * node
            total += 0.5 * (high - low) * weight * np.exp(NOISE.log_density(prefix, depth, values) - known)
    return total


def test_each_pixel_integrates_to_one_given_all_before_it():
    """So the whole image does, by induction: with outliers, lost pixels and jumps among the earlier ones."""
    rng = np.random.default_rng(1)
    observed = NOISE.sample(rng, STEP, VALUES)
    observed[1, 5], observed[3, 1], observed[2, 2] = np.nan, 3.0, 0.7
    for values in (VALUES, EDGES):
        for row, column in ((0, 1), (1, 4), (2, 3), (3, 2), (3, 3), (4, 6), (4, 4)):
            assert integral(values, observed, row, column, STEP) == pytest.approx(1.0, abs=1e-5)


def test_two_pixels_integrate_to_one():
    """Both at once, so that what the first tells of the second, or as an outlier does not, is integrated over too."""
    (nodes, weights), spread = leggauss(6), VALUES["sigma"] + VALUES["sigma_growth"] * 0.8**2
    outlier = 12.0 * np.hypot(1.0, VALUES["bias"]) * spread  # a jump of the density: the first tells the second nothing
    breaks = np.unique([0.1, 0.5, 1.5, 10.0, *(0.8 + np.linspace(-0.2, 0.2, 41)), 0.8 - outlier, 0.8 + outlier])
    parts = list(zip(breaks, breaks[1:], strict=False))
    x = np.concatenate([0.5 * (a + b) + 0.5 * (b - a) * nodes for a, b in parts])
    w = np.concatenate([0.5 * (b - a) * weights for a, b in parts])
    pairs = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    image = np.full((2 * len(pairs), 2), np.nan)  # a pair in each second row: lost rows keep them apart
    image[::2] = pairs
    density = np.exp(NOISE.per_pixel(image, np.full(image.shape, 0.8), VALUES)[::2].sum(axis=1))
    assert np.multiply.outer(w, w).ravel() @ density == pytest.approx(1.0, abs=1e-5)


def test_draws_are_of_the_density():
    """Each pixel's quantile given those before it is uniform, and independent of its neighbours'."""
    rng = np.random.default_rng(2)
    depth = np.where(np.arange(160) < 90, 0.8, 1.2)[None].repeat(120, axis=0)
    observed = NOISE.sample(rng, depth, VALUES)

    def failures(values):
        """Return the KS p-value of whitened noise and its greatest correlation with a neighbour's."""
        white = NOISE.whitened(observed, depth, values)
        return stats.kstest(white[np.isfinite(white)], "norm").pvalue, max(
            abs(correlation([white], up, left)) for up, left in ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0))
        )

    fits, shared = failures(VALUES)
    assert fits > 1e-3 and shared < 4.0 / np.sqrt(depth.size)
    for wrong in ({"white": 0.3}, {"sigma": 0.012}, {"reach": 1.5}, {"tail": 0.0}, {"outlier": 0.02}):
        fits, shared = failures({**VALUES, **wrong})
        assert fits < 1e-3 or shared > 4.0 / np.sqrt(depth.size), wrong  # the broken twins


def test_draws_beside_a_jump_show_either_surface_as_the_density_says():
    depth = np.where(np.arange(160) % 16 < 8, 0.8, 1.2)[None].repeat(120, axis=0)
    observed = NOISE.sample(np.random.default_rng(4), depth, EDGES)
    beside = (np.abs(depth - np.roll(depth, 1, axis=1)) + np.abs(depth - np.roll(depth, -1, axis=1)))[:, 1:-1] > 0.1
    other = (np.abs(observed - depth) > 0.25)[:, 1:-1]
    expected = 0.9 * (0.5 * (0.75 + 0.25 * 0.4)) + 0.1 * 0.95  # half of them, a quarter of these between; outliers
    assert other[beside].mean() == pytest.approx(expected, abs=0.03) and other[~beside].mean() < 0.25

    def fits(values):
        white = NOISE.whitened(observed, depth, values)[:, 1:-1]
        return stats.kstest(white[beside], "norm").pvalue

    assert fits(EDGES) > 1e-3
    for wrong in ({"edge": 0.0}, {"edge": 0.6}, {"flying": 0.0}):
        assert fits({**EDGES, **wrong}) < 1e-3, wrong


def test_a_silhouette_that_is_a_pixel_off_costs_little_where_either_surface_may_show():
    """As little as the pixels beside it are worth, not what outliers cost."""
    depth = np.where(np.arange(64) < 30, 0.8, 1.2)[None].repeat(48, axis=0)
    observed = np.where(np.arange(64) < 31, 0.8, 1.2) + 0.0 * depth
    off, at = ([NOISE.log_density(observed, d, {**VALUES, "edge": e}) for e in (0.0, 1.0)]
               for d in (depth, observed))  # fmt: skip
    assert at[0] - off[0] > 6.0 * 48 and at[1] - off[1] < 3.0 * 48


def test_the_mean_of_many_pixels_is_as_sure_as_that_of_so_many_independent_ones():
    values = {**GAUSSIAN, "bias": 0.0, "sigma_growth": 0.0, "outlier": 1e-9}
    rng, depth = np.random.default_rng(6), np.full((80, 100), 0.8)
    means = [NOISE.sample(rng, depth, values).mean() for _ in range(100)]
    expected = values["sigma"] ** 2 / (independent_share(values) * depth.size)
    assert 0.7 < np.var(means) / expected < 2.0  # a third more: six neighbours do not tell all; and chance, a seventh


def test_the_mean_square_of_many_pixels_is_as_sure_as_that_of_the_independent_values_that_they_show():
    """Of n independent normal values the mean square has the variance 2 / n; so few as tell the mean are too few."""
    values = {**GAUSSIAN, "bias": 0.0, "sigma_growth": 0.0, "outlier": 1e-9}
    rng, depth = np.random.default_rng(8), np.full((80, 100), 0.8)
    squares = [np.mean(((NOISE.sample(rng, depth, values) - depth) / values["sigma"]) ** 2) for _ in range(100)]
    found = 2.0 / np.var(squares) / depth.size
    assert found == pytest.approx(shown_share(values), rel=0.5)  # a seventh by chance; six neighbours do not tell all
    assert found > 1.5 * independent_share(values)


def test_of_what_may_be_hidden_no_neighbour_tells():
    """It is as probable whatever the surface before it does; one that is seen is not."""
    for held, alike in ((-0.5, True), (0.8, False)):
        found = []
        for level in (0.8, 0.82):
            observed = np.full((7, 7), level)
            observed[3, 3] = held
            found.append(NOISE.per_pixel(observed, np.full((7, 7), 0.8), VALUES)[3, 3])
        assert (found[0] == pytest.approx(found[1], abs=1e-9)) == alike


def test_a_surface_that_bends_off_costs_at_its_rim_alone():
    """So that no level wins by which more of it lies within some limit: eight deviations inside cost what none do."""
    depth, at = np.full((48, 48), 0.8), np.s_[16:32, 16:32]
    bump = depth.copy()
    bump[at] += 8.0 * (VALUES["sigma"] + VALUES["sigma_growth"] * 0.8**2)
    inside = (slice(20, 30), slice(20, 30))
    flat, bent = (NOISE.per_pixel(image, depth, VALUES)[inside].mean() for image in (depth, bump))
    assert flat - bent < 0.5


def test_whitened_noise_is_the_density_s_own():
    """Its derivative by a pixel's depth is the density over the normal's: the quantiles are not of something else."""
    rng = np.random.default_rng(3)
    observed, step = NOISE.sample(rng, STEP, EDGES), 1e-7
    for row, column in ((0, 0), (2, 2), (2, 3), (2, 5), (4, 6)):
        ahead, last = observed.copy(), np.zeros(observed.shape, bool)
        ahead.ravel()[row * 7 + column + 1 :] = np.nan
        last[row, column] = True
        at = [NOISE.whitened(np.where(last, ahead + h, ahead), STEP, EDGES)[row, column] for h in (-step, 0.0, step)]
        density = stats.norm.pdf(at[1]) * (at[2] - at[0]) / (2.0 * step)
        assert np.log(density) == pytest.approx(NOISE.per_pixel(ahead, STEP, EDGES)[row, column], abs=1e-4)


def test_a_slow_bias_costs_little_and_a_step_keeps_its_evidence():
    """Off by its own noise everywhere a frame is nearly as likely; a step of the same height at an edge is not."""
    rng, depth = np.random.default_rng(3), np.full((64, 64), 0.9)
    values = {"sigma": 0.002, "white": 0.02, "reach": 4.0, "reach_down": 4.0, "bias": 1.0}
    observed = NOISE.sample(rng, depth, values)
    whole = NOISE.log_density(observed, depth, values)
    biased = whole - NOISE.log_density(observed, depth + 0.001, values)
    step = whole - NOISE.log_density(observed, depth + 0.01 * (np.arange(64) % 16 < 5), values)
    plain = likelihoods["gaussian"]
    independent = plain.log_density(observed, observed, {"sigma": 0.002}) - plain.log_density(
        observed, observed + 0.001, {"sigma": 0.002}
    )
    assert abs(biased) < 0.1 * independent and step > 300.0


def test_numbers_of_a_sensor_are_found_again():
    """Those that explain a frame of known noise best explain it as well as the true ones, and whiten it."""
    rng, depth = np.random.default_rng(5), np.linspace(0.5, 1.0, 96)[:, None].repeat(128, axis=1)
    true = NOISE.complete({"sigma": 0.0005, "sigma_growth": 0.004, "white": 0.05, "reach": 5.0, "reach_down": 2.0,
                           "outlier": ON_TABLE})  # fmt: skip
    residual = NOISE.sample(rng, depth, true) - depth
    fit = fit_sensor([(residual, depth)])
    assert log_density(residual, depth, {**true, **fit.values}) > log_density(residual, depth, true) - 1.0
    assert fit.correlation[0] > 0.6 and abs(fit.correlation[1]) < 0.05 and abs(fit.beyond - 1.0) < 0.05


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
    held = ("sigma", "sigma_growth", "white", "reach", "reach_down", "bias", "tail")
    fit = Fit({key: VALUES[key] for key in held}, 1000, (0.9, 0.0), 1.0)
    text = sensor_text(fit, camera, 2)
    document = document_from(parse_yaml(text.encode(), "mine.yaml"), data_path("sensors"))
    middle = {key: value.quantile(0.5) for key, value in document.likelihood.values.items()}
    assert middle == pytest.approx({**fit.values}, rel=0.15)


def test_a_chain_may_go_wherever_a_reach_leads():
    """Nothing is shared within nearly no reach, and nearly all within an endless one: the weights stay finite."""
    for reach in (1e-9, 1e9):
        weights, deviations = prediction({**VALUES, "reach": reach, "reach_down": reach, "bias": 0.0})
        assert np.isfinite(weights).all() and (deviations > 0.0).all()
        assert weights[:, 7].sum() == pytest.approx(0.0 if reach < 1.0 else 1.0, abs=0.03)
