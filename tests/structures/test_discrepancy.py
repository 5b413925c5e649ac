"""What the draws of real solids' faces add to where the faces appear to be."""

import numpy as np
import pytest

from derender.detection.search.greedy import Settings
from derender.detection.solids.image import make_row, rotation_of
from derender.detection.solids.interpenetration import highest, lowest
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.scene.pose import rotation_x, rotation_z
from derender.scene.solids import BOX, CYLINDER, SPHERE
from derender.structures.draws.discrepancy import with_offsets
from derender.structures.scored_posterior import undo_spin

OFF = 0.003
COUNT = 4000


@pytest.fixture(scope="module")
def drawn():
    """Return the state of a tower of four kinds with a box that leans beside it, and (COUNT, 5, ROW) draws."""
    state = State()
    state = state.add(
        make_row(BOX, rotation_z(0.4)[:3, :3], [0, 0, 0.04], [0.1, 0.12, 0.08]), UPRIGHT, False, FLOOR, 0.0
    )
    upside_down = rotation_x(np.pi)[:3, :3]
    state = state.add(make_row(CYLINDER, upside_down, [0, 0, 0.13], [0.08, 0.08, 0.1]), UPRIGHT, False, 0, 0.08)
    state = state.add(make_row(BOX, np.eye(3), [0, 0, 0.21], [0.06] * 3), UPRIGHT, True, 1, 0.18)
    state = state.add(make_row(SPHERE, np.eye(3), [0, 0, 0.27], [0.06] * 3), FREE, False, 2, 0.24)
    leaning = rotation_x(0.6)[:3, :3]
    state = state.add(make_row(BOX, leaning, [0.3, 0, 0.1], [0.05, 0.06, 0.07]), FREE, False, FLOOR, np.nan)
    rng = np.random.default_rng(0)
    return state, np.array([with_offsets(rng, state.rows, state, OFF) for _ in range(COUNT)])


def test_what_stands_stays_on_its_support(drawn):
    state, rows = drawn
    for draw in rows[:50]:
        assert lowest(draw[0]) == pytest.approx(0.0, abs=1e-12)
        for k in (1, 2, 3):
            assert lowest(draw[k]) == pytest.approx(highest(draw[k - 1]), abs=1e-12)


def test_shapes_stay_what_they_are(drawn):
    state, rows = drawn
    assert np.array_equal(rows[:, :, 1:10], np.broadcast_to(state.rows[:, 1:10], rows[:, :, 1:10].shape))
    assert np.allclose(rows[:, 1, 13], rows[:, 1, 14])
    for k in (2, 3):
        assert np.ptp(rows[:, k, 13:16], axis=1).max() < 1e-12


def test_each_face_has_an_offset_of_its_own(drawn):
    """An extent between two faces, or the floor and one, spreads by the root of two, one on a solid by one face's."""
    state, rows = drawn
    spread = (rows[:, :, 13:16] - state.rows[:, 13:16]).std(axis=0) / OFF
    error = 4 / np.sqrt(2 * COUNT)  # four standard errors of a standard deviation, relative
    root = np.sqrt(2)
    wanted = np.array([[root, root, root], [root, root, 1], [root] * 3, [root] * 3, [root] * 3])
    assert np.abs(spread / wanted - 1).max() < error
    assert np.abs((rows[:, :, 13:16] - state.rows[:, 13:16]).mean(axis=0)).max() < 4 * root * OFF / np.sqrt(COUNT)
    # the middle of a free extent moves by half the difference of two offsets
    middle = (rows[:, 4, 10:13] - state.rows[4, 10:13]) @ state.rows[4, 1:10].reshape(3, 3)
    assert np.abs(middle.std(axis=0) / (OFF / root) - 1).max() < error


def test_all_on_the_floor_share_its_offset():
    state = State()
    for x in (0.0, 0.2):
        row = make_row(BOX, np.eye(3), [x, 0, 0.04], [0.1, 0.12, 0.08])
        state = state.add(row, UPRIGHT, False, FLOOR, 0.0)
    rng = np.random.default_rng(0)
    heights = np.array([with_offsets(rng, state.rows, state, OFF)[:, 15] for _ in range(COUNT)])
    assert abs(np.corrcoef(heights.T)[0, 1] - 0.5) < 4 * 0.75 / np.sqrt(COUNT)  # half of each variance is the floor's


def test_only_images_of_real_sensors_have_it():
    assert Settings().for_correlation(0.2).discrepancy == 0.0
    assert Settings().for_correlation(0.8).discrepancy == OFF


def test_turns_of_a_cylinder_about_its_own_axis_are_undone():
    rng = np.random.default_rng(0)
    start = rotation_z(0.3)[:3, :3] @ rotation_x(np.pi / 2)[:3, :3]  # lying
    tilts = [rotation_z(turn)[:3, :3] @ start for turn in rng.normal(0.0, 0.3, 20)]
    rows = np.array([make_row(CYLINDER, tilt @ rotation_z(rng.uniform(0, 6))[:3, :3], [0, 0, 0.1], [0.1] * 3)
                     for tilt in tilts])  # fmt: skip
    undo_spin(rows, make_row(CYLINDER, start, [0, 0, 0.1], [0.1] * 3))
    for row, tilt in zip(rows, tilts, strict=True):
        assert np.allclose(rotation_of(row), tilt)
