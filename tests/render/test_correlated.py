"""Noise that neighbours share: its density integrates to one, its sampler is the density's; what misfits cost."""

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.polynomial.legendre import leggauss
from scipy import stats
from scipy.ndimage import gaussian_filter
from scipy.signal import lfilter

from derender import data_path
from derender.camera.intrinsics import Camera
from derender.cli import group
from derender.detection.calibration import Fit, correlation, fit_sensor, residuals, sensor_text
from derender.document import document_from, read_document
from derender.errors import DerenderError
from derender.posterior.forward import observe
from derender.render.likelihoods import likelihoods
from derender.render.likelihoods.correlated import (
    NEIGHBOURS,
    covariance,
    independent_share,
    innovations,
    prediction,
    shown_share,
)
from derender.scene.codec.yaml_tree import parse_yaml

NOISE = likelihoods["correlated"]
VALUES = NOISE.complete({"sigma": 0.01, "sigma_growth": 0.004, "step": 0.004, "step_growth": 0.001,
                         "white": 0.1, "reach": 3.0, "reach_down": 2.0,
                         "shared": 0.8, "clump": 0.5, "outlier": 0.1, "tail": 0.2, "alone": 0.15})  # fmt: skip
CAMERA = Camera(150.0, 150.0, 79.5, 59.5, 160, 120)
SENSORS = sorted(data_path("sensors").glob("*.yaml"))
STEP = np.where(np.arange(7) < 4, 0.8, 1.2)[None].repeat(5, axis=0)  # two surfaces, (5, 7)


def written_down(observed, depth, values):
    """Return the log density of an image, pixel by pixel, by the docstring's words."""
    weights, deviations = prediction(values)
    total = 0.0

    def noise(metres):
        return values["sigma"] + values["sigma_growth"] * metres**2

    def step(metres):
        return values["step"] + values["step_growth"] * metres**2

    def anew(at):
        surface = (1.0 - values["outlier"]) * stats.norm.pdf(observed[at], depth[at], noise(depth[at]))
        return surface, surface + values["outlier"] / (values["far"] - values["near"])

    left, told, tells = {}, 100.0 * np.eye(6), np.zeros(6)
    shares = np.zeros(6)
    for r, c in np.ndindex(observed.shape):
        if c == 0:  # what the rows above told of the weights fades, and they are found by three sweeps
            told, tells = (
                (1 - values["fading"]) * told + 100.0 * values["fading"] * np.eye(6),
                (1 - values["fading"]) * tells,
            )
            for k in 3 * list(range(6)):
                shares[k] += (tells[k] - told[k] @ shares) / told[k, k]
        if np.isnan(observed[r, c]):
            continue
        places = [(r - up, c - left) for up, left in NEIGHBOURS]
        there = [at for at in places if min(at) >= 0 and at[1] < depth.shape[1] and np.isfinite(observed[at])]
        before = [at for at in places[:2] if at in there]
        goes_on = density = 0.0
        if any(at in there for at in places[:4]):
            most = 0.04 * depth[r, c] + 5.0 * noise(depth[r, c])
            near = [1.0 / (1.0 + ((observed[at] - depth[r, c]) / most) ** 4) for at in before]
            shown = [anew(at)[0] / anew(at)[1] for at in before]
            shows = np.dot(shown, near) / len(before) if before else 0.0
            goes_on = values["clump"] + (values["shared"] - values["clump"]) * shows
            some = sum(2**k for k, place in enumerate(places) if place in there)
            mean = sum(weights[k, some] * observed[at] for k, at in enumerate(places) if weights[k, some])
            off = deviations[some] * step(mean)
            over, z = np.array([left.get(at, 0.0) for at in places]), (observed[r, c] - mean) / off
            left[r, c] = np.clip(z, -6.0, 6.0)
            trust, mean = 5.0 / (4.0 + (z - shares @ over) ** 2), mean + off * (shares @ over)
            told, tells = told + trust * np.outer(over, over), tells + trust * left[r, c] * over
            density = (1.0 - values["alone"]) * ((1.0 - values["tail"]) * stats.norm.pdf(observed[r, c], mean, off)
                             + values["tail"] * stats.norm.pdf(observed[r, c], mean, 4.0 * off))  # fmt: skip
            density += values["alone"] * np.mean([stats.t.pdf(observed[r, c], 3, observed[at], 4.0 * step(observed[at]))
                                      for at in places[:4] if at in there])  # fmt: skip
        total += np.log((1.0 - goes_on) * anew((r, c))[1] + goes_on * density)
    return total


