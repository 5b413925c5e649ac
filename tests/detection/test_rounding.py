"""Images whose depths are rounded: to which step, and what noise makes of it."""

import numpy as np
import pytest

from derender.camera.intrinsics import Camera
from derender.detection.floor import neighbour_correlation
from derender.detection.floors import find_floor
from derender.detection.pyramid import reduce
from derender.detection.rounding import dithered, steps_of
from derender.structures.infer import infer_structure
from worlds.made_scenes import drawn_scene, make_scene

MILLIMETRE = 1e-3
BASE = 20.0  # focal length in pixels times base line in metres, of a stereo camera


def in_disparity(depth):
    """Return depths whose disparity is rounded to an eighth of a pixel."""
    return BASE / (np.round(BASE / depth * 8) / 8)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def scene(rng):
    made = make_scene(rng, "cubes")
    return made["clean"], made["camera"]


def test_the_step_is_told_of_depths_of_disparities_and_of_half_precision(scene):
    clean, _ = scene
    millimetres = np.round(clean, 3)
    millimetres[3:9] = np.nan
    assert steps_of(millimetres) == pytest.approx(np.full(clean.shape, MILLIMETRE))
    assert steps_of(np.round(clean, 3).astype(np.float32).astype(float)) == pytest.approx(
        np.full(clean.shape, MILLIMETRE), rel=1e-3
    )
    stereo = in_disparity(clean)
    assert steps_of(stereo) == pytest.approx(stereo**2 / (8 * BASE), rel=1e-6)
    half = clean.astype(np.float16)
    assert np.array_equal(steps_of(half.astype(float)), np.spacing(half).astype(float))


def test_what_lies_on_no_grid_has_no_step(scene):
    clean, _ = scene
    rows = np.repeat(clean[:, :1], clean.shape[1], axis=1)  # of a level floor: few depths, far apart
    for depth in (clean, np.float32(clean).astype(float), rows, np.full(clean.shape, 0.7), np.full((4, 4), np.nan)):
        assert not steps_of(depth).any()


def test_a_rounded_rendering_has_noise_and_nothing_else_has_more(rng, scene):
    clean, camera = scene
    for depth in (np.round(clean, 3), in_disparity(clean)):
        depth[2, 5:9] = np.nan
        added = dithered(rng, depth, camera) - depth
        assert np.array_equal(np.isnan(added), np.isnan(depth))
        share = added[np.isfinite(added)] / steps_of(depth)[np.isfinite(added)]
        assert share.std() == pytest.approx(0.7, abs=4 * 0.7 / np.sqrt(2 * share.size))
    bent = 8e-4 * np.sin(np.arange(clean.shape[1]) / 9.0)
    noisy = clean + MILLIMETRE * rng.normal(size=clean.shape)
    for depth in (clean, np.round(clean + bent, 3), np.round(noisy, 3), noisy, np.full(clean.shape, np.nan)):
        assert dithered(rng, depth, camera) is depth


@pytest.mark.parametrize("times", [1, 4], ids=["as it is", "reduced"])
def test_neighbours_no_longer_share_what_rounding_is_off_by(rng, times):
    """A level camera sees each row of a floor at one depth: rounded, all of it is off by the same, and the mean of a
    block's pixels, in an image that is reduced, has less noise of each pixel's own."""
    middle = np.array([79.5, 59.5]) * times + 0.5 * (times - 1)
    camera = Camera(150.0 * times, 150.0 * times, *middle, 160 * times, 120 * times)
    floor = np.array([0.0, -np.cos(0.6), -np.sin(0.6)])
    depth = np.round(-0.5 / (camera.rays() @ floor), 3)
    for image, low, high in ((depth, 0.9, 1.01), (dithered(rng, depth, camera), 0.05, 0.2)):
        small, seen_by, _ = reduce(image, camera, 160)
        assert low < neighbour_correlation(small, find_floor(small, seen_by), seen_by) < high


@pytest.mark.parametrize("rounded", [lambda depth: np.round(depth, 3), in_disparity], ids=["millimetres", "disparity"])
def test_a_rounded_rendering_is_told_as_what_it_shows(rounded):
    """Its two boxes were free-form things."""
    graph, depth, _, camera = drawn_scene(440015, "tabletop", (160, 120), 1e-6)
    found = infer_structure(rounded(depth), camera, None, np.random.default_rng(440015))
    shapes = [sorted(each.vertex(name).shape for name in each.names) for each in (found.best_graph(), graph)]
    assert shapes[0] == shapes[1]
    assert found.best_part.weight > 0.5
