"""What hides of a solid: a side of a box, a part of a disc, all of it; and the names of solids whose sides hide."""

import math

import numpy as np
import pytest
from table_scenes import CAMERA, TABLE, seen_on_the_table

from derender.camera.intrinsics import Camera
from derender.detection.estimate import point_estimate
from derender.detection.leftovers import leftovers
from derender.detection.search.greedy import Settings, Task
from derender.detection.search.moves import parted_pairs
from derender.detection.search.observation import observe
from derender.detection.search.proposals import rim_circle
from derender.detection.search.searches import Climb, merged, reached
from derender.detection.solids.beliefs import Rules
from derender.detection.solids.graph import matched_names
from derender.detection.solids.image import make_row
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.render.likelihoods import likelihoods
from derender.scene.pose import rotation_x, rotation_z
from derender.scene.solids import BOX, SPHERE
from derender.structures.alternatives import all_seen, of_one_solid
from derender.structures.changes import changes, still_bears
from derender.structures.draws.chart import HELD, make_chart
from derender.structures.draws.refined import at_mode
from derender.structures.draws.sensor import Sensor, model_depth
from derender.structures.unions import merges
from worlds.made_scenes import drawn_scene

RULES = Rules(0.0015)


def floor_pose():
    """The floor in front of a camera .7 m away that looks down by 40 degrees."""
    pose = rotation_x(math.pi / 2 + 0.7)
    pose[2, 3] = 0.7
    return pose


def solid(kind, x, y, size, theta=0.3):
    return make_row(kind, rotation_z(theta)[:3, :3], np.array([x, y, size[2] / 2]), np.array(size, float))


def on_the_floor(*solids):
    """The State of (row, cube) that stand on the floor."""
    state = State()
    for row, cube in solids:
        state = state.add(row, UPRIGHT, cube, FLOOR, 0.0)
    return state


def weighed(rng, shown, believed):
    """The Refined of a state, given an image of another."""
    view = Camera(75.0, 75.0, 39.5, 29.5, 80, 60)
    chart, start = make_chart(shown, floor_pose(), RULES)
    likelihood = likelihoods["gaussian"]
    numbers = likelihood.complete({"sigma": 0.001})
    sensor = Sensor(view, likelihood.sample(rng, model_depth(chart, start, view), numbers), likelihood, numbers)
    return at_mode(rng, believed, floor_pose(), sensor, RULES)


def test_a_box_with_a_hidden_side_may_be_a_cube():
    row = solid(BOX, 0.0, 0.0, [0.144, 0.063, 0.064])
    state = on_the_floor((row, False))
    best = weighed(np.random.default_rng(6), state, state)
    sides = [new.rows[0][13] for new in changes(best, 0) if new.cubes[0]]
    assert min(abs(side - 0.063) for side in sides) < 0.002


def test_what_bears_another_is_no_cube_that_leaves_it_in_the_air():
    """The top of the middle one of three hides behind the uppermost, and as a cube it would end 14 mm below it."""
    lower, middle = solid(BOX, 0.0, 0.0, [0.09, 0.08, 0.08]), solid(BOX, -0.02, 0.0, [0.05, 0.052, 0.072], 0.4)
    upper = solid(BOX, -0.03, -0.02, [0.09] * 3, 1.0)
    middle[12] += 0.08
    upper[12] += 0.152
    state = State().add(lower, UPRIGHT, False, FLOOR, 0.0).add(middle, UPRIGHT, False, 0, 0.08)
    state = state.add(upper, UPRIGHT, True, 1, 0.152)
    rng = np.random.default_rng(3)
    best = weighed(rng, state, state)
    kept = [still_bears(best, new, 1) for new in changes(best, 1)]
    assert any(kept) and not all(kept)
    assert all(trial.chart.flags[2, HELD] for trial, *_ in of_one_solid(rng, best, 1, RULES) if len(trial.state) == 3)


def test_a_cube_keeps_the_name_of_the_box_that_it_was_however_far_that_reached():
    long, short = solid(BOX, 0.0, 0.0, [0.06, 0.16, 0.06], 0.0), solid(BOX, 0.0, -0.05, [0.06] * 3, 0.0)
    beside = solid(BOX, 0.065, -0.05, [0.06] * 3, 0.0)
    before, after = on_the_floor((long, False)), on_the_floor((beside, True), (short, True))
    assert matched_names(after, before, ["box_1"]) == ["solid_1", "box_1"]


def test_a_board_behind_a_block_and_what_shows_of_its_foot_are_one():
    """Of boards 9202 some 40 pixels of the foot were a box of its own, on which the rest leant."""
    block, (long, wide, thick), tilt = solid(BOX, 0.0, 0.0, [0.1, 0.08, 0.07], 0.0), (0.17, 0.1, 0.012), 0.9
    along, normal = np.array([0.0, -np.cos(tilt), np.sin(tilt)]), np.array([0.0, np.sin(tilt), np.cos(tilt)])
    foot, turn = np.array([0.06, 0.04 + 0.07 / np.tan(tilt), 0.0]), np.column_stack([along, [1.0, 0.0, 0.0], normal])
    whole = make_row(BOX, turn, foot + 0.5 * (long * along + thick * normal), np.array([long, wide, thick]))
    upper = make_row(BOX, turn, whole[10:13] + 0.04 * along, np.array([long - 0.08, wide, thick]))
    shown = on_the_floor((block, False)).add(whole, FREE, False)
    piece = solid(BOX, 0.08, foot[1], [0.06, 0.03, 0.03], 0.0)
    believed = on_the_floor((block, False), (piece, False)).add(upper, FREE, False, 0)
    best = weighed(np.random.default_rng(4), shown, believed)
    found = max(merges(np.random.default_rng(4), best, RULES), key=lambda each: each.odds)
    assert found.odds > 50.0 and found.places == ((1,), (2, 1))
    assert found.trial.state.rows[1, 13:16] == pytest.approx([long, wide, thick], abs=0.004)


