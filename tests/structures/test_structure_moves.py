"""The moves of the search over structures, and what they are for."""

import numpy as np
import pytest

from derender.detection.estimate import point_estimate
from derender.detection.search.greedy import Settings, Task, settle, total_energy
from derender.detection.search.moves import MOVES, as_cube, as_high, lift, recut, shake, stand, stretch, tilt
from derender.detection.search.places import find_places
from derender.detection.solids.graph import pose_of, scene_graph
from derender.detection.solids.image import make_row
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import FLOOR, Solid, State
from derender.scene.graph import ROOT
from derender.scene.pose import rotation_x, rotation_z
from derender.scene.solids import BOX
from worlds.made_scenes import SETS, make_scene, photograph


def scene_of(name, seed):
    return make_scene(np.random.default_rng([seed, SETS.index(name)]), name)


@pytest.fixture(scope="module")
def explained():
    """Return (image, state) of a tower with its graph, as the search leaves it."""
    scene = scene_of("cubes", 3)
    state, seen = point_estimate(np.random.default_rng(3), scene["depth"], scene["camera"])
    assert len(state) == 3
    return seen.image, state


def with_other(state, index, **numbers):
    """Return the state with some of the numbers of a row changed: {column: value added}."""
    new = state.copy()
    new.cubes[index] = False
    for column, value in numbers.items():
        new.rows[index, int(column[1:])] += value
    return new


@pytest.mark.parametrize("move", [move for move, _ in MOVES], ids=lambda move: move.__name__)
def test_moves_leave_what_they_are_given_as_it_was(explained, move):
    image, state = explained
    state = with_other(state, 0, c13=-0.04, c10=0.02)
    kept, places = state.copy(), find_places(image, state)
    applied = 0
    for seed in range(12):
        result = move(np.random.default_rng(seed), Task(image, Settings()), state, places)
        assert np.array_equal(state.rows, kept.rows) and state.parents == kept.parents and state.cubes == kept.cubes
        if result is not None:
            new, changed = result
            sizes = {len(each) for each in (new.rows, new.forms, new.cubes, new.parents, new.bottoms)}
            assert sizes == {len(new)} and all(0 <= k < len(new) for k in changed)
            assert np.isfinite(new.rows).all() and (new.rows[:, 13:16] > 0).all()
            applied += 1
    # nothing floats in this state: these have nothing to do
    assert applied > 0 or move.__name__ in ("put_under", "raise_support", "stand", "recut")


def best_of(move, image, state, tries=20):
    """Return the least energy that a move reaches from a state, and the energy of the state."""
    places = find_places(image, state)
    results = [move(np.random.default_rng(k), Task(image, Settings()), state, places) for k in range(tries)]
    energies = [total_energy(image, result[0], Settings()) for result in results if result is not None]
    return min(energies), total_energy(image, state, Settings())


def test_a_box_that_is_too_short_is_stretched(explained):
    image, state = explained
    top = int(np.argmax(state.rows[:, 12]))
    reached, started = best_of(stretch, image, with_other(state, top, c13=-0.04, c10=0.02))
    least = total_energy(image, state, Settings())
    assert reached - least < 0.1 * (started - least)


def test_a_box_turned_wrongly_is_shaken_right(explained):
    image, state = explained
    top = int(np.argmax(state.rows[:, 12]))
    wrong = state.copy()
    c, s = np.cos(0.6), np.sin(0.6)
    turned = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ wrong.rows[top, 1:10].reshape(3, 3)
    wrong.rows[top, 1:10] = turned.ravel()
    places, reached = find_places(image, wrong), []
    for seed in range(20):  # and settled, as the search does with what a move leaves
        new, changed = shake(np.random.default_rng(seed), Task(image, Settings()), wrong, places)
        new = settle(np.random.default_rng(seed), image, new, Settings(), 150, changed)
        reached.append(total_energy(image, new, Settings()))
    least, started = total_energy(image, state, Settings()), total_energy(image, wrong, Settings())
    assert min(reached) - least < 0.1 * (started - least)