def test_it_is_the_density_that_its_description_says():
    rng = np.random.default_rng(0)
    for depth in (np.full((6, 5), 0.9), STEP):
        observed = NOISE.sample(rng, depth, VALUES)
        observed[rng.random(depth.shape) < 0.4] = np.nan
        assert NOISE.log_density(observed, depth, VALUES) == pytest.approx(written_down(observed, depth, VALUES))
        assert np.all(NOISE.per_pixel(observed, depth, VALUES)[np.isnan(observed)] == 0.0)


def test_a_plane_goes_on_as_it_is_and_a_constant_where_too_few_tell_how():
    """In the second row of an image, too: a slanted face was less likely there if it did not show in the first."""
    weights, deviations = prediction(VALUES)
    up, left = np.array(NEIGHBOURS).T
    plane = 0.7 - 0.01 * up + 0.003 * left
    off = abs(plane @ weights - 0.7)
    second_row, in_a_row = sum(2**k for k in range(6) if up[k] < 2), sum(2**k for k in range(6) if up[k] == 0)
    assert max(off[63], off[second_row]) < 1e-9 < min(off[in_a_row], off[7])  # 7: three, which noise would tilt
    assert weights[:, 1:].sum(axis=0) == pytest.approx(1.0)
    assert np.all(np.diff(deviations[[1, 3]]) < 0.0) and np.all(weights[:, 0] == 0.0)


def integral(values, before, row, column, depth):
    """Return the integral over the value of a pixel, given those before it in the order of reading."""
    prefix = before.copy()
    prefix.ravel()[row * depth.shape[1] + column :] = np.nan
    known, total = NOISE.log_density(prefix, depth, values), 0.0
    nodes, weights = leggauss(4)
    around = np.pad(prefix, 2, constant_values=np.nan)[row : row + 3, column : column + 5]
    earlier = around[np.isfinite(around)]
    there = [around[2 - up, 2 - left] for up, left in NEIGHBOURS]
    some = np.isfinite(there) @ 2 ** np.arange(6)
    predicted = np.nan_to_num(there) @ prediction(values)[0][:, some]
    centres = np.unique([*depth.ravel(), *earlier, *np.mean(earlier, keepdims=True), predicted])
    near = np.concatenate([centre + np.linspace(-0.2, 0.2, 61) for centre in centres])
    breaks = np.unique(np.concatenate([[1e-3, 0.1, 10.0, 30.0], np.linspace(0.1, 5.0, 50), near[near > 0.0]]))
    for low, high in zip(breaks, breaks[1:], strict=False):
        for node, weight in zip(nodes, weights, strict=True):
            prefix[row, column] = 0.5 * (low + high) + 0.5 * (high - low) * node
            total += 0.5 * (high - low) * weight * np.exp(NOISE.log_density(prefix, depth, values) - known)
    return total


def test_each_pixel_integrates_to_one_given_all_before_it():
    """So the whole image does, by induction: with outliers, lost pixels and jumps among the earlier ones."""
    observed = NOISE.sample(np.random.default_rng(1), STEP, {**VALUES, "outlier": 1e-9})
    observed[1, 5], observed[3, 1], observed[2, 2] = np.nan, 3.0, 0.7
    for row, column in ((0, 1), (1, 6), (2, 3), (3, 2), (4, 6)):
        assert integral(VALUES, observed, row, column, STEP) == pytest.approx(1.0, abs=1e-3)


def test_draws_are_of_the_density():
    """Each pixel's quantile given those before it is uniform, and independent of its neighbours'."""
    rng = np.random.default_rng(2)
    depth, right = np.where(np.arange(160) < 90, 0.8, 1.2)[None].repeat(120, axis=0), {**VALUES, "outlier": 0.02}
    observed = NOISE.sample(rng, depth, right)

    def failures(values):
        """Return the KS p-value of whitened noise and its greatest correlation with a neighbour's."""
        white = NOISE.whitened(observed, depth, values)
        return stats.kstest(white[np.isfinite(white)], "norm").pvalue, max(
            abs(correlation([white], up, left)) for up, left in ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0))
        )

    fits, shared = failures(right)
    assert fits > 1e-3 and shared < 4.0 / np.sqrt(depth.size)
    for wrong in ({"white": 0.9}, {"sigma": 0.02}, {"step": 0.0025}, {"tail": 0.0}, {"alone": 0.5}, {"outlier": 0.1},
                  {"shared": 0.6}, {"clump": 0.2}):  # fmt: skip
        fits, shared = failures({**right, **wrong})
        assert fits < 1e-3 or shared > 4.0 / np.sqrt(depth.size), wrong  # the broken twins
    others = [{**right, "fading": fading} for fading in (0.02, 0.5, 1.0)]
    assert min(NOISE.log_density(observed, depth, right) - NOISE.log_density(observed, depth, other)
               for other in others) > 5.0  # fmt: skip