def test_what_shows_nowhere_is_weighed_nowhere():
    """The floor has no end, and so many places out of sight that no image would outweigh them."""
    near, away = (solid(BOX, 0.0, 0.0, [0.06] * 3), True), (solid(BOX, 3.0, 0.0, [0.06] * 3), True)
    shown = on_the_floor(near)
    assert all_seen(weighed(np.random.default_rng(7), shown, shown))
    assert not all_seen(weighed(np.random.default_rng(7), shown, on_the_floor(near, away)))


def test_the_rim_of_a_disc_is_found_where_a_part_is_hidden():
    step = 0.004
    x, y = np.meshgrid(*[np.arange(-0.06, 0.06, step)] * 2)
    disc = np.column_stack([x.ravel(), y.ravel()])
    disc = disc[np.hypot(*disc.T) < 0.05]
    for hidden in (-1.0, 0.01, -0.01):
        left = disc[disc @ [0.8, 0.6] > hidden]
        ((centre, radius),) = rim_circle(left, step)
        assert np.linalg.norm(centre) < step and radius == pytest.approx(0.05, abs=step)
    # a broken twin: the spread of what is left
    assert np.sqrt(2 * left.var(axis=0).mean()) < 0.05 - 2 * step
    assert rim_circle(disc[:2], step) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_pieces_on_both_sides_of_what_hides_it_are_one_box(seed):
    """Of a box 67 pixels show, beside and above another: three small solids explained them, each of them well."""
    _, image, _, camera = drawn_scene(9016, "tabletop")
    state, _ = point_estimate(np.random.default_rng(seed), image, camera)
    assert len(state) == 3
    assert sorted(state.parents).count(FLOOR) == 2


def test_the_two_ends_of_what_another_hides_the_middle_of_are_one():
    """A can that lay behind a carton was a ball and a can, for sure."""
    bar, carton = (0.24, 0.06, 0.06), (0.08, 0.05, 0.16)
    seen = observe(seen_on_the_table([(BOX, 0.0, 0.03, bar, None), (BOX, 0.0, -0.05, carton, None)]), CAMERA)
    image, (_, y, _) = seen.image, (np.linalg.inv(seen.floor.pose) @ TABLE)[:3, 3]
    ends = solid(SPHERE, -0.09, y + 0.03, (0.07,) * 3, 0.0), solid(BOX, 0.08, y + 0.03, (0.08, 0.06, 0.06), 0.0)
    before = on_the_floor(*((row, False) for row in ends))
    state = before.add(solid(BOX, 0.0, y - 0.05, carton, 0.0), UPRIGHT, False, FLOOR, 0.0)
    assert parted_pairs(image, before) == []  # nothing hides what would join them
    assert parted_pairs(image, state) == [(0, 1), (1, 0)]
    climb = Climb(np.random.default_rng(0), Task(image, Settings()), state)
    assert any(map(climb.takes, merged(climb)))
    seen, settings = seen._replace(correlation=0.9), Settings().for_pixels(60.0)  # one end is small, and left over
    _, other, *_ = leftovers(np.random.default_rng(0), seen, state.without(0), settings)
    for found in (climb.state, other):
        whole, front = sorted(found.rows.tolist(), key=lambda row: row[15])
        assert whole[13:16] == pytest.approx(bar, abs=0.005)
        assert front[13:16] == pytest.approx(carton, abs=0.005)


def test_what_shows_beside_an_end_behind_another_is_the_other_end_of_it():
    """A box behind a carton showed in few pixels on its other side: told as long as its one end, and trusted."""
    bar, carton = (0.24, 0.06, 0.06), (0.14, 0.05, 0.16)
    seen = observe(seen_on_the_table([(BOX, 0.0, 0.03, bar, None), (BOX, -0.02, -0.05, carton, None)]), CAMERA)
    y = (np.linalg.inv(seen.floor.pose) @ TABLE)[1, 3]
    end, front = solid(BOX, -0.08, y + 0.03, (0.08, 0.06, 0.06), 0.0), solid(BOX, -0.02, y - 0.05, carton, 0.0)
    climb = Climb(np.random.default_rng(0), Task(seen.image, Settings()), on_the_floor((end, False), (front, False)))
    assert any(map(climb.takes, reached(climb)))
    whole, _ = sorted(climb.state.rows.tolist(), key=lambda row: row[15])
    assert whole[13:16] == pytest.approx(bar, abs=0.005)
    climb = Climb(np.random.default_rng(0), Task(seen.image, Settings()), on_the_floor((end, False)))
    assert list(reached(climb)) == []  # of what nothing hides in between
