"""Several images of one scene: their joint density, what it says of the scene, and what shared errors leave of it."""

from dataclasses import replace

import numpy as np
import pytest

from derender.camera.intrinsics import Camera
from derender.detection.solids.beliefs import Rules
from derender.detection.solids.image import make_row
from derender.detection.solids.state import FLOOR, State
from derender.errors import DerenderError
from derender.render.likelihoods import likelihoods
from derender.scene.pose import inverse, rotation_angle, rotation_x, rotation_z, translation, twist_exp
from derender.scene.solids import BOX
from derender.structures.draws.chart import SIZE, make_chart
from derender.structures.draws.curvature import Curvature
from derender.structures.draws.metropolis import engine_of, evaluate, load, sample
from derender.structures.draws.refined import refined_at
from derender.structures.draws.sensor import Sensor, model_depth
from derender.structures.infer import infer_structure
from derender.structures.options import Frame, Options
from derender.structures.together import averaged, shared, view_moved

UPRIGHT = 0
BOTH = ("gaussian", "robust")


def floor_pose(azimuth, elevation=0.7, distance=0.7):
    """The floor frame's pose in front of a camera that looks down at its origin from a side."""
    pose = rotation_x(np.pi / 2 + elevation) @ rotation_z(azimuth)
    pose[:3, 3] = 0.0, 0.0, distance
    return pose


def tower():
    low = make_row(BOX, rotation_z(0.3)[:3, :3], np.array([0.0, 0.0, 0.04]), np.array([0.08, 0.12, 0.08]))
    high = make_row(BOX, rotation_z(0.6)[:3, :3], np.array([0.01, 0.0, 0.105]), np.array([0.06, 0.09, 0.05]))
    return State().add(low, UPRIGHT, False, FLOOR, 0.0).add(high, UPRIGHT, False, 0, 0.08)


def camera(width, height):
    return Camera(0.9 * width, 0.9 * width, (width - 1) / 2, (height - 1) / 2, width, height)


def looks(rng, azimuths, names, sizes=((48, 36),), elevation=0.7, sigma=0.002, blur=0.5):
    """Return (chart, coordinates, Sensor) of a tower seen from some sides."""
    chart, values = make_chart(tower(), floor_pose(azimuths[0], elevation), Rules(0.0015))
    views = []
    for k, azimuth in enumerate(azimuths):
        view, into = camera(*sizes[k % len(sizes)]), floor_pose(azimuth, elevation) @ inverse(chart.floor)
        likelihood = likelihoods[names[k % len(names)]]
        numbers = likelihood.complete({"sigma": sigma, "blur": blur * k})
        observed = likelihood.sample(rng, model_depth(chart, values, view, into), numbers)
        views.append(Sensor(view, observed, likelihood, numbers, None, into if k else np.eye(4)))
    return chart, values, views[0]._replace(others=tuple(views[1:]))


@pytest.mark.parametrize("names", [BOTH, ("gaussian",)])
def test_the_density_of_several_images_is_the_product_of_theirs(names):
    rng = np.random.default_rng(1)
    chart, values, sensor = looks(rng, (0.0, 1.4, 3.0), names, ((48, 36), (64, 24)))
    together, single = engine_of(chart, sensor), [engine_of(chart, view) for view in sensor.views]
    points = values + 0.003 * rng.standard_normal((20, len(values)))
    found = np.empty((20, 2))
    load(together, chart, values)
    evaluate(together, chart, points, np.ones(len(chart.flags) + 1, bool), found)
    apart = np.array([[load(each, chart, point) for each in single] for point in points])
    np.testing.assert_array_equal(found[:, 0], apart[:, 0, 0])
    np.testing.assert_allclose(found[:, 1], apart[..., 1].sum(axis=1), rtol=1e-7)
    # a broken twin: cameras that all stand where the first does
    blind = engine_of(chart, sensor.each(lambda view: view._replace(into=np.eye(4))))
    assert load(blind, chart, values)[1] < load(together, chart, values)[1] - 1000.0