def test_what_no_such_covariance_tells_is_learnt_from_the_rows_above():
    """Of noise that goes on from its neighbours alone: it is not white where nothing is learnt, nor as likely."""
    depth = np.full((120, 160), 0.8)
    field = np.random.default_rng(4).standard_normal(depth.shape)
    for axis, share in enumerate((0.5, 0.9)):
        field = lfilter([1.0], [1.0, -share], field, axis)
    observed = depth + 0.01 * field / field.std()
    values = NOISE.complete({"sigma": 0.01, "white": 0.02, "tail": 0.01, "shared": 0.99, "clump": 0.9})
    values["step"] = np.nanstd(innovations(observed, values))
    white = {fading: NOISE.whitened(observed, depth, {**values, "fading": fading}) for fading in (0.1, 1.0)}
    most = {fading: max(abs(correlation([image], *neighbour)) for neighbour in NEIGHBOURS)
            for fading, image in white.items()}  # fmt: skip
    assert most[0.1] < 0.1 and most[1.0] > 0.3
    assert NOISE.log_density(observed, depth, values) > NOISE.log_density(observed, depth, {**values, "fading": 1.0})


def test_many_pixels_tell_their_surface_as_well_as_so_many_independent_ones():
    """The curvature of the log density by the level, at the level that the image was made of."""
    values = {**VALUES, "sigma_growth": 0.0, "step_growth": 0.0, "outlier": 1e-9, "tail": 0.0, "shared": 0.9}
    depth, rng, h = np.full((60, 80), 0.8), np.random.default_rng(6), 0.002
    found = []
    for _ in range(30):
        observed = NOISE.sample(rng, depth, values)
        found.append([NOISE.log_density(observed, depth + way, values) for way in (-h, 0.0, h)])
    low, middle, high = np.mean(found, axis=0)
    told = (2.0 * middle - low - high) / h**2 * values["sigma"] ** 2 / depth.size
    assert told == pytest.approx(independent_share(values), rel=0.5)  # one pixel is not as the next


def test_pixels_that_show_a_solid_are_signs_of_it_by_the_nats_that_they_add():
    """Of a large one, whose rim counts little: per pixel, against what one alone adds under the robust likelihood."""
    values = {
        **VALUES,
        "sigma_growth": 0.0,
        "outlier": 0.01,
        "shared": 0.9,
        "clump": 0.5,
        "sigma": 0.002,
        "step": 0.0005,
    }
    floor, solid = np.full((120, 160), 0.8), np.full((120, 160), 0.8)
    solid[10:110, 10:150] = 0.7
    alone = {name: values[name] for name in ("sigma", "sigma_growth", "outlier")}
    added = [like.log_density(solid, solid, own) - like.log_density(solid, floor, own)
             for like, own in ((NOISE, values), (likelihoods["robust"], alone))]  # fmt: skip
    assert added[0] / added[1] == pytest.approx(shown_share(values), rel=0.3)


def test_what_is_not_as_modelled_costs_something_at_each_pixel_and_far_less_than_one_by_one():
    depth = np.full((48, 64), 0.8)
    bump, white = depth.copy(), likelihoods["robust"]
    bump[10:30, 20:40] = 0.7
    values = {**VALUES, "shared": 0.9, "clump": 0.6, "outlier": 0.01, "sigma": 0.002, "step": 0.001}
    cost = NOISE.log_density(bump, bump, values) - NOISE.log_density(bump, depth, values)
    alone = {name: values[name] for name in ("sigma", "sigma_growth", "outlier")}
    assert 0.3 * 400 < cost < 0.2 * (white.log_density(bump, bump, alone) - white.log_density(bump, depth, alone))


