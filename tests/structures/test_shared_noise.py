"""A bare image under a sensor whose neighbouring pixels share noise: inference obeys what its prior file says."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, median_filter

from derender import data_path
from derender.camera.intrinsics import Camera
from derender.detection.search.observation import CORRELATED, observe
from derender.detection.solids.beliefs import bare_image, sensor_beliefs
from derender.document import LikelihoodPrior, read_document, read_prior_document
from derender.errors import DerenderError
from derender.render.likelihoods import likelihoods
from derender.render.raycast.depth import render_depth
from derender.results.fit import BACKGROUND
from derender.scene.pose import rotation_x, rotation_z, translation
from derender.scene.solids import BOX, PLANE, Solids
from derender.structures.draws.sensor import ROUNDS, Sensor, under_shared_noise
from derender.structures.infer import found_in, infer_structure, loses_one, lost
from derender.structures.options import Options

CAMERA = Camera(110.0, 110.0, 63.5, 47.5, 128, 96)
SIZE = np.array([0.14, 0.10, 0.12])
NOISE = {"sigma": 0.001, "sigma_growth": 0.001, "step": 0.0003, "white": 0.05, "reach": 3.0, "reach_down": 2.0}


def box_on_a_table(camera=CAMERA, pitch=35.0):
    """Return the depth image that a camera shows of the box, where it looks so many degrees down."""
    root = translation(0.0, 0.05, 0.75) @ rotation_x(np.radians(90.0 + pitch))
    box = root @ translation(0.0, 0.0, SIZE[2] / 2) @ rotation_z(0.5)
    sizes, none = np.array([np.zeros(3), SIZE]), np.full(2, -1, np.int32)
    return render_depth(Solids(np.array([PLANE, BOX], np.int32), np.array([root, box]), sizes, none), camera)[0]


def believed():
    return read_document(data_path("sensors/any.yaml")).likelihood


def test_what_neighbours_share_is_found_and_what_a_file_gives_as_a_number_holds():
    depth, rng = box_on_a_table(), np.random.default_rng(1)
    field = gaussian_filter(rng.standard_normal(depth.shape), 1.5)
    observed = depth + 0.002 * depth**2 * (field / field.std() + 0.1 * rng.standard_normal(depth.shape))
    sensor = Sensor(CAMERA, observed, likelihoods["robust"], {}, believed()).changed("robust", blur=0.0, outlier=0.01)
    found = under_shared_noise(sensor, depth, 150).values
    noise, step = (found[name] + found[f"{name}_growth"] * 0.7**2 for name in ("sigma", "step"))
    assert noise == pytest.approx(0.002 * 0.7**2, rel=0.25) and 0.1 * noise < step < 0.4 * noise
    held = LikelihoodPrior("correlated", {**believed().values, "reach": 7.0, "sigma": 0.002})
    found = under_shared_noise(sensor._replace(prior=held), depth, 40).values
    assert found["reach"] == 7.0 and found["sigma"] == 0.002


def test_what_pixels_go_on_from_is_made_anew_only_for_numbers_on_which_it_hangs():
    sensor = Sensor(CAMERA, box_on_a_table(), likelihoods["correlated"], {}).changed(**NOISE)
    assert sensor.changed(blur=0.7, sigma=0.002).beside is sensor.beside
    for number, other in (("step", 0.001), ("white", 0.3), ("reach_down", 1.0)):
        changed = sensor.changed(**{number: other})
        assert np.array_equal(changed.beside, changed.likelihood.beside(changed.observed, changed.values))
        assert not np.array_equal(changed.beside, sensor.beside)


def test_noise_is_that_by_which_pixels_tell_their_surface_however_far_others_drift():
    """Pixels that go on drift from the surface: all scatter three times as much as those that tell it anew."""
    true = {**NOISE, "sigma_growth": 0.003, "step_growth": 0.0015, "white": 0.2, "reach": 5.0, "outlier": 0.02}
    depth = box_on_a_table()
    observed = likelihoods["correlated"].sample(np.random.default_rng(0), depth, true)
    sensor = Sensor(CAMERA, observed, likelihoods["robust"], {}, believed()).changed("robust", blur=0.0, outlier=0.01)
    for rounds in (ROUNDS, 0):  # as images are looked at, and as they came
        found = under_shared_noise(sensor, depth, rounds).values
        noise = found["sigma"] + found["sigma_growth"] * 0.7**2
        assert noise == pytest.approx(0.001 + 0.003 * 0.7**2, rel=0.2)


def test_of_an_image_that_shows_shared_noise_what_a_file_says_of_its_noise_holds():
    usual = bare_image()
    assert sensor_beliefs(usual, False) is usual.sensor
    held = usual._replace(sensor=LikelihoodPrior("robust", {**usual.sensor.values, "sigma": 0.006}))
    found = sensor_beliefs(held, True)
    assert found.type == "correlated" and found.values["sigma"] == 0.006
    assert found.values["shared"] == believed().values["shared"] and "missing" not in found.values
    own = usual._replace(sensor=LikelihoodPrior("correlated", {"shared": 0.5}))
    assert sensor_beliefs(own, True) is own.sensor


@pytest.mark.slow
def test_a_bare_image_is_inferred_under_it():
    document = read_prior_document("bare-image")
    options = Options(prior=document.prior, likelihood=believed(), draws=60)
    drawn = {**NOISE, "fading": 1.0}  # of three drawn with .1 two boxes are not found, whatever is believed of it
    right = []
    for number in (2, 3, 4):  # of the first a bend of the noise is taken for a thing beside a smaller box, at P .05
        observed = likelihoods["correlated"].sample(np.random.default_rng(number), box_on_a_table(), drawn)
        posterior = infer_structure(observed, CAMERA, options, np.random.default_rng(0))
        told = posterior.meta["likelihood"]["type"]
        assert posterior.parts[0].extras["likelihood"]["type"] == told == "correlated"
        size = np.sort(posterior.best_graph().vertex("box_1").body.size())
        right.append(np.allclose(size, np.sort(SIZE), atol=0.01))
        assert right[-1] or posterior.parts[0].weight < 0.5
    assert sum(right) >= 2
    usual = infer_structure(
        observed, CAMERA, replace(options, likelihood=document.likelihood), np.random.default_rng(0)
    )
    assert usual.parts[0].extras["likelihood"]["type"] == "correlated"  # as the image shows by itself


def test_of_an_image_whose_neighbours_share_noise_that_hides_in_half_as_many_pixels_single_ones_are_drawn_from():
    camera, rng = Camera(220.0, 220.0, 127.5, 95.5, 256, 192), np.random.default_rng(6)
    clean, white = box_on_a_table(camera), 0.002 * rng.standard_normal((192, 256))
    enlarged = np.kron(white[::2, ::2], np.ones((2, 2)))
    assert observe(clean + white, camera).single.shape == (192, 256)
    seen = observe(clean + enlarged, camera)
    assert seen.correlation <= CORRELATED and seen.single.shape == (96, 128)


def test_a_far_wall_of_one_depth_is_explained_as_background():
    rng = np.random.default_rng(7)
    depth = np.fmin(box_on_a_table(pitch=10.0), 6.0)
    depth += 0.002 * median_filter(rng.standard_normal(depth.shape), 3)
    posterior = infer_structure(depth, CAMERA, Options(quick=True, method="map"), np.random.default_rng(8))
    far = depth > 0.995 * 6.0
    assert far.mean() > 0.1 and (posterior.explanation.label[far] == BACKGROUND).all()
    assert posterior.best_part.weight > 0.5


@pytest.mark.parametrize("off", [0.95, 1.05])
def test_a_box_seen_with_a_slightly_wrong_focal_length_is_not_split_to_explain_that(off):
    camera = Camera(140.0, 140.0, 79.5, 59.5, 160, 120)
    observed = box_on_a_table(camera) + 0.001 * np.random.default_rng(1).standard_normal((120, 160))
    posterior = infer_structure(observed, replace(camera, fx=off * camera.fx, fy=off * camera.fy), Options(seed=0))
    assert posterior.explanation.names == ("box_1",)  # three were, at P .95
    assert CORRELATED < posterior.meta["correlation"] < 0.5


@pytest.mark.parametrize("end, interrupted", [(KeyboardInterrupt(), True), (DerenderError("no floor"), False)])
def test_a_second_search_that_does_not_end_leaves_the_first_answer(monkeypatch, end, interrupted):
    """Ctrl-C in the second search lost what the first had found."""
    camera, answers = Camera(140.0, 140.0, 79.5, 59.5, 160, 120), []

    def once(*arguments):
        if answers:
            raise end
        answers.append(found_in(*arguments))
        return answers[0]

    monkeypatch.setattr("derender.structures.infer.found_in", once)
    observed = box_on_a_table(camera) + 0.001 * np.random.default_rng(1).standard_normal((120, 160))
    posterior = infer_structure(observed, replace(camera, fx=147.0, fy=147.0), Options(seed=0))
    assert posterior.parts == answers[0].parts and posterior.meta["interrupted"] is interrupted


def test_what_a_second_search_leaves_counts_as_lost_but_not_along_its_edges():
    label = np.full((20, 30), -1)
    label[5:15, 5:15], label[2:8, 20:26] = 0, 1

    def told(*objects):
        return SimpleNamespace(explanation=SimpleNamespace(label=np.where(np.isin(label, objects), label, -2)))

    assert lost(told(0, 1), told(0, 1)) == 0.0
    assert lost(told(0, 1), told(0)) == pytest.approx(16 / 136)
    assert loses_one(told(0, 1), told(0)) and not loses_one(told(0), told(0, 1))
    narrower = told(0, 1)
    narrower.explanation.label[:, [5, 14, 20, 25]] = -1
    assert lost(told(0, 1), narrower) == 0.0 and not loses_one(told(0, 1), narrower)
    tiny = told(0)
    tiny.explanation.label[0, 0] = 1  # however small beside the others
    assert lost(tiny, told(0)) == 0.0 and loses_one(tiny, told(0))
