"""Guesses of solids that show given points: of each way, and of a drum of which little shows."""

import numpy as np
import pytest

from derender.detection.search.greedy import Settings
from derender.detection.search.observation import observe
from derender.detection.search.places import guess, guesses
from derender.detection.solids.image import ROW, make_row
from derender.detection.solids.interpenetration import lowest, reach
from derender.detection.solids.misfit import added_misfit
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import State, held_out
from derender.scene.solids import BOX, CYLINDER, SPHERE
from worlds.made_scenes import photograph

SHAPES = Settings().shapes
LYING = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # its own axis along the floor's x
WAYS = {  # kind, rotation, size of what is seen
    "box": ("box", np.eye(3), [0.07, 0.09, 0.06]),
    "can": ("cylinder", np.eye(3), [0.07, 0.07, 0.09]),
    "drum": ("cylinder", LYING, [0.07, 0.07, 0.1]),
    "ball": ("sphere", np.eye(3), [0.08, 0.08, 0.08]),
}


def posed(rotation, x, y, height):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, [x, y, height]
    return pose


@pytest.mark.parametrize("way", WAYS)
def test_the_best_guess_is_one_to_polish(way):
    kind, rotation, size = WAYS[way]
    height = 0.5 * (size[0] if way == "drum" else size[2])
    there = posed(rotation, 0, 0, height)
    scene = photograph(np.random.default_rng(3), [kind], np.array([size]), there[None], ["floor"])
    seen = observe(scene["depth"], scene["camera"])
    depth, _, misfit, _ = held_out(seen.image, State(), -1)
    pose = np.linalg.inv(seen.floor.pose) @ scene["floor"] @ there
    numbers = {"box": BOX, "cylinder": CYLINDER, "sphere": SPHERE}
    true = added_misfit(seen.image, make_row(numbers[kind], pose[:3, :3], pose[:3, 3], size), depth, misfit)
    found = guesses(np.random.default_rng(1), seen.image, seen.points[seen.mask], SHAPES, 0.0, depth, misfit)
    assert [(int(h.row[0]), h.form) for h in found] == [
        (BOX, UPRIGHT), (CYLINDER, UPRIGHT), (CYLINDER, FREE), (SPHERE, FREE)
    ]  # fmt: skip
    assert added_misfit(seen.image, found[list(WAYS).index(way)].row, depth, misfit) < 0.3 * true


@pytest.mark.parametrize("way", range(4))
def test_a_guess_stands_where_it_should_and_is_a_solid(way):
    rng, row = np.random.default_rng(way), np.empty(ROW)
    points = rng.uniform([-0.03, -0.03, 0.12], [0.03, 0.03, 0.18], (20, 3))
    for _ in range(50):
        guess(rng, way, np.array([0.5, -0.4, 0.6]), points, 0.1, row)
        rotation = row[1:10].reshape(3, 3)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0.0
        assert lowest(row) == pytest.approx(0.1, abs=1e-12) and row[13:].min() > 0.0
        if int(row[0]) != BOX:
            assert row[13] == row[14]
            # one of the points lies on its round side, or above or below all of it
            axis = rotation[:, 2] if int(row[0]) == CYLINDER else np.zeros(3)
            off = points - row[10:13]
            distance = np.linalg.norm(off - np.outer(off @ axis, axis), axis=1)
            outside = points[:, 2] > row[12] + reach(row, 0.0, 0.0, 1.0) - 1e-9
            assert np.abs(distance - 0.5 * row[13]).min() < 1e-9 or outside.any()


def test_shapes_that_are_not_allowed_are_not_guessed():
    scene = photograph(np.random.default_rng(3), ["box"], np.array([[0.07] * 3]), posed(np.eye(3), 0, 0, 0.035)[None],
                       ["floor"])  # fmt: skip
    seen = observe(scene["depth"], scene["camera"])
    depth, _, misfit, _ = held_out(seen.image, State(), -1)
    for shapes, kinds in ((("cube",), [BOX]), (("sphere",), [SPHERE]), (("cylinder",), [CYLINDER] * 2)):
        found = guesses(np.random.default_rng(1), seen.image, seen.points[seen.mask], shapes, 0.0, depth, misfit)
        assert [int(h.row[0]) for h in found] == kinds
