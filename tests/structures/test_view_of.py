"""What inference is given of a real sensor's image: where something else than the scene shows, how much pixels tell."""

from types import SimpleNamespace

import numpy as np
import pytest

from derender.camera.intrinsics import Camera
from derender.detection.floor import floor_depth
from derender.detection.search.greedy import Settings
from derender.detection.solids.beliefs import any_sensor
from derender.detection.solids.image import make_row
from derender.detection.solids.polish import UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.render.blur import blur
from derender.scene.pose import rotation_x, translation
from derender.scene.solids import BOX
from derender.structures.alternatives import unclimbed
from derender.structures.draws import refined
from derender.structures.draws.chart import make_chart
from derender.structures.draws.metropolis import engine_of, load
from derender.structures.draws.refined import (
    BEFORE,
    View,
    floor_pose_of,
    refine,
    view_of,
    with_out_of_reach,
    without_unseen,
)
from derender.structures.draws.sensor import first_sensor, model_depth, shown, too_far

CAMERA = Camera(30.0, 30.0, 15.5, 11.5, 32, 24)
POSE = translation(0.0, 0.05, 0.8) @ rotation_x(np.deg2rad(135))
NOISE = 0.004


def observation(correlation):
    """Return what stands for an Observation: a floor, a thing before it on the left, and a wall behind on the right.

    Of the floor's own pixels the upper half is taken as it is seen.
    """

    plane = floor_depth(POSE, CAMERA)
    depth = np.minimum(plane, 1.2)
    behind = np.zeros(depth.shape, bool)
    behind[:, 24:] = True
    depth[:, :6] -= 0.1
    floor = plane.copy()
    floor[:, :6], floor[:, 24:] = depth[:, :6], depth[:, 24:]
    inliers = (plane == depth) & ~behind
    floor[12:][inliers[12:]] += 0.001
    image = SimpleNamespace(depth=depth, floor=floor, weight=np.ones(depth.shape))
    single = depth.copy()
    single[3, 3] = single[20, 12] = np.nan
    return SimpleNamespace(
        factor=1, single=single, single_camera=CAMERA, bend=None, correlation=correlation, things=(), behind=behind,
        wall=None, whole=None, whole_camera=None,
        image=image, floor=SimpleNamespace(pose=POSE, inliers=inliers), sigma=np.full(depth.shape, NOISE),
    )  # fmt: skip


def test_what_is_no_part_of_the_scene_bounds_it():
    seen = observation(0.8)
    view = view_of(seen)
    assert view.shared
    assert np.array_equal(np.isnan(view.observed), np.isnan(seen.single))
    of_scene, returned = shown(view.observed), np.isfinite(seen.single)
    plain = (np.abs(seen.image.floor - seen.image.depth) > 1e-6) | seen.floor.inliers
    assert (seen.floor.inliers & (seen.image.floor == seen.image.depth)).any()  # a sensor's floor tells where it is
    assert np.array_equal(np.isfinite(of_scene), plain & returned)
    assert np.array_equal(of_scene[plain & returned], seen.single[plain & returned])
    bounds = -view.observed[~plain & returned]
    nearest = np.minimum(seen.image.depth, floor_depth(POSE, view.camera))[~plain & returned]
    assert np.allclose(bounds, nearest - BEFORE * NOISE)


def test_what_a_smaller_image_says_of_the_background_holds_for_each_pixel():
    seen = observation(0.8)
    twice = Camera(*(2 * value for value in (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, *CAMERA.shape[::-1])))
    whole = {"single": np.kron(seen.single, np.ones((2, 2))), "factor": 2, "single_camera": twice}
    drawn_from = view_of(SimpleNamespace(**{**vars(seen), **whole})).observed
    assert np.allclose(drawn_from[::2, ::2], view_of(seen).observed, equal_nan=True)


def test_an_image_of_independent_noise_shows_a_scene_all_over():
    seen = observation(0.0)
    seen.behind[:] = False
    view = view_of(seen)
    assert np.array_equal(view.observed, seen.single, equal_nan=True) and not view.shared


@pytest.mark.parametrize("tries, heated", [(1, False), (2, True)])
def test_a_single_climb_to_the_mode_is_not_heated(monkeypatch, tries, heated):
    met = []

    def climb(rng, temperatures=refined.TEMPERATURES, **given):
        met.append(temperatures)
        return SimpleNamespace(log_prior=0.0, log_likelihood=0.0)

    monkeypatch.setattr(refined, "climb", climb)
    refined.best_climb(np.random.default_rng(0), None, None, np.zeros(2), None, tries)
    assert met == [refined.TEMPERATURES if heated else ()] * tries


