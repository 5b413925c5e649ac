"""Solids found by the whole body of their points: small ones far off, and round ones that slabs would explain."""

import numpy as np
import pytest

from derender.detection.estimate import point_estimate
from derender.detection.search.bodies import body_hypotheses, bridged, find_bodies, label_bodies
from derender.detection.search.greedy import Settings, Task, complexity, settle, sweep, total_energy
from derender.detection.search.moves import appear, explain_anew
from derender.detection.search.places import find_places
from derender.detection.solids.image import make_row
from derender.detection.solids.polish import UPRIGHT
from derender.detection.solids.state import FLOOR, State, held_out, run_polish
from derender.detection.solids.support import assign_supports, concerned
from derender.scene.solids import BOX, CYLINDER, SPHERE
from derender.structures.graph_posterior import parts_of
from derender.structures.infer import infer_structure
from worlds.made_scenes import photograph

SHAPES = Settings().shapes


def standing(kinds, sizes, places):
    """Return the poses (N, 4, 4), object to world, of solids that stand at places on the floor."""
    poses = np.tile(np.eye(4), (len(kinds), 1, 1))
    poses[:, :2, 3], poses[:, 2, 3] = places, 0.5 * np.array(sizes)[:, 2]
    return poses


SMALL = (["sphere", "sphere", "cylinder"], np.array([[0.034] * 3, [0.04] * 3, [0.034, 0.034, 0.05]]),
         [[-0.15, 0.0], [0.15, 0.05], [0.0, 0.0]])  # fmt: skip


def seen_from_afar(seed):
    """Return the scene of three solids, each some thirty pixels wide and high in all."""
    kinds, sizes, places = SMALL
    rng = np.random.default_rng(seed)
    return photograph(rng, kinds, sizes, standing(kinds, sizes, places), ["floor"] * 3, distance=(1.0, 1.0))


def test_bodies_end_at_jumps_in_depth():
    points = np.zeros((6, 8, 3))
    points[..., 0], points[..., 1] = 0.01 * np.arange(8), 0.01 * np.arange(6)[:, None]
    points[:, 4:, 2] = 0.2
    wanted = np.ones((6, 8), bool)
    wanted[0] = False
    found = find_bodies(points, wanted, np.full((6, 8), 0.01))
    assert [len(body) for body in found] == [20, 20]
    wanted[1:, 5:] = False
    wanted[2:, 4] = False  # one pixel is left: too few
    assert len(find_bodies(points, wanted, np.full((6, 8), 0.01))) == 1


SHOWN = {"ball": (SPHERE, [0.04] * 3), "can": (CYLINDER, [0.04, 0.04, 0.06]), "box": (BOX, [0.05, 0.04, 0.06])}


@pytest.mark.parametrize("kind, size", SHOWN.values(), ids=SHOWN)
def test_a_body_suggests_the_solid_that_shows_it(kind, size):
    rng = np.random.default_rng(0)
    half, origin = 0.5 * np.array(size), np.array([0.0, -1.0, 0.8])
    centre = np.array([0.1, 0.05, half[2]])
    points = rng.normal(size=(4000, 3))
    if kind == SPHERE:
        points *= (half[0] / np.linalg.norm(points, axis=1))[:, None]
        seen = points @ (origin - centre) > half[0] ** 2
    elif kind == CYLINDER:
        points[:, :2] *= (half[0] / np.linalg.norm(points[:, :2], axis=1))[:, None]
        points[:, 2] = rng.uniform(-half[2], half[2], len(points))
        seen = points[:, :2] @ (origin - centre)[:2] > half[0] ** 2
    else:
        points = rng.uniform(-half, half, (4000, 3))
        points[:2000, 1], points[2000:, 2] = -half[1], half[2]
        seen = np.ones(len(points), bool)
    suggested = [h.row for h in body_hypotheses(centre + points[seen], origin, SHAPES) if int(h.row[0]) == kind]
    least = min(suggested, key=lambda row: np.abs(row[10:13] - centre).max())
    assert np.abs(least[10:13] - centre).max() < 0.004
    assert np.abs(np.sort(least[13:16]) - np.sort(size)).max() < 0.006