def test_of_what_may_be_hidden_it_makes_no_difference_what_is_behind():
    observed, depth = np.full((7, 7), 0.8), np.full((7, 7), 0.9)
    observed[3, 3] = -0.8
    behind = depth.copy()
    behind[3, 3] = 1.4
    assert NOISE.per_pixel(observed, behind, VALUES)[3, 3] == NOISE.per_pixel(observed, depth, VALUES)[3, 3]
    before = depth.copy()
    before[3, 3] = 0.5
    assert NOISE.per_pixel(observed, before, VALUES)[3, 3] < NOISE.per_pixel(observed, depth, VALUES)[3, 3]


def test_whitened_noise_is_the_density_s_own():
    """Its derivative by a pixel's depth is the density over the normal's: the quantiles are not of something else."""
    rng = np.random.default_rng(4)
    observed, step = NOISE.sample(rng, STEP, VALUES), 1e-7
    for row, column in ((0, 0), (2, 2), (2, 3), (2, 5), (4, 6)):
        ahead, last = observed.copy(), np.zeros(observed.shape, bool)
        ahead.ravel()[row * 7 + column + 1 :] = np.nan
        last[row, column] = True
        at = [NOISE.whitened(np.where(last, ahead + h, ahead), STEP, VALUES)[row, column] for h in (-step, 0.0, step)]
        density = stats.norm.pdf(at[1]) * (at[2] - at[0]) / (2.0 * step)
        assert np.log(density) == pytest.approx(NOISE.per_pixel(ahead, STEP, VALUES)[row, column], abs=1e-4)


def test_numbers_of_a_sensor_are_found_again():
    """Of noise that is a smooth field, not a mixture: of the size of what it scatters by, growing as it; it whitens."""
    rng, depth = np.random.default_rng(5), np.linspace(0.5, 1.0, 96)[:, None].repeat(128, axis=1)
    field = gaussian_filter(rng.standard_normal(depth.shape), (1.0, 2.0))
    field = field / field.std() + 0.2 * rng.standard_normal(depth.shape)
    residual = (0.0005 + 0.004 * depth**2) * field
    fit = fit_sensor([(residual, depth)])
    for metres in (0.6, 0.9):
        scatter = 0.0005 + 0.004 * metres**2
        noise, step = (fit.values[name] + fit.values[f"{name}_growth"] * metres**2 for name in ("sigma", "step"))
        assert 0.5 < noise / scatter < 1.2 and 0.2 < step / scatter < 0.5  # of a mixture those that tell anew alone
    assert fit.correlation[0] > 0.85 and abs(fit.correlation[1]) < 0.25 and 0.6 < fit.beyond < 1.1


def test_a_sensor_s_own_frames_tell_its_numbers(tmp_path):
    """As `derender calibrate` does: the table is found, and what lies among its pixels counts. Pixels that go on drift:
    they scatter three times as much as the noise."""
    true = {"sigma": 0.0005, "sigma_growth": 0.003, "step": 0.0002, "step_growth": 0.0015, "white": 0.2, "reach": 5.0,
            "reach_down": 2.0, "tail": 0.1, "outlier": 0.02}  # fmt: skip
    camera, rng = Camera(150.0, 150.0, 79.5, 59.5, 160, 120), np.random.default_rng(0)
    pairs = []
    for distance in (0.6, 0.9):
        normal = np.array([0.0, -np.sqrt(0.5), -np.sqrt(0.5)])
        table = distance * normal[2] / (camera.rays() @ normal)
        depth = NOISE.sample(rng, table, NOISE.complete(true))
        pairs.append(residuals(depth, camera, "table"))
    found = fit_sensor(pairs).values
    for metres in (0.6, 0.9):
        noise, step = (found[name] + found[f"{name}_growth"] * metres**2 for name in ("sigma", "step"))
        assert noise == pytest.approx(0.0005 + 0.003 * metres**2, rel=0.2)  # one pixel of ten tells it anew
        assert step == pytest.approx(0.0002 + 0.0015 * metres**2, rel=0.1)
    assert found["reach"] == pytest.approx(5.0, rel=0.1) and found["reach_down"] == pytest.approx(2.0, rel=0.1)
    assert found["white"] == pytest.approx(0.2, abs=0.02) and found["tail"] == pytest.approx(0.1, abs=0.05)


