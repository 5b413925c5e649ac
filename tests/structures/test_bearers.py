"""Who bears most of a board that leans: it hangs on the friction of its contacts, of which the prior's file speaks.
And one that nothing holds goes on to the floor, behind what it leans on."""

from types import SimpleNamespace

import numpy as np
import pytest

from derender.detection.solids.beliefs import Rules
from derender.detection.solids.image import make_row
from derender.detection.solids.interpenetration import lowest
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.detection.solids.support import standing_on
from derender.scene.distributions import distributions
from derender.scene.pose import rotation_y
from derender.scene.priors.bare_image import Loose
from derender.scene.solids import BOX
from derender.structures.bridges import by_bearer
from derender.structures.changes import is_held, reached_down, tipping_of
from derender.structures.draws.chart import make_chart
from derender.structures.infer import infer_structure
from derender.structures.options import Options
from worlds.frontier_scenes import KINDS, make

LONG, THICK, BLOCK = 0.17, 0.01, np.array([0.08, 0.12, 0.07])  # metres


def leaning(foot):
    """Return the State of a block and of a board that leans on its upper edge, its foot so far away (metres)."""
    tilt = np.arctan2(BLOCK[2], foot)
    along, normal = np.array([np.cos(tilt), 0, np.sin(tilt)]), np.array([-np.sin(tilt), 0, np.cos(tilt)])
    centre = 0.5 * LONG * along + 0.5 * THICK * normal - [0.5 * BLOCK[0] + foot, 0, 0]
    turn = np.column_stack([along, [0, 1, 0], normal])
    block = make_row(BOX, np.eye(3), [0, 0, 0.5 * BLOCK[2]], BLOCK)
    state = State().add(block, UPRIGHT, False, FLOOR, 0.0)
    return state.add(make_row(BOX, turn, centre, [LONG, 0.07, THICK]), FREE, False, FLOOR, np.nan)


def chances(foot, friction):
    """Return {parent of the board: probability}."""
    state = leaning(foot)
    chart, values = make_chart(state, np.eye(4), Rules(0.001))
    found = by_bearer(np.random.default_rng(0), state, chart, values[None], friction)
    assert all(each.parents[0] == FLOOR for each, _ in found)
    return {each.parents[1]: share for each, share in found}


def test_a_parent_that_hangs_on_friction_is_open():
    open_one = chances(0.09, Loose().friction)
    assert 0.1 < open_one[FLOOR] < 0.9 and sum(open_one.values()) == pytest.approx(1.0)
    assert chances(0.03, Loose().friction)[FLOOR] > 0.85  # a steep board stands on the floor by nearly any friction


def test_the_friction_of_the_file_decides():
    assert chances(0.09, distributions["uniform"](0.25, 0.3)) == {FLOOR: 1.0}
    assert chances(0.09, distributions["uniform"](0.8, 0.9)) == {0: 1.0}


def test_a_board_that_nothing_holds_goes_on_to_the_floor():
    """Its upper half alone would slip off the block's edge: that costs what tipping does."""
    whole = leaning(0.06)
    short = whole.copy()
    half = 0.4 * LONG
    short.rows[1, 13] -= half
    short.rows[1, 10:13] += 0.5 * half * short.rows[1, 1:10].reshape(3, 3)[:, 0]
    (found,) = reached_down(SimpleNamespace(state=short), 1)
    assert found.rows[1, 13] == pytest.approx(LONG, abs=1e-6) and found.rows[1, 15] == THICK
    assert reached_down(SimpleNamespace(state=whole), 1) == []
    chart = SimpleNamespace(tipping=4.6)
    costs = [tipping_of(SimpleNamespace(state=state, chart=chart)) for state in (short, whole)]
    assert costs == [4.6, 0.0]


def test_a_board_on_a_block_may_stand_on_the_floor_as_well():
    """Of 7303 at seed 7 it ended 4 mm over the floor: it was said to lie on the block at .995, nothing else weighed."""
    hung = leaning(0.06)
    hung.rows[1, 13] -= 0.005
    hung.rows[1, 10:13] += 0.0025 * hung.rows[1, 1:10].reshape(3, 3)[:, 0]
    hung.parents[1] = 0
    (found,) = reached_down(SimpleNamespace(state=hung), 1)
    assert found.parents[1] == FLOOR and lowest(found.rows[1]) == pytest.approx(0.0, abs=1e-6)
    chart = SimpleNamespace(tipping=4.6)  # nor does the floor hold the one on the block, which would slip off it
    assert [tipping_of(SimpleNamespace(state=state, chart=chart)) for state in (hung, found)] == [4.6, 0.0]


def test_what_shows_of_a_board_behind_a_block_may_stand_on_the_floor_though_the_block_could_hold_it():
    """Of boards 9200 a strip 18 mm high showed over the block: said to lie on its edge, 199 nats below the truth."""
    turn = rotation_y(-np.radians(60.0))[:3, :3]
    top, strip = [0.0, 0.0, BLOCK[2]], np.array([0.018, 0.07, 0.012])
    state = State().add(make_row(BOX, np.eye(3), [0, 0, 0.5 * BLOCK[2]], BLOCK), UPRIGHT, False, FLOOR, 0.0)
    centre = top + np.array([-0.03, 0.0, 0.5 * (strip * np.abs(turn[2])).sum() - 0.001])
    state = state.add(make_row(BOX, turn, centre, strip), FREE, False, 0, np.nan)
    assert is_held(state, 1)
    (found,) = reached_down(SimpleNamespace(state=state), 1)
    assert found.parents[1] == FLOOR and lowest(found.rows[1]) == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(found.rows[1, 14:16], strip[1:])


def test_a_board_whose_foot_hides_is_not_surely_on_the_block():
    """Of 7303 106 pixels show the upper end: said to lie on the block's edge at .88, and nothing else was weighed.

    Seeds say .57 to .71 of the floor, the true one: how much is not asked here.
    """
    seen = make(np.random.default_rng([7303, list(KINDS).index("boards")]), "boards")
    found = infer_structure(seen.depth, seen.camera, Options(seed=7))
    assert found.parent_probability("box_2").get("floor", 0.0) > 0.01


def test_of_tops_as_high_the_one_below_most_of_a_solid_is_what_it_stands_on():
    """Cartons in a grid: of two flush tops the one that was a hair nearer counted, though only its rim was below."""
    places = (0.0, 0.0, 0.1), (0.4, 0.0, 0.0999), (0.397, 0.0, 0.3)
    rows = np.array([make_row(BOX, np.eye(3), place, np.array([0.4, 0.3, 0.2])) for place in places])
    state = State(rows, [FREE] * 3, [False] * 3, [FLOOR] * 3, [0.0, 0.0, 0.2])
    assert standing_on(state, 2) == (1, pytest.approx(0.1999))
    rows[1, 12] -= 0.01  # a step down: what is left of it rests on the rim
    assert standing_on(state, 2)[0] == 0