@pytest.mark.parametrize("tilt", [15.0, 50.0])
def test_a_tilted_face_suggests_a_board_whose_foot_is_hidden(tilt):
    size, tilt, origin = np.array([0.06, 0.15, 0.01]), np.radians(tilt), np.array([0.0, -1.0, 0.8])
    turn = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(tilt), -np.sin(tilt)], [0.0, np.sin(tilt), np.cos(tilt)]])
    centre = np.array([0.1, 0.05, 0.5 * size[1:] @ turn[2, 1:]])  # its lowest edge is on the floor
    local = np.random.default_rng(0).uniform(-0.5, 0.5, (2000, 3)) * size
    local[:, 2] = 0.5 * size[2]
    shown = local[local[:, 1] > -0.02]  # nothing of its lower end
    suggested = [h.row for h in body_hypotheses(centre + shown @ turn.T, origin, SHAPES) if int(h.row[0]) == BOX]
    assert min(np.abs(np.sort(row[13:16]) - np.sort(size)).max() for row in suggested) < 0.012
    assert min(np.linalg.norm(row[10:13] - centre) for row in suggested) < 0.006


def test_a_level_underside_suggests_no_board_that_reaches_to_infinity():
    """Seen from below its normal points straight down, and no way along it is the steepest way up."""
    points = np.array([[x, 0.14, 1.0] for x in np.linspace(0.0, 0.06, 6)]) + [[0.0, y, 0.0] for y in (0.0, 0.002) * 3]
    rows = np.array([h.row for h in body_hypotheses(points, np.array([0.0, -0.8, 0.8]), SHAPES)])
    assert np.isfinite(rows).all()


@pytest.mark.parametrize("count", range(1, 6))
def test_so_few_points_that_they_lie_in_many_planes_suggest_solids_too(count):
    """What is left unexplained of an image may show in two pixels: the plane of half of them was asked for."""
    points = np.random.default_rng(count).uniform(0.0, 0.02, (count, 3))
    kinds = {int(h.row[0]) for h in body_hypotheses(points, np.array([0.0, -1.0, 0.8]), SHAPES)}
    assert kinds >= {BOX, CYLINDER}


@pytest.mark.parametrize("seed", range(3))
def test_small_round_solids_far_off_are_found(seed):
    """No patch of eight pixels on a plane shows there; what shape shows in so few the weighing tells."""
    scene = seen_from_afar(seed)
    graph = infer_structure(scene["depth"], scene["camera"], rng=np.random.default_rng(seed)).best_graph()
    solids = [vertex.body for vertex in graph.vertices if vertex.shape != "plane"]
    assert sorted(vertex.shape for vertex in graph.vertices) == ["cylinder", "plane", "sphere", "sphere"]
    assert np.sort([body.size()[0] for body in solids]) == pytest.approx([0.034, 0.034, 0.04], abs=0.003)


def test_what_nothing_explains_appears():
    scene = seen_from_afar(0)
    state, seen = point_estimate(np.random.default_rng(0), scene["depth"], scene["camera"])
    without = state.without(1)
    places = find_places(seen.image, without)
    assert len(places.bodies) == 1
    new, changed = appear(np.random.default_rng(0), Task(seen.image, Settings()), without, places)
    assert changed == {2}
    least, started = (total_energy(seen.image, each, Settings()) for each in (state, without))
    assert total_energy(seen.image, new, Settings()) - least < 0.2 * (started - least)


@pytest.mark.slow
def test_what_shows_in_few_pixels_may_have_another_shape():
    """The search may take a small ball or can for a box: the weights then say what it is."""
    scene = seen_from_afar(0)
    state, seen = point_estimate(np.random.default_rng(0), scene["depth"], scene["camera"])
    for k in (0, 2):
        wrong = state.copy()
        row = state.rows[k]
        wrong.rows[k] = make_row(BOX, np.eye(3), row[10:13], row[13:16])
        wrong.forms[k], wrong.cubes[k], wrong.bottoms[k] = UPRIGHT, False, 0.0
        wrong = assign_supports(seen.image, wrong, Settings(), {k})
        wrong = sweep(np.random.default_rng(k), seen.image, wrong, Settings(), 200, only={k})  # and not pruned
        parts = parts_of(np.random.default_rng(k), seen, wrong, [], Settings(), 1, 4)
        likeliest = max(parts, key=lambda part: part.weight)
        assert likeliest.weight > 0.9
        assert sorted(v.shape for v in likeliest.graph.vertices) == ["cylinder", "plane", "sphere", "sphere"]
        boxes = parts_of(np.random.default_rng(k), seen, wrong, [], Settings(shapes=("box", "cube")), 1, 4)
        shapes = {v.shape for part in boxes for v in part.graph.vertices if v.name.startswith(("box", "cube"))}
        assert shapes <= {"box", "cube"}