def test_of_a_table_whose_depths_were_rounded_the_noise_is_told_and_not_how_often_they_repeat():
    """Of steps of a millimetre neighbours are mostly the same: without a dither none is small enough to be likely."""
    camera, rng = Camera(150.0, 150.0, 79.5, 59.5, 160, 120), np.random.default_rng(7)
    normal = np.array([0.0, -np.sqrt(0.5), -np.sqrt(0.5)])
    table = 0.7 * normal[2] / (camera.rays() @ normal)
    field = gaussian_filter(rng.standard_normal(table.shape), 3.0)
    depth = np.round(table + 0.0005 * field / field.std(), 3)
    fit = fit_sensor([residuals(depth, camera, "table")])
    assert fit.values["step"] + fit.values["step_growth"] * 0.7**2 > 0.001 / np.sqrt(12.0)  # what rounding alone does
    assert abs(fit.correlation[1]) < 0.15


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


def test_calibrate_tells_of_a_camera_that_nobody_gave_and_refuses_another(tmp_path):
    """A field of view of 60 degrees was taken in silence, and frames of two sizes for those of one camera."""
    rng, paths = np.random.default_rng(0), [str(tmp_path / f"{name}.npy") for name in "ab"]
    for path, shape in zip(paths, ((48, 64), (24, 32)), strict=True):
        np.save(path, 1.0 + 0.002 * rng.normal(size=shape))
    done = CliRunner().invoke(group, ["calibrate", *paths])
    assert "--camera is not given: taking 60 degrees" in done.output
    assert (
        str(done.exception) == f"{paths[1]}: it is 32 x 24 pixels, {paths[0]} 64 x 48; calibrate each camera by itself"
    )
    folder = CliRunner().invoke(group, ["calibrate", str(tmp_path)])  # as `infer` takes one; it was "Is a directory"
    assert str(folder.exception) == str(done.exception)


def test_what_calibrate_writes_is_a_prior_of_the_fit():
    camera = read_document(SENSORS[0]).camera
    held = ("sigma", "sigma_growth", "step", "step_growth", "white", "reach", "reach_down", "tail")
    fit = Fit({key: VALUES[key] for key in held}, {}, 1000, (0.9, 0.0), 1.0)
    text = sensor_text(fit, camera, 2)
    document = document_from(parse_yaml(text.encode(), "mine.yaml"), data_path("sensors"))
    middle = {key: value.quantile(0.5) for key, value in document.likelihood.values.items()}
    assert middle == pytest.approx({**fit.values}, rel=0.15)


def test_what_calibrate_writes_is_read_where_a_number_is_the_least():
    """`1e-06` is text to YAML, and half of what was believed of such a step lay below what is allowed: of three in
    seven real frames."""
    fit = Fit({"step": 1e-6, "sigma": 1e-5, "white": 1e-5}, {"sigma": 1e-5}, 1000, (0.9, 0.0), 1.0)
    text = sensor_text(fit, CAMERA, 2)
    document = document_from(parse_yaml(text.encode(), "mine.yaml"), data_path("sensors"))
    white = document.likelihood.values["white"]
    assert document.likelihood.values["step"].quantile(0.5) < 1e-5 and document.likelihood.drawn == {"sigma": 1e-5}
    assert white.quantile(0.9) < 2.0 * white.quantile(0.5)  # a thousand times more was left open, and chains got stuck


def scatter(residuals_of_frames):
    """Return the robust deviation and the quantiles of residuals, how they correlate along rows and columns, and by how
    many times they scatter more in the lower half of an image."""
    every = np.stack(residuals_of_frames)
    off = np.abs(every - np.nanmedian(every))
    halves = [np.nanmedian(np.abs(half)) for half in np.split(every, 2, axis=1)]
    return (
        np.nanquantile(off, [0.5, 0.9, 0.99]),
        [correlation(list(every), *way) for way in ((0, 1), (1, 0), (0, 2))],
        (halves[1] / halves[0]),
    )