def upright(x, y, size):
    """Return the pose (4, 4) of a box that stands on the floor of a world with z up."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, 0.5 * size[2]
    return pose


# (size, x, y) of both pieces, and of those of another cut of their union
CUTS = {
    "an L": (((0.12, 0.06, 0.07), 0.0, 0.0), ((0.06, 0.09, 0.07), -0.03, 0.075),
             ((0.06, 0.15, 0.07), -0.03, 0.045), ((0.06, 0.06, 0.07), 0.03, 0.0)),
    "a row": (((0.07, 0.06, 0.07), 0.0, 0.0), ((0.07, 0.06, 0.07), 0.07, 0.0),
              ((0.03, 0.06, 0.07), -0.02, 0.0), ((0.11, 0.06, 0.07), 0.05, 0.0)),
}  # fmt: skip


@pytest.mark.parametrize("union", CUTS)
def test_two_boxes_that_touch_are_cut_apart_in_another_way(union):
    *true, first, second = CUTS[union]
    sizes = np.array([size for size, _, _ in true])
    poses = np.array([upright(x, y, size) for size, x, y in true])
    scene = photograph(np.random.default_rng(4), ["box", "box"], sizes, poses, ["floor", "floor"])
    _, seen = point_estimate(np.random.default_rng(4), scene["depth"], scene["camera"])
    world = np.linalg.inv(seen.floor.pose) @ scene["floor"]
    wrong = State()
    for size, x, y in (first, second):
        pose = world @ upright(x, y, size)
        wrong = wrong.add(make_row(BOX, pose[:3, :3], pose[:3, 3], size), UPRIGHT, False, FLOOR, 0.0)
    places, found = find_places(seen.image, wrong), []
    for seed in range(30):
        new, _ = recut(np.random.default_rng(seed), Task(seen.image, Settings()), wrong, places) or (wrong, None)
        found.append(np.abs(np.sort(new.rows[:, 13:15].ravel()) - np.sort(sizes[:, :2].ravel())).max())
    start = np.abs(np.sort(wrong.rows[:, 13:15].ravel()) - np.sort(sizes[:, :2].ravel())).max()
    assert start > 0.025 and min(found) < 0.012


def test_a_tilted_solid_is_put_upright_and_the_reverse(explained):
    image, state = explained
    top = int(np.argmax(state.rows[:, 12]))
    free = state.copy()
    free.forms = [FREE] * 3
    places = find_places(image, free)
    for given, form in ((free, UPRIGHT), (state, FREE)):
        new, changed = tilt(np.random.default_rng(0), Task(image, Settings()), given, places)
        (index,) = changed
        assert new.forms[index] == form
    del top


@pytest.mark.slow
def test_a_box_drawn_down_to_the_floor_is_lifted_off_it():
    """Scene 22 of the towers: two pixels show what carries the lowest box that can be seen."""
    scene = scene_of("tower", 22)
    state, seen = point_estimate(np.random.default_rng(22), scene["depth"], scene["camera"])
    sizes = sorted(tuple(np.round(np.sort(row[13:16]), 2)) for row in state.rows)
    truth = sorted(tuple(np.round(np.sort(item["size"]), 2)) for item in scene["objects"][1:])
    assert sizes == truth
    graph = scene_graph(state, seen.floor.pose)
    assert [v.contact.type for v in graph.vertices if v.parent == ROOT] == ["6dof", "6dof"]  # the floor, and that box


def test_lifting_puts_something_into_the_gap(explained):
    image, state = explained
    bottom = int(np.argmin(state.rows[:, 12]))
    # a cube drawn down by as much as it is high, through what is the floor now
    lowered = state.without(bottom)
    lowest_left = int(np.argmin(lowered.rows[:, 12]))
    lowered.rows[lowest_left, 12] -= 0.05
    lowered.rows[lowest_left, 15] += 0.1
    lowered.cubes[lowest_left] = False
    lowered.bottoms[lowest_left] = 0.0
    reached, started = best_of(lift, image, lowered)
    assert reached < started - 100


def test_a_cube_that_leans_a_little_is_one_cube_on_what_bears_it():
    """Scene 29 of the settled: 5 degrees off the vertical, on a corner of one box and an edge of another."""
    scene = scene_of("settled", 29)
    state, _ = point_estimate(np.random.default_rng(29), scene["depth"], scene["camera"])
    assert len(state) == len(scene["objects"])
    (leaning,) = [k for k in range(len(state)) if state.forms[k] == FREE]
    (true,) = [item for item in scene["objects"] if item["parent"] != "floor"]
    assert state.rows[leaning, 13:16] == pytest.approx(true["size"], abs=0.003)
    support = state.rows[state.parents[leaning], 13:16]
    assert np.sort(support) == pytest.approx(np.sort(scene["objects"][true["parent"]]["size"]), abs=0.003)


def test_a_face_against_an_edge_is_where_it_was_seen():
    """No contact says so: the slack of another does, to the last digit; the pose is not that contact's ideal one."""
    carrier = make_row(BOX, np.eye(3), np.array([0.0, 0.0, 0.05]), np.full(3, 0.1))
    rotation = rotation_z(0.1)[:3, :3] @ rotation_x(np.radians(40.0))[:3, :3]
    leaning = make_row(BOX, rotation, np.array([0.0, 0.0, 0.0]), np.array([0.12, 0.08, 0.08]))
    edge = np.array([0.0, -0.05, 0.1])
    leaning[10:13] = edge + rotation @ np.array([0.0, 0.01, 0.04])  # its lower face meets the front edge of the top
    state = State().add(carrier, UPRIGHT, True, FLOOR, 0.0).add(leaning, FREE, False, 0, np.nan)
    graph = scene_graph(state, np.eye(4))
    child = graph.vertex("box_1")
    assert child.parent == "cube_1"
    np.testing.assert_allclose(graph.poses()["box_1"], pose_of(leaning), atol=1e-9)
    ideal = graph.with_numbers({f"box_1.contact.{name}": 0.0 for name in child.contact.values if "tilt" in name})
    assert np.abs(ideal.poses()["box_1"] - pose_of(leaning)).max() > 0.1  # a broken twin