def test_a_floor_on_which_nothing_stands_stays_where_it_was_found():
    """The floor of a bin rises towards its walls: drawn to that, one ended a centimetre over what was seen of it."""
    rng, camera = np.random.default_rng(0), Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
    dents = blur(0.004 * rng.standard_normal(camera.shape), 1.5)
    rises = np.minimum(np.arange(64), np.arange(64)[::-1]) < 6
    observed = floor_depth(POSE, camera) + dents - 0.025 * rises
    found = refine(rng, [View(camera, observed, shared=True)], POSE, State(), Settings().rules)
    assert np.allclose(floor_pose_of(found), POSE)


@pytest.mark.parametrize(("height", "correlation", "count"), [(0.006, 0.8, 0), (0.03, 0.8, 1), (0.006, 0.0, 1)])
def test_what_is_no_higher_than_a_real_floor_is_uneven_is_no_solid(height, correlation, count):
    """The edge of a board on a carpet was a box of 33 x 19 x 0.6 cm on a floor between the two, at P .79."""
    camera, rules = CAMERA, Settings().for_correlation(correlation).rules
    state = State().add(make_row(BOX, np.eye(3), [0, 0, 0.5 * height], [0.3, 0.2, height]), UPRIGHT, False, FLOOR, 0.0)
    chart, values = make_chart(state, POSE, rules)
    sensor = first_sensor(camera, model_depth(chart, values, camera), chart, values)
    assert len(without_unseen(state, unclimbed(state, POSE, sensor, rules))) == count


def test_a_row_at_the_limit_of_what_is_far_stays_whole():
    """Of its pixels noise left the nearer ones, which tilted the floor: of 100 tilts 90 % intervals held 86."""
    camera = CAMERA
    chart, values = make_chart(State(), translation(0.0, 0.05, 0.8) @ rotation_x(np.deg2rad(113)), Settings().rules)
    exact = model_depth(chart, values, camera)
    off = np.abs(exact - 2.5 * np.median(exact))
    noise = np.where(off == off.min(), off.min() + 0.005, 0.0)  # in the row at the limit
    noisy = exact + noise * np.random.default_rng(0).standard_normal(exact.shape)
    far = first_sensor(camera, noisy, chart, values).observed < 0.0
    assert far.any() and np.all(far.all(axis=1) | ~far.any(axis=1))


def test_a_box_ends_where_a_sensor_saw_nothing_although_it_would():
    """Behind it the floor is farther than the sensor reaches, so that else nothing says how far the box goes on."""
    camera, floor = Camera(120.0, 120.0, 63.5, 47.5, 128, 96), translation(0.0, 0.1, 0.5) @ rotation_x(np.deg2rad(110))
    boxes = [make_row(BOX, np.eye(3), [0, y, 0.05], [0.1, length, 0.1]) for y, length in ((0.0, 0.1), (0.05, 0.2))]
    charts = [make_chart(State().add(row, UPRIGHT, False, FLOOR, 0.0), floor, Settings().rules) for row in boxes]
    clean, longer = (model_depth(*chart, camera) for chart in charts)
    noise = blur(0.002 * np.random.default_rng(0).standard_normal(camera.shape), 1.0)
    observed = np.where(clean < 0.62, clean + noise, np.nan)
    seen, more = np.isfinite(observed), (longer < clean) & (clean > 0.62)
    image = with_out_of_reach(observed, floor_depth(floor, camera))
    assert np.array_equal(image[seen], observed[seen]) and more.any() and (image[more] < 0.0).all()
    gains = []
    for each in (observed, image):
        sensor = first_sensor(camera, each, *charts[0], any_sensor())
        likely = [load(engine_of(chart, sensor), chart, values)[1] for chart, values in charts]
        gains.append(likely[0] - likely[1])
    assert abs(gains[0]) < 1.0 and gains[1] > 20.0  # nats by which the box ends there


def test_a_box_ends_where_what_is_far_away_is_seen_above_it():
    """Of a tower whose top was just below the horizon nothing said how high its uppermost box is: 49 mm, told were 58
    to 154."""
    camera, floor = Camera(120.0, 120.0, 63.5, 47.5, 128, 96), translation(0.0, 0.1, 0.5) @ rotation_x(np.deg2rad(100))
    boxes = [make_row(BOX, np.eye(3), [0, 0.05, height / 2], [0.1, 0.1, height]) for height in (0.18, 0.20)]
    charts = [make_chart(State().add(row, UPRIGHT, False, FLOOR, 0.0), floor, Settings().rules) for row in boxes]
    clean, higher = (model_depth(*chart, camera) for chart in charts)
    observed = clean + 0.002 * np.random.default_rng(0).standard_normal(camera.shape)
    observed[(clean == clean.max()) & np.isinf(floor_depth(floor, camera))] = np.nan  # above the horizon
    more = (higher < clean) & np.isfinite(observed)
    assert more.any() and too_far(observed)[more].all()
    sensor = first_sensor(camera, observed, *charts[0])
    likely = [load(engine_of(chart, sensor), chart, values)[1] for chart, values in charts]
    assert likely[0] - likely[1] > 20.0
