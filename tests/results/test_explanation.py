"""What a scene says of each pixel: against a scene whose pixels are known, with what it cannot know added to it."""

import numpy as np
import pytest
from on_floor import cube, on_floor

from derender.camera.intrinsics import Camera
from derender.render.blur import blur
from derender.results.fit import BACKGROUND, FLOOR, UNEXPLAINED, Explanation, explain, grow, means_about, smooth_surface

CAMERA = Camera.from_field_of_view(64, 48)
BOX, WALL, GHOST = (slice(20, 28), slice(28, 36)), (slice(0, 6), slice(0, 64)), (slice(38, 42), slice(5, 9))


@pytest.fixture
def graph():
    """A cube of 20 cm on a floor 1 m below a camera that looks straight down."""
    return on_floor(cube(side=0.2))


@pytest.fixture
def seen(graph):
    """Its depth image with a wall in the first rows and something else in a corner."""
    depth = explain(graph, np.ones(CAMERA.shape), CAMERA).depth.astype(float)
    depth[WALL], depth[GHOST], depth[45, 60] = 0.7, 0.9, np.nan
    return depth


def test_each_pixel_has_its_object_or_says_what_it_is(graph, seen):
    background = np.zeros(seen.shape, bool)
    background[WALL] = True
    told = explain(graph, seen, CAMERA, background=background)
    assert told.names == ("red",)
    assert (told.label[BOX] == 0).all() and np.allclose(told.depth[BOX], 0.8)
    assert (told.label[WALL] == BACKGROUND).all() and np.allclose(told.depth[WALL], 0.7)
    assert (told.label[GHOST] == UNEXPLAINED).all() and np.isnan(told.depth[GHOST]).all()
    assert told.label[45, 60] == FLOOR and told.depth[45, 60] == pytest.approx(1.0)
    assert told.share(seen) == pytest.approx(1.0 - 16 / (64 * 48 - 1))


def test_what_lies_before_the_background_stays_an_object(graph, seen):
    told = explain(graph, seen, CAMERA, background=np.ones(seen.shape, bool))
    assert (told.label[BOX] == 0).all()


def test_noise_about_the_floor_is_the_floor(graph, seen):
    seen[GHOST] = 0.97
    assert (explain(graph, seen, CAMERA, noise=0.01).label[GHOST] == FLOOR).all()
    assert (explain(graph, seen, CAMERA, noise=0.001).label[GHOST] == UNEXPLAINED).all()


def test_the_background_is_smoothed_but_not_across_its_steps():
    rng = np.random.default_rng(0)
    depth = np.where(np.arange(40)[None] < 20, 1.0, 1.5) + 0.002 * rng.standard_normal((30, 40))
    smooth = smooth_surface(depth, np.ones(depth.shape, bool))
    off = smooth - np.where(np.arange(40)[None] < 20, 1.0, 1.5)
    assert 0.0002 < off.std() < 0.0009
    assert (smooth_surface(depth, np.zeros(depth.shape, bool)) == 0.0).all()


def test_how_many_pixels_a_mean_is_of_tells_what_it_leaves_of_their_noise():
    rng = np.random.default_rng(0)
    depth, step = 1.0 + 0.002 * rng.standard_normal((60, 80)), np.full((60, 80), 0.1)
    depth[30, 40] = 1.5
    mean, many = means_about(depth, rng.random(depth.shape) < 0.3, step)
    assert many.max() > 10.0 and many[30, 40] <= 1.0
    seen = many > 1.0
    left = (depth - mean)[seen] ** 2 * many[seen] / (many[seen] - 1.0)
    assert np.sqrt(left.mean()) == pytest.approx(0.002, rel=4.0 / np.sqrt(seen.sum()))


def test_a_floor_that_the_sensor_bends_is_explained_as_it_is_seen(graph, seen):
    bent = np.zeros(seen.shape, bool)
    bent[30:45, :20] = True
    seen[30:34, :20] = 0.97
    told = explain(graph, seen, CAMERA, bent=bent)
    assert (told.label[30:34, :20] == FLOOR).all() and np.allclose(told.depth[30:34, :20], 0.97)
    assert (told.label[GHOST] == UNEXPLAINED).all()  # ten centimetres are no bend


def test_a_floor_is_where_it_is_seen_to_bend(graph, seen):
    bend = np.zeros(seen.shape)
    bend[GHOST] = 0.1
    told = explain(graph, seen, CAMERA, bend=bend)
    assert (told.label[GHOST] == FLOOR).all() and np.allclose(told.depth[GHOST], 0.9)


def test_a_solid_is_seen_as_bent_as_the_floor(graph, seen):
    told = explain(graph, seen, CAMERA, bend=np.full(seen.shape, 0.03))
    assert (told.label[BOX] == 0).all() and np.allclose(told.depth[BOX], 0.77)


def test_background_before_a_solid_hides_it(graph, seen):
    seen[24:28, 28:36] = 0.5
    told = explain(graph, seen, CAMERA, background=np.ones(seen.shape, bool))
    assert (told.label[24:28, 28:36] == BACKGROUND).all() and np.allclose(told.depth[24:28, 28:36], 0.5)
    assert (told.label[20:24, 28:36] == 0).all()
    told = explain(graph, seen, CAMERA, background=np.ones(seen.shape, bool), hides=False)
    assert (told.label[24:28, 28:36] == 0).all() and (told.depth[24:28, 28:36] > 0.6).all()  # what is there is not told


def test_what_goes_on_beyond_a_coarse_outline_is_the_things():
    label, depth = np.full((1, 8), UNEXPLAINED, np.int32), np.full((1, 8), np.nan)
    label[0, 2], depth[0, 2] = 0, 1.0
    seen = np.array([[1.2, 1.01, 1.0, 1.01, 1.02, 1.03, 0.0, 1.0]])
    for _ in range(2):
        grow(label, depth, seen, np.array([True]))
    assert (label[0] == 0).tolist() == [False, True, True, True, True, False, False, False]  # two pixels, no step
    assert np.allclose(depth[0, 1:5], seen[0, 1:5])


def test_an_object_that_few_pixels_contradict_is_not_ruled_out():
    """A structure with such an object had no weight at all, and where all had it none could be drawn from."""
    label = np.array([[0, 0, -3, 1, 1]], np.int32)
    told = Explanation(label, np.array([[1.0, 1.0, np.nan, 1.5, 1.5]], np.float32), ("lost", "found"))
    assert told.borne_out(np.full((1, 5), 1.5)) == {"lost": pytest.approx(0.25), "found": pytest.approx(0.75)}


def test_a_blurred_outline_contradicts_no_object():
    """Of a solid that shows in a dozen pixels most are its outline's, between it and what is beside it."""
    label = np.full((12, 12), -1, np.int32)
    label[4:8, 4:8] = 0
    depth = np.where(label == 0, 0.8, 1.0)
    told = Explanation(label, depth.astype(np.float32), ("small",))
    assert told.borne_out(blur(depth, 0.5)) == {"small": pytest.approx(17 / 18)}
    assert told.borne_out(np.full(depth.shape, 0.5))["small"] == pytest.approx(1 / 18)