def test_each_view_is_that_of_its_own_likelihood_on_the_moved_scene():
    """One view from elsewhere is the density of a scene whose floor frame is moved into its camera."""
    chart, values, sensor = looks(np.random.default_rng(2), (0.0, 1.4), BOTH)
    (_, other) = sensor.views
    moved = chart._replace(floor=other.into @ chart.floor)
    here = other._replace(into=np.eye(4))
    found, expected = (load(engine_of(c, s), c, values)[1] for c, s in ((chart, other), (moved, here)))
    assert found == pytest.approx(expected, rel=1e-9)


def test_precisions_add_and_a_side_view_tells_what_the_first_hides():
    chart, values, sensor = looks(np.random.default_rng(3), (0.0, np.pi / 2), ("gaussian",), elevation=0.02)
    members = list(range(len(values)))

    def precision(sensor):
        engine = engine_of(chart, sensor)
        load(engine, chart, values)
        return Curvature(engine, chart, sensor, values).precision(members)

    both, (one, other) = precision(sensor), map(precision, sensor.views)
    prior = np.diag(precision(sensor._replace(observed=np.full_like(sensor.observed, np.nan), others=())))
    np.testing.assert_allclose(both + np.diag(prior), one + other, rtol=1e-4, atol=1e-3 * np.abs(both).max())
    spread = [np.sqrt(np.diag(np.linalg.inv(each))) for each in (one, both)]
    hidden = [size for size in chart.slots[:, SIZE:].ravel() if spread[0][size] > 0.002]
    assert hidden and all(spread[1][size] < 0.5 * spread[0][size] for size in hidden)


def test_of_pixels_that_share_their_noise_few_tell_where_a_solid_is():
    chart, values, sensor = looks(np.random.default_rng(4), (0.0,), ("gaussian",))
    found = []
    for view in (sensor, sensor.changed("correlated", shared=0.9)):
        engine = engine_of(chart, view)
        load(engine, chart, values)
        found.append(Curvature(engine, chart, view, values).precision([0])[0, 0])
    assert found[1] < 0.1 * found[0]


def test_a_second_view_narrows_what_the_first_hides():
    rng = np.random.default_rng(5)
    chart, values, sensor = looks(rng, (0.0, np.pi / 2), ("gaussian",), ((64, 48),), elevation=0.3)
    spreads = []
    for used in (sensor._replace(others=()), sensor):
        drawn = sample(rng, chart, used, values.copy(), 1, 80, 40)[0].values
        sizes = drawn[:, np.unique(chart.slots[:, SIZE:])]
        truth = values[np.unique(chart.slots[:, SIZE:])]
        spreads.append(sizes.std(axis=0))
        assert np.all(np.abs(sizes.mean(axis=0) - truth) < 5.0 * spreads[-1] + 2e-4)
    hidden = spreads[0] > 0.005
    assert hidden.any() and np.all(spreads[1][hidden] < 0.5 * spreads[0][hidden])


def test_errors_that_images_share_count_once():
    """The same noise again tells nothing; noise of its own as much again."""
    rng = np.random.default_rng(6)
    chart, values, sensor = looks(rng, (0.0, 0.0, 1.4), ("gaussian",))
    first, again, side = sensor.views
    again = again._replace(values=first.values)
    same = again._replace(observed=first.observed)
    state = tower()
    for other, expected in ((same, 1.0), (again, 0.0), (side, 0.0)):
        both = first._replace(others=(other,))
        found = shared(refined_at(state, chart, values, both, 0.0, 0.0))
        np.testing.assert_allclose(found, [[0.0, expected], [expected, 0.0]], atol=0.02)
    bias = 0.002 * rng.standard_normal(first.observed.shape)
    one, two = (view._replace(observed=view.observed + bias) for view in (first, again))
    assert 0.35 < shared(refined_at(state, chart, values, one._replace(others=(two,)), 0.0, 0.0))[0, 1] < 0.65


def test_shared_errors_are_those_at_the_same_places():
    """A camera on its head sees the same noise elsewhere in its image."""
    chart, values, sensor = looks(np.random.default_rng(9), (0.0,), ("gaussian",))
    turned = sensor._replace(observed=sensor.observed[::-1, ::-1], into=rotation_z(np.pi))
    found = shared(refined_at(tower(), chart, values, sensor._replace(others=(turned,)), 0.0, 0.0))
    assert found[0, 1] > 0.98


