"""Boxes that are flush can be cut in two ways that look alike: both are weighed, by what holds what."""

import math

import numpy as np
import pytest

from derender.camera.intrinsics import Camera
from derender.detection.search.moves import cut_anew
from derender.detection.solids.beliefs import Rules, bare_image
from derender.detection.solids.image import make_row
from derender.detection.solids.interpenetration import highest
from derender.detection.solids.polish import UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.render.likelihoods import likelihoods
from derender.scene.pose import rotation_x, rotation_z
from derender.scene.solids import BOX, CYLINDER
from derender.structures.draws.chart import log_prior, make_chart, tipping
from derender.structures.draws.refined import at_mode
from derender.structures.draws.sensor import Sensor, model_depth
from derender.structures.unions import HIDDEN_GAP, merges, on_supports, parted_unseen, recuts, touching, ways_as_one
from derender.structures.weighing import evidence_over, odds_at

RULES = Rules(0.0015)
CERTAIN = 1.0 / bare_image().loose.tipping


def floor_pose():
    """The floor in front of a camera .7 m away that looks down by 30 degrees."""
    pose = rotation_x(math.pi / 2 + 0.5)
    pose[2, 3] = 0.7
    return pose


def boxes(*solids):
    """The State of boxes given as (x, y, bottom, size), their supports found by contact."""
    turned, state = rotation_z(0.3), State()
    for x, y, bottom, size in solids:
        centre = turned[:3, :3] @ [x, y, bottom + size[2] / 2]
        state = state.add(make_row(BOX, turned[:3, :3], centre, np.array(size)), UPRIGHT, False, FLOOR, bottom)
    return on_supports(state)


def standing(*rows):
    """The State of solids that stand upright on the floor."""
    state = State()
    for row in rows:
        state = state.add(row, UPRIGHT, False, FLOOR, 0.0)
    return state


SIDE, BOARD = [0.03, 0.1, 0.1], [0.3, 0.1, 0.03]


def shelf():
    """A board on two sides, flush with both."""
    return boxes((-0.135, 0, 0, SIDE), (0.135, 0, 0, SIDE), (0, 0, 0.1, BOARD))


def hung():
    """The same outline: one side beside the board's end, that is carried by the other alone."""
    return boxes((-0.135, 0, 0, [0.03, 0.1, 0.13]), (0.135, 0, 0, SIDE), (0.015, 0, 0.1, [0.27, 0.1, 0.03]))


def corner():
    """An L of two boxes on the floor."""
    return boxes((0, 0, 0, [0.05, 0.12, 0.06]), (0.065, -0.035, 0, [0.08, 0.05, 0.06]))


def tips(refined):
    """Whether something would tip."""
    return bool(tipping(refined.chart, refined.state.rows))


def seen_as(rng, truth, state, sigma=0.001):
    """Return the Refined of a state given the image of another, with so many metres of noise."""
    view, likelihood = Camera(75.0, 75.0, 39.5, 29.5, 80, 60), likelihoods["gaussian"]
    numbers = likelihood.complete({"sigma": sigma})
    depth = model_depth(*make_chart(truth, floor_pose(), RULES), view)
    sensor = Sensor(view, likelihood.sample(rng, depth, numbers), likelihood, numbers)
    return at_mode(rng, state, floor_pose(), sensor, RULES)


def weighed(state, seed=0):
    """Return (Refined of a state given its own image, the ways to cut it with their log odds)."""
    rng = np.random.default_rng(seed)
    best = seen_as(rng, state, state)
    return best, recuts(rng, best, RULES)


BEFORE = (0.02, -0.06, 0, [0.1, 0.04, 0.13])  # a box that hides the middle of what is behind it


def two_ends(apart):
    """Two boxes behind a third, so many metres between them."""
    return boxes((-0.15, 0.05, 0, [0.3 - apart, 0.05, 0.06]), (0.15, 0.05, 0, [0.3 - apart, 0.05, 0.06]), BEFORE)


def test_two_ends_of_a_box_that_another_hides_the_middle_of_are_one():
    rng, board = np.random.default_rng(0), boxes((0, 0.05, 0, [0.59, 0.05, 0.06]), BEFORE)
    best = seen_as(rng, board, two_ends(0.025))
    assert len(best.state) == 3
    (found,) = [each for each in merges(rng, best, RULES) if len(each.trial.state) == 2]
    assert found.odds > 3.0 and np.isclose(found.trial.state.rows[:, 13].max(), 0.59, atol=0.005)


