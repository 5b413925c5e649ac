"""A sensor's noise, its growth and outliers are fitted to each structure, not integrated over: what that changes."""

import itertools

import numpy as np
import pytest
from test_graph_posterior import camera, floor_pose, observe, row

from derender.detection.solids.beliefs import Rules, bare_image
from derender.detection.solids.polish import UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.document import LikelihoodPrior
from derender.render.likelihoods import likelihoods
from derender.scene.solids import BOX, CYLINDER
from derender.structures.draws.chart import SIZE
from derender.structures.draws.metropolis import engine_of, load
from derender.structures.draws.refined import Refined, at_mode, height, over_blur
from derender.structures.draws.sensor import (
    MOST_FLYING,
    Noise,
    blurs_about,
    final_sensor,
    first_sensor,
    model_depth,
    same_sensor_refitted,
)
from derender.structures.weighing import with_own_sensor

RULES, PRIOR = Rules(0.0015), bare_image().sensor
TRUE = {"sigma": 0.002, "sigma_growth": 0.004, "blur": 0.5, "outlier": 0.01, "missing": 0.05, "missing_edge": 0.05}
SPREADS = np.exp(np.linspace(-0.4, 0.4, 17))
GROWTHS = np.linspace(0.0, 0.012, 25)
OUTLIERS = np.exp(np.linspace(-2.0, 1.5, 15))


def integrated(refined):
    """Return the log integral of likelihood and prior over sigma, growth and outliers, by a grid about true ones."""
    sensor = refined.sensor
    clean = model_depth(refined.chart, refined.values, sensor.camera)
    logs = []
    for spread, growth, rate in itertools.product(SPREADS, GROWTHS, OUTLIERS):
        values = {"sigma": TRUE["sigma"] * spread, "sigma_growth": growth, "outlier": TRUE["outlier"] * rate}
        changed = sensor.changed(**values)
        logs.append(sensor.likelihood.log_density(sensor.observed, clean, changed.values) + changed.log_prior()
                    + np.log(values["sigma"] * values["outlier"]))  # fmt: skip  # a grid in logarithms
    return np.logaddexp.reduce(logs)


@pytest.mark.slow  # ten seconds: thirteen thousand images
@pytest.mark.parametrize("other", [(BOX, (0.08, 0.085, 0.078)), (CYLINDER, (0.09, 0.09, 0.08))])
def test_numbers_of_the_sensor_take_about_the_same_from_every_structure(other):
    """Fitted or integrated over, the odds of two structures are the same to half a nat (they were to .30 and .37)."""
    rng = np.random.default_rng(1)
    cube = State().add(row(BOX, 0.5, 0.0, 0.0, 0.0, (0.08,) * 3), UPRIGHT, True, FLOOR, 0.0)
    sensor, _, _ = observe(rng, cube, TRUE, camera(32, 24), "robust")
    sensor = sensor._replace(prior=PRIOR)
    rival = State().add(row(other[0], 0.5, 0.0, 0.0, 0.0, other[1]), UPRIGHT, False, FLOOR, 0.0)
    modes = [with_own_sensor(rng, at_mode(rng, state, floor_pose(), sensor, RULES), [0], -1e9)
             for state in (cube, rival)]  # fmt: skip
    fitted = [mode.log_likelihood + mode.sensor.log_prior() for mode in modes]
    whole = [integrated(mode) for mode in modes]
    assert abs((fitted[0] - fitted[1]) - (whole[0] - whole[1])) < 0.5


def fits(kind, given):
    """Return the first, final and again refitted Sensor of a cube's image, and its (chart, values), by a prior."""
    cube = State().add(row(BOX, 0.5, 0.0, 0.0, 0.0, (0.08,) * 3), UPRIGHT, True, FLOOR, 0.0)
    seen, chart, values = observe(np.random.default_rng(1), cube, {"sigma": 0.002, "blur": 0.5}, camera(32, 24))
    first = first_sensor(seen.camera, seen.observed, chart, values, LikelihoodPrior(kind, given))
    final = final_sensor(first, chart, values)
    return first, final, same_sensor_refitted(final, chart, values), chart, values