def test_a_piece_that_floats_is_made_to_stand(explained):
    image, state = explained
    lowest_one = int(np.argmin(state.rows[:, 12]))
    piece = state.copy()
    piece.rows[lowest_one, 12] += 0.03  # its upper part alone, over nothing
    piece.rows[lowest_one, 15] -= 0.06
    piece.bottoms[lowest_one], piece.cubes[lowest_one] = np.nan, False
    reached, started = best_of(stand, image, piece)
    assert reached - total_energy(image, state, Settings()) < 0.2 * (started - total_energy(image, state, Settings()))


def test_over_a_gap_a_solid_floats():
    for gap, parent in ((0.003, "floor"), (0.05, ROOT)):
        state = State().add(make_row(BOX, np.eye(3), [0, 0, 0.05 + gap], np.full(3, 0.1)), UPRIGHT, True, FLOOR)
        assert scene_graph(state, np.eye(4)).vertex("cube_1").parent == parent


def test_what_is_nearly_a_cube_is_tried_as_one():
    origin = np.array([0.0, -0.6, 0.5])
    nearly = make_row(BOX, rotation_z(0.3)[:3, :3], [0.0, 0.0, 0.035], [0.068, 0.072, 0.07])
    cube = as_cube(Solid(nearly, UPRIGHT, False), origin)
    assert cube.cube and cube.row[13:16] == pytest.approx([0.07] * 3)
    assert cube.row[12] == pytest.approx(0.035) and nearly[13] == 0.068  # on the floor still; the other is as it was
    long = Solid(make_row(BOX, np.eye(3), [0.0, 0.0, 0.035], [0.068, 0.09, 0.07]), UPRIGHT, False)
    assert as_cube(long, origin) is long


def test_pieces_that_something_hides_the_middle_of_are_as_high():
    state = State()
    for x, height in ((0.0, 0.05), (0.2, 0.052), (0.1, 0.09), (0.9, 0.05)):
        row = make_row(BOX, np.eye(3), [x, 0.0, height / 2], [0.06, 0.06, height])
        state = state.add(row, UPRIGHT, False, FLOOR, 0.0)
    assert as_high(state, 0) == {1} and as_high(state, 2) == set()


def test_only_bodies_of_pixels_are_to_blame_on_nothing(explained):
    """What is further than the floor, or alone, no solid could explain."""
    image, state = explained
    depth = image.depth.copy()
    depth[100:104, 4:7] += 0.05
    assert find_places(image._replace(depth=depth), state).blame[-1] == 0.0
    depth[100:104, 4:7] -= 0.1
    assert find_places(image._replace(depth=depth), state).blame[-1] > 5.0