@pytest.mark.parametrize("seed", range(3))
def test_a_can_and_the_board_beside_it_may_be_one_box(seed):
    """Noise may have a search find them in a box. Boxes alone were tried as one with something smaller."""
    rng, turned, truth = np.random.default_rng(seed), rotation_z(0.3)[:3, :3], [0.11, 0.09, 0.08]
    can = make_row(CYLINDER, np.eye(3), turned @ [-0.01, 0.0, 0.04], np.array([0.09, 0.09, 0.08]))
    board = make_row(BOX, turned, turned @ [0.045, 0.0, 0.04], np.array([0.02, 0.09, 0.08]))
    best = seen_as(rng, boxes((0, 0, 0, truth)), standing(can, board), 0.012)
    (found,) = merges(rng, best, RULES)
    (one,) = found.trial.state.rows
    assert int(one[0]) == BOX and np.allclose(one[13:], truth, atol=0.02) and found.odds > 3.0


def test_what_stands_on_two_solids_stands_on_the_box_that_is_both():
    box, cube = boxes((0, 0, 0, [0.1, 0.08, 0.06])).rows[0], boxes((0.08, 0, 0.1, [0.03, 0.03, 0.03])).rows[0]
    can = make_row(CYLINDER, np.eye(3), np.array([0.08, 0.0, 0.05]), np.array([0.06, 0.06, 0.1]))
    state = on_supports(standing(box, can).add(cube, UPRIGHT, False, 1, 0.1))
    for way in ways_as_one(state, 0, 1):
        top = highest(way.rows[0])
        assert way.parents == [FLOOR, 0] and way.bottoms[1] == top and int(way.rows[0][0]) == BOX


def test_boxes_are_not_tried_as_one_where_the_floor_between_them_shows():
    apart = two_ends(0.05).without(2)
    best = seen_as(np.random.default_rng(0), apart, apart)
    assert touching(best.state, 0, 1, HIDDEN_GAP) and not parted_unseen(best, 0, 1, RULES)


def test_a_cut_keeps_the_outline_and_another_takes_it_back():
    one, _, board = hung().rows
    side, whole = cut_anew(one, board)
    true_side, _, true_board = shelf().rows
    np.testing.assert_allclose(side, true_side, atol=1e-12)
    np.testing.assert_allclose(whole, true_board, atol=1e-12)
    back, end = cut_anew(whole, side)
    np.testing.assert_allclose(back, board, atol=1e-12)
    np.testing.assert_allclose(end, one, atol=1e-12)


def test_a_board_that_only_friction_holds_is_not_held():
    """And is as much less probable as the file says."""
    chart, _ = make_chart(hung(), floor_pose(), RULES)
    assert tipping(chart, hung().rows) == [2]
    assert not tipping(make_chart(shelf(), floor_pose(), RULES)[0], shelf().rows)
    less = log_prior(chart._replace(tipping=0.0), hung().rows) - log_prior(chart, hung().rows)
    assert less == pytest.approx(np.log(CERTAIN))


def test_a_board_lies_on_both_sides_rather_than_hanging_on_one():
    """At the mode of what both share, and at any other place of it: what holds tells as much."""
    best, found = weighed(hung())
    right = [each for each in found if not tips(each.trial) and max(each.trial.state.rows[:, 15]) < 0.11]
    likeliest = max(right, key=lambda each: each.odds)
    assert likeliest.odds > 0.5 * np.log(CERTAIN)
    kept, cut = 1, (0, 2)  # the other side; the board and the side that it is cut from
    np.testing.assert_allclose(likeliest.trial.state.rows[kept, 10:16], best.state.rows[kept, 10:16], atol=0.02)
    rng = np.random.default_rng(1)
    own, _ = evidence_over(rng, best, cut)
    again, _ = odds_at(rng, best, likeliest._replace(places=(cut, cut)), best.values, own, RULES)
    assert abs(again - likeliest.odds) < 0.5 * np.log(CERTAIN)


def test_a_board_on_both_sides_stays_there():
    """The broken twin: without the odds of what holds, the cuts would be as likely as each other."""
    best, found = weighed(shelf())
    wrong = [odds for trial, odds, *_ in found if tips(trial)]
    assert wrong and max(wrong) < -0.5 * np.log(CERTAIN)
    assert max(odds + np.log(CERTAIN) for trial, odds, *_ in found if tips(trial)) > -3.0


@pytest.mark.parametrize("seed", [0, 1])
def test_two_ways_to_cut_a_corner_are_both_weighed(seed):
    _, found = weighed(corner(), seed)
    assert any(abs(odds) < 4.0 for _, odds, *_ in found)
