"""The floor where the camera knows which way things fall: a level plane, however much more of the image others fill."""

import numpy as np
import pytest

from derender.camera.intrinsics import Camera
from derender.detection.floors import find_floor, floors_of
from derender.detection.search.observation import observe

CAMERA = Camera(150.0, 150.0, 79.5, 59.5, 160, 120)
TILT = np.radians(20.0)
# The camera looks down by 20 degrees on a floor .3 m below it; a ramp of 25 degrees fills most of the image.
FALL = np.array([0.0, np.cos(TILT), np.sin(TILT)])


def plane_depth(normal, offset):
    """Return the depth (H, W) of the plane n . x = offset, NaN where no ray meets it."""
    along = CAMERA.rays() @ normal
    with np.errstate(divide="ignore"):
        depth = offset / along
    return np.where(depth > 0.0, depth, np.nan)


@pytest.fixture
def depth():
    """A ramp whose lower end stands on a floor that shows in a fifth of the image."""
    turn = np.radians(25.0)
    ramp = np.array([0.0, np.cos(TILT + turn), np.sin(TILT + turn)])
    floor, sloped = plane_depth(FALL, 0.3), plane_depth(ramp, 0.55)
    both = np.fmin(floor, sloped)
    assert 0.12 < np.mean(both == floor) < 0.45
    return both + 0.001 * np.random.default_rng(0).standard_normal(both.shape)


def test_the_level_plane_is_the_floor(depth):
    without = find_floor(depth, CAMERA)
    assert without.pose[:3, 2] @ -FALL < 0.95  # the ramp: what the image alone would have
    known = floors_of(depth, CAMERA, FALL)[0]
    assert known.normal @ -FALL > 0.999  # of three points each; the fit that follows is closer


def test_gravity_comes_with_the_camera(depth):
    from dataclasses import replace

    seen = observe(depth, replace(CAMERA, gravity=tuple(FALL)))
    assert seen.floor.pose[:3, 2] @ -FALL > 0.9999


def test_gravity_that_fits_no_plane_is_set_aside(depth):
    sideways, plain = floors_of(depth, CAMERA, (1.0, 0.0, 0.0))[0], floors_of(depth, CAMERA)[0]
    np.testing.assert_array_equal(sideways.normal, plain.normal)
    assert sideways.offset == plain.offset


def test_a_small_floor_before_a_wall_is_the_floor():
    """A wall fills nine tenths of the image; nothing lies under the strip of floor before it, which faces upwards."""
    wall = plane_depth(np.array([0.0, -np.sin(TILT), np.cos(TILT)]), 1.0)
    floor = plane_depth(FALL, 0.74)
    both = np.fmin(floor, wall) + 0.001 * np.random.default_rng(0).standard_normal(wall.shape)
    assert 0.06 < np.mean(floor < wall) < 0.15
    assert find_floor(both, CAMERA).pose[:3, 2] @ -FALL > 0.99
