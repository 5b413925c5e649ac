"""A floor that runs to its horizon: the far part tells its tilt, and no solids stand before it that are not there."""

from functools import partial

import numpy as np
import pytest

from derender.camera.intrinsics import Camera
from derender.detection.estimate import point_estimate
from derender.detection.fattening import fattened
from derender.detection.floor import under_its_noise
from derender.detection.floors import find_floor
from derender.detection.search.observation import observe
from derender.render.blur import blur
from derender.render.raycast.depth import render_depth
from derender.scene.pose import rotation_x, translation
from derender.scene.solids import BOX, PLANE, Solids
from worlds.made_scenes import before_horizon

VIEWS = {"low": (5.2, 0.67, 59.5), "wide": (21.3, 0.33, 110.0)}  # degrees up, metres away, field of view


def tilt_off(floor, pose):
    """Return by how many degrees a Floor is tilted against a pose."""
    return np.degrees(np.linalg.norm(floor.pose[:3, 2] - pose[:3, 2]))


@pytest.mark.parametrize("view", VIEWS)
def test_the_far_floor_tells_its_tilt(view):
    depth, camera, pose = before_horizon(*VIEWS[view])
    first = find_floor(depth, camera)
    found = under_its_noise(first, depth, camera)
    assert tilt_off(found, pose) < 0.01 < 0.03 < tilt_off(first, pose)
    assert tilt_off(observe(depth, camera).floor, pose) < 0.01
    assert found.inliers.mean() > 0.5


def test_a_floor_seen_from_above_does_not_trade_its_tilt_for_a_blur():
    """It tells no blur, and the plane that went with less than none was kept: .05 degrees off, and a pallet a box."""
    for seed in range(4):
        depth, camera, pose = before_horizon(50.0, 0.9, 59.5, seed=seed)
        found = under_its_noise(find_floor(depth, camera), depth, camera)
        assert tilt_off(found, pose) < 0.015  # a robust fit without weights leaves .005


@pytest.mark.parametrize("blurred", [0.5, 1.5, 2.5])
def test_a_blur_beside_the_horizon_tilts_no_floor(blurred):
    """Of 1.5 pixels this floor was .048 degrees off: rows beside the horizon counted that show more of the wall."""
    depth, camera, pose = before_horizon(25.0, 0.9, 59.5, blurred=blurred)
    found = under_its_noise(find_floor(depth, camera), depth, camera)
    assert tilt_off(found, pose) < 0.035  # the expansion in the blur leaves .028 of it


@pytest.mark.parametrize("blurred", [1.0, 2.0])
def test_what_leaks_from_solids_tilts_no_floor(blurred):
    """Each pixel about them was off by less than its noise, but many: a floor was tilted by .011 and .035 degrees."""
    camera, pose = Camera.from_field_of_view(160, 120, 59.5), rotation_x(np.pi / 2 + np.radians(30.4))
    pose[:3, 3] = 0.0, 0.0, 0.662
    boxes = {(0.12, 0.16, 0.05): (0.1, 0.1, 0.1), (0.17, -0.2, 0.1): (0.08, 0.07, 0.2)}
    poses = np.array([pose, *(pose @ translation(*place) for place in boxes)])
    sizes = np.array([(0.0, 0.0, 0.0), *boxes.values()])
    solids = Solids(np.array([PLANE, BOX, BOX], np.int32), poses, sizes, np.full(3, -1, np.int32), ())
    depth = blur(render_depth(solids, camera)[0], blurred)
    depth += 0.002 * np.random.default_rng(0).standard_normal(depth.shape)
    assert tilt_off(under_its_noise(find_floor(depth, camera), depth, camera), pose) < 0.007 * blurred


def test_a_floor_of_which_little_shows_stays():
    depth, camera, _ = before_horizon(*VIEWS["low"])
    floor = find_floor(depth, camera)
    depth[::2] = np.nan
    few = np.where(np.cumsum(np.isfinite(depth) & floor.inliers).reshape(depth.shape) < 80, depth, np.nan)
    assert under_its_noise(floor, few, camera) is floor


@pytest.mark.parametrize("view", VIEWS)
def test_nothing_stands_before_the_horizon_that_is_not_there(view):
    estimate = partial(point_estimate, np.random.default_rng(0))
    found = [estimate(*before_horizon(*VIEWS[view], seed=seed)[:2])[0] for seed in range(3)]
    assert [len(state) for state in found] == [1, 1, 1]


def test_noise_of_a_floor_right_before_the_camera_is_no_silhouette():
    """At .12 m 2 mm are a sixtieth of the depth: such images were taken for fattened, the far floor thinned away."""
    assert not any(fattened(before_horizon(*VIEWS["low"], seed, 320)[0]) for seed in range(4))