@pytest.mark.parametrize("kind", ["smooth", "white, with outliers"])
def test_what_calibrate_writes_draws_noise_like_that_of_the_frames(kind):
    """The density's own draws scattered four times as much: they drift, and their outliers were carried on."""
    rng, depth = np.random.default_rng(8), np.linspace(0.5, 1.0, 96)[:, None].repeat(128, axis=1)

    def frame():
        field = rng.standard_normal(depth.shape)
        if kind == "smooth":
            field = gaussian_filter(field, (1.0, 2.0))
        noise = (0.0005 + 0.004 * depth**2) * field / field.std()
        return noise if kind == "smooth" else np.where(rng.random(depth.shape) < 0.005, 0.3, noise)

    frames = [frame() for _ in range(4)]
    text = sensor_text(fit_sensor([(each, depth) for each in frames]), CAMERA, 2)
    likelihood = document_from(parse_yaml(text.encode(), "mine.yaml"), data_path("sensors")).likelihood
    seen, drawn = scatter(frames), scatter([observe(rng, depth, likelihood) - depth for _ in range(4)])
    assert drawn[0] == pytest.approx(seen[0], rel=0.1)
    assert drawn[1] == pytest.approx(seen[1], abs=0.1) and drawn[2] == pytest.approx(seen[2], rel=0.1)


def test_a_drawn_scene_says_by_which_numbers_its_image_is():
    """Those that are open are drawn with the scene; what is no number of a field is refused."""
    text = "derender: 1\nobjects: {table: {shape: plane, contact: {type: 6dof}}}\n"
    text += "likelihood: {type: TYPE, drawn: {white: OPEN}}"
    open_too = text.replace("TYPE", "correlated").replace("OPEN", "{uniform: [0.1, 0.2]}")
    likelihood = document_from(parse_yaml(open_too.encode(), "x.yaml"), data_path("sensors")).likelihood
    white = likelihood.drawn_by(np.random.default_rng(1)).to_data()["drawn"]["white"]
    assert 0.1 < white < 0.2
    for kind, number, words in (
        ("gaussian", "0.1", "this key is unknown"),
        ("correlated", "3", "white is 3, out of range"),
    ):
        wrong = text.replace("TYPE", kind).replace("OPEN", number)
        with pytest.raises(DerenderError, match=words):
            document_from(parse_yaml(wrong.encode(), "x.yaml"), data_path("sensors"))


def test_a_field_of_noise_has_the_covariance_that_is_said():
    depth, rng = np.full((120, 160), 0.8), np.random.default_rng(9)
    values = {**VALUES, "outlier": 1e-9, "white": 0.3}
    fields = [NOISE.field(rng, depth, values) - depth for _ in range(40)]
    assert np.std(fields) == pytest.approx(0.01 + 0.004 * 0.8**2, rel=0.02)
    for way in ((0, 1), (1, 0), (2, 1), (0, 4)):
        assert correlation(fields, *way) == pytest.approx(covariance(*map(np.array, way), values), abs=0.01)


def test_a_chain_may_go_wherever_a_reach_leads():
    """Nothing is shared within nearly no reach, and nearly all within an endless one: the weights stay finite."""
    for reach in (1e-9, 1e9):
        weights, deviations = prediction({**VALUES, "reach": reach, "reach_down": reach})
        assert np.isfinite(weights).all() and (deviations > 0.0).all()


@pytest.mark.parametrize("way", [(0, -1), (0, 1), (-1, 0), (1, 0)])
def test_an_outline_is_likeliest_where_it_is(way):
    """A solid that reached a pixel too far, to the left or up, hid its outline's cost from those after it."""
    rows, columns = np.indices((30, 40))
    values = {**VALUES, "sigma": 1e-4, "sigma_growth": 0.001, "step": 1e-4, "step_growth": 0.001, "outlier": 1e-4,
              "shared": 0.9, "reach": 2.0, "reach_down": 1.4, "white": 0.03, "tail": 0.06, "alone": 0.1}  # fmt: skip

    def solid(down, right, larger):
        """Return depths of a solid before a farther floor, its outline on one side farther out by so many pixels."""
        top, bottom = 10 - larger * (down < 0), 20 + larger * (down > 0)
        left, end = 12 - larger * (right < 0), 28 + larger * (right > 0)
        inside = (rows >= top) & (rows < bottom) & (columns >= left) & (columns < end)
        return np.where(inside, 0.8, 1.0)

    rng, found = np.random.default_rng(0), []
    for _ in range(10):
        observed = NOISE.field(rng, solid(*way, 0), values)
        found.append([NOISE.log_density(observed, solid(*way, larger), values) for larger in (-1, 0, 1)])
    smaller, right, larger = np.mean(found, axis=0)
    assert right > smaller and right > larger