def test_a_pose_that_is_a_little_off_is_told_by_the_depths():
    chart, values, sensor = looks(np.random.default_rng(10), (0.0, 1.4), ("gaussian",), ((96, 72),))
    view = sensor.others[0]
    shifted = view._replace(into=twist_exp([0.002, -0.001, 0.002], [0.003, 0.004, -0.003]) @ view.into)
    moved = view_moved(refined_at(tower(), chart, values, sensor, 0.0, 0.0), shifted, 0.0)
    middle = np.array([0.0, 0.0, 0.7, 1.0])
    before, after = (np.linalg.norm((each.into @ middle - view.into @ middle)[:3]) for each in (shifted, moved))
    assert before > 0.002 and after < 0.0005


def frame(depth, into, name):
    return Frame(depth, camera(64, 48), into, name)


def test_images_from_one_place_are_averaged_and_what_they_share_stays():
    rng = np.random.default_rng(7)
    chart, values = make_chart(tower(), floor_pose(0.0), Rules(0.0015))
    clean = model_depth(chart, values, camera(64, 48))
    bias = 0.001 * rng.standard_normal(clean.shape)
    images = clean + bias + 0.002 * rng.standard_normal((64, *clean.shape))
    images[:40, 3, 4] = np.nan
    for into in (np.eye(4), None):
        others = [frame(image, into, str(k)) for k, image in enumerate(images[1:])]
        mean, left = averaged(images[0], camera(64, 48), others)
        assert not left and np.isnan(mean[3, 4])
        assert np.nanstd(mean - clean - bias) == pytest.approx(0.002 / 8.0, rel=0.1)
        assert np.nanstd(mean - clean) > 0.0009
    side = inverse(floor_pose(0.0)) @ floor_pose(1.4)
    _, left = averaged(images[0], camera(64, 48), [frame(images[1], side, "side")])
    assert [each.name for each in left] == ["side"]
    with pytest.raises(DerenderError, match="both are from one place"):
        averaged(images[0], camera(64, 48), [frame(images[1] + 0.1, np.eye(4), "other")])


@pytest.fixture(scope="module")
def two_looks():
    """(camera, first image, another, the motion between their cameras) of a tower and a box beside it."""
    rng = np.random.default_rng(8)
    beside = make_row(BOX, rotation_z(1.0)[:3, :3], np.array([0.13, 0.06, 0.03]), np.array([0.05, 0.07, 0.06]))
    state, view = tower().add(beside, UPRIGHT, False, FLOOR, 0.0), camera(128, 96)
    chart, values = make_chart(state, floor_pose(0.3), Rules(0.0015))
    into = floor_pose(1.5, 0.6, 0.75) @ inverse(chart.floor)
    images = [model_depth(chart, values, view, each) + 0.001 * rng.standard_normal((96, 128)) for each in (None, into)]
    return view, *images, into


def test_poses_are_found_within_a_millimetre(two_looks):
    view, one, other, into = two_looks
    options, off = Options(method="map", quick=True, frames=(Frame(other, view, None, "other"),)), []
    middle = np.array([0.0, 0.0, 0.7, 1.0])
    for seed in (1, 2, 3):  # one search ends up to 5 mrad off: the limits are the median's
        found = infer_structure(one, view, options, np.random.default_rng(seed))
        assert len(found.best_graph().names) == 4
        (told,) = found.meta["views"]
        assert told["image"] == "other" and told["explained"] > 0.98
        moved = inverse(np.array(found.best_part.extras["into"][0])) @ into
        off.append((np.linalg.norm((moved @ middle - middle)[:3]), rotation_angle(moved, np.eye(4))))
    assert np.all(np.median(off, axis=0) < (0.001, 0.003))


def test_images_of_different_scenes_are_told_in_one_line(two_looks):
    view, one, other, into = two_looks
    bare = model_depth(*make_chart(State(), floor_pose(0.3), Rules(0.0015)), view)
    options = Options(method="map", quick=True)
    for depth, pose, what in (
        (bare, None, "cannot be brought onto"),
        (other, translation(0.0, 0.3, 0.0), "its floor is"),
    ):
        given = replace(options, frames=(Frame(depth, view, pose, "other.png"),))
        with pytest.raises(DerenderError, match=what) as caught:
            infer_structure(one, view, given, np.random.default_rng(1))
        assert "\n" not in str(caught.value) and "other.png" in str(caught.value)
