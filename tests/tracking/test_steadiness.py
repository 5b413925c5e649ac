"""A camera that is taken to stand and moves is doubted: the floor leaves its place, or all that rests moves alike."""

import films
import numpy as np
import pytest
from films import CAMERA, FPS, at, film, start

from derender.tracking.track import Recorder

GRAVITY = -9.81 * films.view()[:3, 2]
SIZES = [[0.06, 0.06, 0.07], [0.05, 0.07, 0.05], [0.06, 0.05, 0.06]]


def doubts_of(ways, views=None, moving_camera=False):
    """Return what is doubted of a film of boxes that go so many metres a frame along the floor's x and y axes."""
    begun = [(-0.09, 0.0), (0.02, 0.06), (0.09, -0.05)]
    paths = [[at(x + t * w[0], y + t * w[1], size[2] / 2) for (x, y), w, size in zip(begun, ways, SIZES, strict=False)]
             for t in range(9)]  # fmt: skip
    count = len(ways)
    frames, poses = film(np.random.default_rng(0), ["box"] * count, SIZES[:count], paths, views)
    first = start(["box"] * count, SIZES[:count], poses[0])
    recorder = Recorder(frames[0], CAMERA, first, GRAVITY, 1 / FPS, moving_camera)
    for frame in frames[1:]:
        recorder.advance(frame)
    return recorder.track().doubts


def along(step):
    """Return the views of a camera that goes so many metres a frame to the side, at one height above the floor."""
    return [films.view() @ at(-step * t, 0.0, 0.0) for t in range(9)]


REST = (0.0, 0.0)


@pytest.mark.parametrize(
    "ways, named", [([REST, REST], "box_1 and box_2"), ([(0.0, 0.006), REST, REST], "box_2 and box_3")]
)
def test_all_that_rests_moves_alike_before_a_camera_that_moves_unsaid(ways, named):
    """Moves of all resting things were listed without a doubt."""
    (doubt,) = doubts_of(ways, along(0.006))
    assert named in doubt and "--moving-camera" in doubt
    assert doubts_of(ways, along(0.006), moving_camera=True) == []


def test_a_floor_that_leaves_its_place_shows_a_camera_that_moves_unsaid():
    """It does so beside a single thing, or none, too."""
    for ways in ([], [REST]):
        views = [films.view(distance=0.7 + 0.0015 * t) for t in range(9)]
        (doubt,) = doubts_of(ways, views)
        assert "floor" in doubt and "--moving-camera" in doubt


@pytest.mark.parametrize("ways", [
    [(0.006, 0.0)],  # the only thing there is
    [(0.006, 0.0), REST, (0.006, 0.0)],  # two that are pushed by one hand, while one rests
    [(0.006, 0.0), (0.0, -0.005), REST],
    [(0.006, 0.0), (0.0, -0.005)],  # each its own way
])  # fmt: skip
def test_things_that_move_before_a_camera_that_stands_raise_no_doubt(ways):
    assert doubts_of(ways) == []