def test_slabs_that_explain_a_can_become_one():
    """Nothing is badly explained there: what shows beside each other is taken out together."""
    size = np.array([0.07, 0.07, 0.09])
    scene = photograph(np.random.default_rng(1), ["cylinder"], size[None], standing(["cylinder"], [size], [[0, 0]]),
                       ["floor"])  # fmt: skip
    state, seen = point_estimate(np.random.default_rng(1), scene["depth"], scene["camera"])
    world = np.linalg.inv(seen.floor.pose) @ scene["floor"]
    slabs = State()
    towards = seen.image.origin - world[:3, 3]
    yaw = np.arctan2(towards[1], towards[0])
    turned = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    for across in (-0.022, 0.0, 0.022):
        deep = 2 * np.sqrt(0.035**2 - across**2)
        centre = world[:3, 3] + turned @ [0.0, across, 0.0] + [0.0, 0.0, 0.045]
        slabs = slabs.add(make_row(BOX, turned, centre, [deep, 0.022, 0.09]), UPRIGHT, False, FLOOR, 0.0)
    least, reached = total_energy(seen.image, state, Settings()), []
    places = find_places(seen.image, slabs)
    places.pairs[:] = 0.0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        new, changed = explain_anew(rng, Task(seen.image, Settings()), slabs, places)
        reached.append(total_energy(seen.image, settle(rng, seen.image, new, Settings(), 150, changed), Settings()))
    assert [int(row[0]) for row in state.rows] == [CYLINDER]
    assert min(reached) < least + 5.0


def test_a_new_solid_costs_what_it_adds_to_the_energy():
    """However many stand on the floor already: they do not stand on the new one."""
    scene = seen_from_afar(0)
    state, seen = point_estimate(np.random.default_rng(0), scene["depth"], scene["camera"])
    settings, without = Settings(), state.without(0)
    view, solid = held_out(seen.image, without, -1), state[0]._replace(cube=False, parent=FLOOR, bottom=0.0)
    assert len(without) == 2 and without.bottoms == [0.0, 0.0]
    _, energy = run_polish(np.random.default_rng(0), seen.image, without, -1, solid, view, settings, 0)
    energy += complexity(solid, settings)
    whole = without.add(*solid)
    added = total_energy(seen.image, whole, settings) - total_energy(seen.image, without, settings)
    assert energy == pytest.approx(added, rel=1e-5), "tries are scored in float32, 6e-8 of each pixel's misfit off"


def test_solids_that_a_change_does_not_concern_keep_their_supports():
    """Held to those that are concerned, supports are assigned as they would be for all."""
    kinds, count = ["box"] * 5, 5
    sizes = np.random.default_rng(2).uniform(0.05, 0.09, (count, 3))
    poses = standing(kinds, sizes, [[-0.2, 0.1], [-0.05, -0.1], [0.1, 0.1], [0.22, -0.05], [0.0, 0.2]])
    scene = photograph(np.random.default_rng(2), kinds, sizes, poses, ["floor"] * count)
    state, seen = point_estimate(np.random.default_rng(2), scene["depth"], scene["camera"])
    settings = Settings()
    state = assign_supports(seen.image, state, settings)
    assert len(state) == count
    for k in range(count):
        changed = state.copy()
        changed.rows[k, 12:13] += 0.03
        changed.cubes[k] = False
        near = concerned(seen.image, changed, {k})
        assert k in near and len(near) < count
        held, free = (assign_supports(seen.image, changed, settings, only) for only in (near, None))
        assert held.parents == free.parents and held.bottoms == free.bottoms
        assert held.rows == pytest.approx(free.rows, abs=1e-12)


def test_a_surface_goes_on_over_a_hole_but_not_over_the_shadow_beside_a_silhouette():
    footprint, missing = np.full((12, 40), 0.002), np.zeros((12, 40), bool)
    missing[:, 18:24] = True
    column = np.arange(40.0)
    for step, slope, longest, bodies in (
        (0.0, 0.0, 0.03, 1),
        (0.0, 1.5, 0.03, 1),
        (0.0, 0.0, 0.01, 2),
        (0.1, 0.0, 0.03, 2),
    ):
        points = np.zeros((12, 40, 3))
        points[..., :2] = 0.002 * np.stack(np.meshgrid(column, np.arange(12.0)), axis=-1)
        points[..., 2] = slope * points[..., 0] + step * (column > 20)
        points[missing] = 0.0
        _, count = label_bodies(*bridged(points, ~missing, np.full((12, 40), 0.012), footprint, missing, longest))
        assert count == bodies
    points[..., 2] = 0.0
    floor = ~missing & (column != 17)  # the hole is no hole in the thing: beside it the floor is seen
    assert not bridged(points, floor, np.full((12, 40), 0.012), footprint, missing, 0.03)[1][missing].any()