@pytest.mark.parametrize("kind", ["robust", "gaussian"])
def test_numbers_of_the_sensor_that_a_file_gives_hold(kind):
    given = {"sigma": 0.006, "blur": 0.75}
    if kind == "robust":
        given |= {"sigma_growth": 0.001, "outlier": 3e-4, "missing": 0.01}
    first, final, again, chart, values = fits(kind, given)
    assert final.likelihood.name == again.likelihood.name == kind
    for sensor in (first, final, again):
        assert {name: sensor.values[name] for name in given} == given
    assert blurs_about(final, model_depth(chart, values, final.camera)).tolist() == [0.75]
    mode = refined_at_mode(final, chart, values)
    alone = over_blur(np.random.default_rng(2), mode, (), values[None])
    assert alone.log == 0.0  # there is no other to be integrated over
    free = fits("robust", dict(PRIOR.values))[1]
    assert free.values["sigma"] == pytest.approx(0.002, rel=0.1)


def refined_at_mode(sensor, chart, values):
    cube = State().add(row(BOX, 0.5, 0.0, 0.0, 0.0, (0.08,) * 3), UPRIGHT, True, FLOOR, 0.0)
    return Refined(cube, chart, values, sensor, *load(engine_of(chart, sensor), chart, values))


def test_what_shows_no_part_of_the_scene_says_nothing_of_the_noise():
    """A wall before the floor counts for no noise more than were its pixels lost: two noises that explained the rest
    about as well were nats apart, and so were structures that had one each."""
    _, final, _, chart, values = fits("robust", dict(PRIOR.values))
    clean, apart = final.clean(chart, values), []
    walled, lost = final.observed.copy(), final.observed.copy()
    walled[:8], lost[:8] = -0.9 * clean[:8], np.nan
    for observed in (walled, lost):
        less, more = (
            refined_at_mode(final._replace(observed=observed, beside=None).changed(sigma=sigma), chart, values)
            for sigma in (0.002, 0.003)
        )
        apart.append(height(more) - height(less))
    assert (walled < 0.0).sum() > 200 and apart[0] == pytest.approx(apart[1], abs=1e-3)  # a hundred nats but for that


def test_odds_follow_the_noise_that_a_file_gives():
    """Where noise is normal and known to be twice as large, the image speaks a quarter as loud."""
    apart = []
    for sigma in (0.002, 0.004):
        _, final, _, chart, values = fits("gaussian", {"sigma": sigma, "blur": 0.5})
        shorter = values.copy()
        shorter[chart.slots[0, SIZE]] -= 0.01
        engine = engine_of(chart, final)
        apart.append(load(engine, chart, values)[1] - load(engine, chart, shorter)[1])
    assert apart[0] > 20.0 and apart[0] / apart[1] == pytest.approx(4.0, rel=1e-3)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.8])
def test_how_many_pixels_fly_at_edges_is_told_by_the_final_fit_alone(share):
    """The share is that of some 300 pixels: three standard deviations are .08."""
    cube = State().add(row(BOX, 0.5, 0.0, 0.0, 0.0, (0.08,) * 3), UPRIGHT, True, FLOOR, 0.0)
    true = {"sigma": 0.002, "blur": 0.5, "flying": share, "edge_step": 0.01}
    seen, chart, values = observe(np.random.default_rng(3), cube, true, camera(160, 120), "robust")
    first = first_sensor(seen.camera, seen.observed, chart, values, PRIOR)
    final = final_sensor(first, chart, values)
    assert first.values["flying"] == 0.0  # before edges are where they are all pixels there fly
    assert final.values["flying"] == pytest.approx(share, abs=0.08)
    assert same_sensor_refitted(final, chart, values).values["flying"] == final.values["flying"]


def test_however_many_fly_some_may_not():
    """Where each pixel at an edge lies between what is beside it, as after a filter, the share stays what it may be."""
    clean = np.where(np.arange(40) < 20, 0.5, 0.8) * np.ones((30, 1))
    observed = np.where(np.abs(np.arange(40) - 19.5) < 1.0, 0.65, clean)
    observed += np.random.default_rng(4).normal(0.0, 1e-3, clean.shape)
    _, name, numbers = Noise(observed, clean, {}).fitted(0.0)
    assert likelihoods[name].complete(numbers)["flying"] == MOST_FLYING
