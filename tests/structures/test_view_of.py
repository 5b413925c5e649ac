"""What inference is given of a real sensor's image: where something else than the scene shows, how much pixels tell."""

from types import SimpleNamespace

import numpy as np
import pytest

from derender.camera.intrinsics import Camera
from derender.detection.search.greedy import Settings
from derender.detection.solids.state import State
from derender.render.blur import blur
from derender.scene.pose import rotation_x, translation
from derender.structures.draws import refined
from derender.structures.draws.refined import BEFORE, View, floor_pose_of, refine, view_of
from derender.structures.draws.sensor import floor_depth, shown

CAMERA = {"fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5, "width": 32, "height": 24}
POSE = translation(0.0, 0.05, 0.8) @ rotation_x(np.deg2rad(135))
NOISE = 0.004


def observation(correlation):
    """Return what stands for an Observation: a floor, a thing before it on the left, and a wall behind on the right.

    Of the floor's own pixels the upper half is taken as it is seen.
    """

    plane = floor_depth(POSE, Camera(**CAMERA))
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
        camera=CAMERA, single=single, bend=None, correlation=correlation, things=(), behind=behind, image=image,
        floor=SimpleNamespace(pose=POSE, inliers=inliers), sigma=np.full(depth.shape, NOISE),
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
