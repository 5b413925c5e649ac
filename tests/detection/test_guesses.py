"""Guesses of solids that show given points: of each way, and of a drum of which little shows."""

import numpy as np
import pytest

import derender.detection.search.moves as moves
from derender.detection.search.greedy import Settings, settle, total_energy
from derender.detection.search.guesses import guess, guesses
from derender.detection.search.observation import observe
from derender.detection.search.searches import repair
from derender.detection.solids.graph import pose_of
from derender.detection.solids.image import ROW, make_row, render_floor_scene
from derender.detection.solids.interpenetration import lowest, reach
from derender.detection.solids.misfit import added_misfit
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import FLOOR, State, held_out
from derender.evaluation.made_scenes import photograph
from derender.scene.pose import rotation_x
from derender.scene.solids import BOX, CYLINDER, SPHERE

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


def behind():
    """Return (Observation, State of the truth, State of boxes in the drum's place): a drum behind a can."""
    world = rotation_x(np.arccos(-0.4015))
    world[:3, 3] = 0.04, -0.26, 1.536
    camera = {"fx": 125.7, "fy": 125.7, "cx": 76.0, "cy": 58.7, "width": 160, "height": 120}
    axis = np.array([0.511, 0.8596, 0.0])
    lying = np.column_stack([[-axis[1], axis[0], 0.0], [0.0, 0.0, 1.0], axis])
    drum = make_row(CYLINDER, lying, [-0.0914, -0.7817, 0.0575], [0.115, 0.115, 0.0652])
    can = make_row(CYLINDER, np.eye(3), [-0.0531, -0.8876, 0.0651], [0.1006, 0.1006, 0.1302])
    poses = world @ np.array([pose_of(row) for row in (drum, can)])
    depth, _ = render_floor_scene(["cylinder"] * 2, poses, np.array([drum[13:], can[13:]]), world, camera)
    depth += 0.001 * np.random.default_rng(5).normal(size=depth.shape)
    seen = observe(depth, camera)
    into = np.linalg.inv(seen.floor.pose) @ world

    def seen_as(kind, row):
        pose = into @ pose_of(row)
        return make_row(kind, pose[:3, :3], pose[:3, 3], row[13:])

    true = State().add(seen_as(CYLINDER, drum), FREE, False, FLOOR, 0.0)
    true = true.add(seen_as(CYLINDER, can), UPRIGHT, False, FLOOR, 0.0)
    wrong = true.without(0)
    for centre, size in (([-0.0901, -0.7782, 0.0571], [0.0706, 0.0461, 0.1142]),
                         ([-0.1173, -0.8194, 0.0519], [0.0082, 0.0376, 0.1038])):  # fmt: skip
        wrong = wrong.add(seen_as(BOX, make_row(BOX, np.eye(3), centre, size)), UPRIGHT, False, FLOOR, 0.0)
    return seen, true, wrong


def left(seen, wrong, least, seeds=5):
    """Return the nats that are left, at the median, when the search has repaired a wrong state."""
    found = [repair(np.random.default_rng(k), seen.image, wrong, [], Settings(), []) for k in range(seeds)]
    return np.median([total_energy(seen.image, state, Settings()) for state in found]) - least


def test_a_drum_of_which_little_shows_is_guessed(monkeypatch):
    seen, true, wrong = behind()
    wrong, true = (settle(np.random.default_rng(0), seen.image, state, Settings(), 300) for state in (wrong, true))
    least = total_energy(seen.image, true, Settings())
    assert left(seen, wrong, least) < 60.0
    monkeypatch.setattr(moves, "guesses", lambda *_: [])  # the broken twin
    assert left(seen, wrong, least) > 120.0
