"""What stands free of its surroundings is told where there is no floor; floors do not hang on chance."""

import numpy as np
import pytest

from derender.camera.intrinsics import Camera
from derender.detection.floors import find_floor
from derender.detection.freestanding import FARTHER, JOINED, NEARER, outlines, stand_free
from derender.structures.infer import infer_structure
from derender.structures.options import Options

CAMERA = Camera(140.0, 140.0, 79.5, 59.5, 160, 120)


def hills(before=()):
    """Return (H, W) metres of hills of twenty centimetres, with slabs before them: (rows, columns, depth) each."""
    row, column = np.indices(CAMERA.shape)
    image = 0.8 + 0.1 * np.sin(row / 17.0) * np.cos(column / 23.0) + 0.05 * np.sin(column / 9.0)
    for rows, columns, depth in before:
        image[rows, columns] = depth
    return image + 0.001 * np.random.default_rng(0).standard_normal(image.shape)


def test_what_stands_free_is_told_though_nothing_is_known_that_bears_it():
    slabs = [(slice(30, 60), slice(40, 70), 0.5), (slice(70, 95), slice(110, 130), 0.55)]
    found = infer_structure(hills(slabs), CAMERA, Options(seed=0, chains=2, draws=4))
    graph = found.best_graph()
    assert graph.names == ("thing_1", "thing_2") and found.meta["no_floor"]
    assert np.allclose(np.sort(graph.body("thing_1").size())[1:], 30 / 140 * 0.5, rtol=0.1)
    assert (found.explanation.label[slabs[1][:2]] == 1).mean() > 0.9
    assert 0.7 < found.object_probability("thing_1") < 0.99  # all of its outline stands out; it explains little


def test_what_returns_in_dots_only_is_told_too():
    """Images warped onto colour are dotted: here four of seven pixels are lost."""
    image = hills([(slice(30, 60), slice(40, 70), 0.5)])
    image[np.random.default_rng(0).random(image.shape) < 0.57] = np.nan
    graph = infer_structure(image, CAMERA, Options(method="map", seed=0)).best_graph()
    assert graph.names == ("thing_1",)
    assert np.allclose(np.sort(graph.body("thing_1").size())[1:], 30 / 140 * 0.5, rtol=0.1)


def test_what_the_border_cuts_or_something_hides_does_not_stand_free():
    cut, hidden = (slice(0, 40), slice(40, 70), 0.5), (slice(60, 80), slice(60, 110), 0.6)
    hiding = [(slice(58, 70), slice(56, 116), 0.4), (slice(70, 82), slice(56, 92), 0.4),
              (slice(70, 82), slice(106, 116), 0.4)]  # fmt: skip
    names = infer_structure(hills([cut, hidden, *hiding]), CAMERA, Options(method="map", seed=0)).best_graph().names
    assert len(names) == 1  # what hides


def test_beyond_an_outline_lies_what_is_farther_nearer_or_joined():
    depth = np.full((9, 9), 1.0)
    depth[:, 5:] = 0.5
    points = np.dstack([*np.meshgrid(np.arange(9) * 0.01, np.arange(9) * 0.01), depth])
    piece = np.full((9, 9), -1)
    piece[3:6, 3:5], piece[3:6, 5:7] = 0, 1
    even = np.full((9, 9), 0.02)
    found = outlines(piece, 2, points, np.ones((9, 9), bool), even, 0.5 * even, np.zeros(3))
    assert found[0, [JOINED, FARTHER, NEARER]].tolist() == [7, 0, 3]
    assert found[1, [JOINED, FARTHER, NEARER]].tolist() == [7, 3, 0]


def test_what_is_joined_hidden_or_cut_along_most_of_its_outline_does_not_stand_free():
    shares = np.array([[0.3, 0.6, 0.0, 0.1, 0.0], [0.6, 0.4, 0.0, 0.0, 0.0], [0.0, 0.4, 0.5, 0.1, 0.0],
                       [0.0, 0.8, 0.0, 0.0, 0.2], [0.0, 0.3, 0.0, 0.7, 0.0]])  # fmt: skip
    assert stand_free(shares).tolist() == [True, False, False, False, False]


@pytest.mark.parametrize("seed", range(3))
def test_a_mirror_image_has_the_mirrored_floor(seed):
    """A floor in a tenth of the image before hills, with a third of the returns lost at random."""
    row, column = np.indices(CAMERA.shape)
    floor = 0.3 * 140.0 / np.maximum(row - 45.0 + 0.02 * column, 1e-9)
    image = np.where(row < 109, hills(), np.minimum(floor, 2.0))
    image = np.where(np.random.default_rng(seed).random(image.shape) < 0.3, np.nan, image)
    camera = Camera(140.0, 140.0, 159 - 79.5, 59.5, 160, 120)
    one, other = find_floor(image, CAMERA), find_floor(image[:, ::-1], camera)
    assert np.allclose(one.pose[:3, 2] * [-1, 1, 1], other.pose[:3, 2], atol=0.02)
    assert -one.pose[1, 2] > 0.9
