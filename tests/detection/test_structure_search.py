"""From depth images to structures: each step on scenes whose answer is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from derender.camera.depth_file import read_depth
from derender.camera.intrinsics import Camera
from derender.detection.estimate import point_estimate
from derender.detection.floor import drawn, neighbour_correlation
from derender.detection.floors import find_floor
from derender.detection.pyramid import reduce
from derender.detection.search.greedy import Settings, Task, prune, rise, total_energy
from derender.detection.search.observation import observe, patches_of
from derender.detection.search.searches import (
    Climb,
    crossed,
    explain_by_two,
    explain_otherwise,
    explain_rest,
    lower_side,
    parts,
    support_all,
)
from derender.detection.solids.image import FAR, draw, make_image, make_row
from derender.detection.solids.interpenetration import gap_between, highest, lowest, penetration, penetration_beyond
from derender.detection.solids.misfit import added_misfit, misfit_map
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import FLOOR, Solid, State
from derender.errors import DerenderError
from derender.evaluation.convex import intersection_volume
from derender.scene.pose import random_rotation, rotation_x, rotation_z
from derender.scene.solids import BOX, CYLINDER, SPHERE
from derender.structures.case import settings_of
from derender.structures.infer import infer_structure
from derender.structures.options import Options
from worlds.made_scenes import drawn_scene, kinect_noise, make_scene, photograph, render_floor_scene

FRAMES = Path(__file__).resolve().parents[2] / "data" / "frames"


@pytest.fixture
def rng():
    return np.random.default_rng(11)


NAMES = {BOX: "box", SPHERE: "sphere", CYLINDER: "cylinder"}


def random_row(rng, kind, spread=0.08):
    size = rng.uniform(0.04, 0.12, 3)
    if kind != BOX:
        size[1] = size[0]
    if kind == SPHERE:
        size[2] = size[0]
    return make_row(kind, random_rotation(rng)[:3, :3], rng.uniform(-spread, spread, 3), size)


def solid_of(row):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = row[1:10].reshape(3, 3), row[10:13]
    return {"type": NAMES[int(row[0])], "pose": pose, "size": row[13:16]}


@pytest.mark.parametrize("kinds", [(BOX, BOX), (SPHERE, SPHERE), (BOX, SPHERE), (BOX, CYLINDER)])
def test_penetration_is_positive_exactly_where_solids_share_volume(rng, kinds):
    for _ in range(60):
        first, second = random_row(rng, kinds[0]), random_row(rng, kinds[1])
        depth, volume = penetration(first, second), intersection_volume(solid_of(first), solid_of(second))
        if depth <= 0:
            assert volume < 1e-9
        elif depth > 0.003:  # an edge against a rounded side may be taken for up to a millimetre of overlap
            assert volume > 0


def test_penetration_is_how_far_two_boxes_must_move_apart(rng):
    for _ in range(30):
        first = random_row(rng, BOX)
        second = first.copy()
        axis = int(rng.integers(3))
        overlap = rng.uniform(0.001, 0.03)
        second[10:13] += first[1:10].reshape(3, 3)[:, axis] * (first[13 + axis] - overlap)
        assert penetration(first, second) == pytest.approx(overlap, abs=1e-9)


@pytest.mark.parametrize("kinds", [(BOX, BOX), (CYLINDER, BOX), (SPHERE, CYLINDER)])
def test_upright_solids_and_depths_that_are_enough_are_told_by_fewer_axes(rng, kinds):
    """Two upright ones overlap as two that lean by a hair do, of which all axes are tried; and what is deeper than
    enough is as deep as it is.
    """
    hair, deep = rotation_x(1e-9)[:3, :3], 0
    for _ in range(100):
        first, second = (random_row(rng, kind) for kind in kinds)
        for row in (first, second):
            row[1:10] = rotation_z(rng.uniform(-np.pi, np.pi))[:3, :3].ravel()
        leaning = first.copy()
        leaning[1:10] = (hair @ first[1:10].reshape(3, 3)).ravel()
        depth = penetration(first, second)
        assert (depth > 0.0) == (penetration(leaning, second) > 0.0)
        if depth > 0.0:
            assert depth == pytest.approx(penetration(leaning, second), abs=1e-8)
            assert penetration_beyond(first, second, 0.5 * depth) == depth
            assert penetration_beyond(first, second, 1.5 * depth) <= 1.5 * depth
            deep += 1
    assert deep > 20


def test_a_gap_is_never_more_than_the_distance_and_across_faces_all_of_it(rng):
    """Also where another axis parts the solids first: what stands on nothing is told by how far it is from anything."""
    low = make_row(BOX, np.eye(3), [0.0, 0.0, 0.05], [0.08, 0.09, 0.1])
    high = make_row(BOX, rotation_z(0.7)[:3, :3], [-0.05, 0.02, 0.156], [0.07, 0.07, 0.07])
    assert gap_between(high, low) == pytest.approx(0.156 - 0.035 - 0.1, abs=1e-9)
    for _ in range(20):
        first, second = random_row(rng, BOX), random_row(rng, BOX)
        apart = gap_between(first, second)
        if apart > 0.0:
            points = [row[10:13] + (rng.uniform(-0.5, 0.5, (400, 3)) * row[13:16]) @ row[1:10].reshape(3, 3).T
                      for row in (first, second)]  # fmt: skip
            assert apart <= np.linalg.norm(points[0][:, None] - points[1], axis=-1).min() + 1e-9
        else:
            assert apart == pytest.approx(-penetration(first, second))


def test_lowest_and_highest_are_those_of_the_corners(rng):
    from derender.detection.search.moves import corners_of

    for _ in range(20):
        row = random_row(rng, BOX)
        heights = corners_of(row)[:, 2]
        assert lowest(row) == pytest.approx(heights.min(), abs=1e-12)
        assert highest(row) == pytest.approx(heights.max(), abs=1e-12)


def view_of(rng, rows):
    """Return an Image of solids over the floor at 64 x 48, noise 1 mm."""
    camera = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
    floor = np.array([[1, 0, 0, 0], [0, -0.6, -0.8, 0.15], [0, 0.8, -0.6, 0.6], [0, 0, 0, 1.0]])
    image = make_image(np.zeros((48, 64)), 1.0, camera, floor)
    depth, label = np.empty((48, 64)), np.empty((48, 64), np.int32)
    draw(image, rows, -1, depth, label)
    depth = np.where(depth < FAR, depth, np.nan)
    return make_image(depth + 0.001 * rng.normal(size=depth.shape), 0.001, camera, floor), depth, label, floor, camera


def test_drawing_agrees_with_the_ray_caster(rng):
    from derender.render.raycast.depth import render_depth
    from derender.scene.solids import PLANE, Solids

    rows = np.array([random_row(rng, kind) for kind in (BOX, SPHERE, CYLINDER)])
    _, depth, _, floor, camera = view_of(rng, rows)
    poses = np.array([floor] + [floor @ solid_of(row)["pose"] for row in rows])
    solids = Solids(np.array([PLANE, BOX, SPHERE, CYLINDER], np.int32), poses,
                    np.vstack([np.zeros(3), rows[:, 13:16]]), np.full(4, -1, np.int32))  # fmt: skip
    other, _ = render_depth(solids, camera)
    assert np.nanmax(np.abs(depth - other)) < 1e-9
    assert (np.isnan(depth) == np.isnan(other)).all()


def test_adding_a_solid_changes_the_misfit_as_drawing_it_does(rng):
    rows = np.array([random_row(rng, kind) for kind in (BOX, SPHERE, CYLINDER, BOX)])
    image = view_of(rng, rows)[0]
    for k in range(4):
        maps = []
        for shown in (np.delete(rows, k, axis=0), rows):
            depth, label, misfit = np.empty((48, 64)), np.empty((48, 64), np.int32), np.empty((48, 64))
            draw(image, shown, -1, depth, label)
            maps.append((misfit_map(image, depth, misfit), depth, misfit))
        (without, depth, misfit), (with_it, _, _) = maps
        # a depth in float32 is a ten-millionth off, and a misfit by as much times 2 r weight: .004 at 2 mm of noise
        assert added_misfit(image, rows[k], depth, misfit) == pytest.approx(with_it - without, abs=0.02)


@pytest.mark.parametrize("width", [9, 40])  # narrower than sixteen lanes, and no multiple of them
def test_a_solid_at_the_right_border_changes_the_misfit_as_drawing_it_does(rng, width):
    camera = Camera(60.0, 60.0, width - 4.0, 15.5, width, 32)  # its axis meets the last columns
    pose = np.eye(4)
    pose[:3, :3], pose[2, 3] = np.diag([1.0, -1.0, -1.0]), 1.0
    image = make_image(np.full((32, width), 0.91), 0.01, camera, pose)
    row = make_row(BOX, np.eye(3), [0.0, 0.0, 0.05], [0.3, 0.2, 0.1])
    before, after = (np.empty((32, width)) for _ in range(2))
    depth, label = np.empty((32, width)), np.empty((32, width), np.int32)
    draw(image, row[None], -1, depth, label)
    with_it = misfit_map(image, depth, after)
    draw(image, row[None], 0, depth, label)
    change = with_it - misfit_map(image, depth, before)
    assert change < -100.0
    assert added_misfit(image, row, depth, before) == pytest.approx(change, abs=0.02)


def test_floor_is_found_to_a_tenth_of_a_degree(rng):
    for name in ("settled", "noisy", "tower"):
        scene = make_scene(rng, name)
        floor = find_floor(scene["depth"], scene["camera"])
        assert floor.pose[:3, 2] @ scene["floor"][:3, 2] > np.cos(np.radians(0.1))
        offset = (scene["floor"][:3, 3] - floor.pose[:3, 3]) @ floor.pose[:3, 2]
        assert abs(offset) < 0.002
        assert np.linalg.det(floor.pose[:3, :3]) == pytest.approx(1)


def test_an_image_without_a_plane_or_without_pixels_is_a_fault(rng):
    camera = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
    with pytest.raises(DerenderError, match="plane"):
        find_floor(rng.uniform(0.5, 5.0, (48, 64)), camera)
    with pytest.raises(DerenderError, match="pixels"):
        find_floor(np.full((48, 64), np.nan), camera)
    with pytest.raises(DerenderError, match="on one line"):
        find_floor(np.full((1, 64), 0.9), replace(camera, height=1))


def test_reduced_images_show_the_same_points(rng):
    scene = make_scene(rng, "cubes")
    depth, camera, factor = reduce(scene["clean"], scene["camera"], 80)
    assert factor == 2 and depth.shape == (60, 80)
    # a plane's inverse depth is affine in the pixel: reduction keeps it
    floor = find_floor(depth, camera)
    assert floor.pose[:3, 2] @ scene["floor"][:3, 2] > np.cos(np.radians(0.1))


@pytest.mark.parametrize("share", [0.0, 0.5], ids=["independent", "shared"])
def test_how_much_neighbours_share_their_noise_is_told_from_straight_above_too(rng, share):
    """A camera that looks straight down sees one distance everywhere: its noise must not choose the near half."""
    camera = Camera(90.0, 90.0, 79.5, 59.5, 160, 120)
    white = rng.normal(0.0, 0.002, (120, 161))
    depth = 1.5 + (1 - share) * white[:, 1:] + share * white[:, :-1]
    expected = share * (1 - share) / (share**2 + (1 - share) ** 2)
    found = neighbour_correlation(depth, find_floor(depth, camera), camera)
    # of some 10,000 pairs: 0.01 is one standard error, and as much again for the plane that is fitted to them
    assert found == pytest.approx(expected, abs=0.05)


def test_a_rendering_is_told_from_what_a_sensor_saw(rng):
    """By its floor, which is where it should be; the best sensors here are off by .4 mm."""
    scene = make_scene(rng, "cubes")
    clean, camera = scene["clean"], scene["camera"]
    bent = 4e-4 * np.sin(np.arange(clean.shape[1]) / 9.0)
    for depth, expected in (
        (clean, True), (np.float32(clean).astype(float), True), (clean + 4e-4 * rng.normal(size=clean.shape), False),
        (clean + bent, False),
    ):  # fmt: skip
        assert drawn(depth, find_floor(depth, camera), camera) is expected


def test_single_outliers_are_no_background_that_a_blur_mixes_with_what_is_beside_them(rng):
    """Thin slabs over the floor explained the neighbours of each, and a box was told as five."""
    scene = make_scene(rng, "cubes")
    clean, camera = scene["clean"], scene["camera"]
    depth = clean + rng.normal(0.0, 0.002, clean.shape)
    floor = observe(depth, camera)
    one = (floor.image.weight > 0) & ~floor.mask & ~floor.behind & (rng.random(clean.shape) < 0.02)
    hole = np.zeros(clean.shape, bool)
    hole[-30:-20, 20:40] = True  # a part of a room behind the floor is that
    for away in (1.3, 0.7):
        seen = observe(np.where(one, away * depth, depth), camera)
        assert (np.abs(seen.image.floor - floor.image.floor)[one] < 0.01).mean() > 0.95
    seen = observe(np.where(hole, 1.3 * depth, depth), camera)
    assert np.allclose(seen.image.floor[hole], seen.image.depth[hole])


def upright(yaw, centre, size, kind=BOX):
    c, s = np.cos(yaw), np.sin(yaw)
    return make_row(kind, [[c, -s, 0], [s, c, 0], [0, 0, 1]], centre, size)


def test_a_box_seen_on_its_corner_has_three_orthogonal_patches(rng):
    poses = np.eye(4)[None].copy()
    poses[0, 2, 3] = 0.05
    for _ in range(20):
        scene = photograph(rng, ["box"], np.array([[0.1, 0.12, 0.1]]), poses, ["floor"], distance=(0.5, 0.6))
        towards = np.linalg.inv(scene["floor"])[:2, 3]
        if np.abs(towards).min() > 0.4 * np.abs(towards).max():
            break
    seen = observe(scene["depth"], scene["camera"])
    patches = patches_of(seen)
    large = patches.normal[patches.pixels > 60]
    assert len(large) == 3
    # plane fits of over 60 pixels with 1 mm noise are good to about half a degree
    assert np.abs(large @ large.T - np.eye(3)).max() < np.sin(np.radians(3))


def test_removing_a_solid_leaves_what_stood_on_it_on_what_it_stood_on():
    state = State()
    for k in range(3):
        state = state.add(upright(0, [0, 0, 0.05 + 0.1 * k], [0.1] * 3), UPRIGHT, True, FLOOR if k == 0 else k - 1)
    assert state.without(1).parents == [FLOOR, 0]
    assert state.without(0).parents == [FLOOR, 0]
    assert state.without(2).parents == [FLOOR, 0]


def test_three_stacked_cubes_are_found_with_their_graph(rng):
    scene = make_scene(rng, "cubes")
    graph = infer_structure(scene["depth"], scene["camera"], Options(method="map"), rng).best_graph()
    assert len(graph.names) == 4
    chain, name = [], "floor"
    while graph.children(name):
        (name,) = graph.children(name)
        chain.append(name)
    assert len(chain) == 3
    for name in chain:
        assert np.abs(graph.body(name).size() - 0.1).max() < 0.005
        assert graph.vertex(name).contact.type == "face-to-face"
    assert graph.degrees_of_freedom() == 6 + 3 * 3


@pytest.mark.slow
def test_the_same_seed_gives_the_same_answer():
    scene = make_scene(np.random.default_rng(5), "settled")
    first, _ = point_estimate(np.random.default_rng(1), scene["depth"], scene["camera"])
    second, _ = point_estimate(np.random.default_rng(1), scene["depth"], scene["camera"])
    assert np.array_equal(first.rows, second.rows)


@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
def test_round_solids_are_told_from_boxes(rng, kind):
    size = np.array([0.08, 0.08, 0.08 if kind == "sphere" else 0.12])
    poses = np.eye(4)[None].copy()
    poses[0, 2, 3] = size[2] / 2
    scene = photograph(rng, [kind], size[None], poses, ["floor"])
    graph = infer_structure(scene["depth"], scene["camera"], Options(method="map"), rng).best_graph()
    (name,) = graph.children("floor")
    assert graph.vertex(name).shape == kind
    assert np.abs(graph.body(name).size() - size).max() < 0.004


@pytest.mark.parametrize("shown", ["cubes", "can"])
def test_what_one_kind_of_solid_explains_badly_is_explained_by_the_other(rng, shown):
    """A can gives way to the two stacked cubes that are there, and a box to a can; not where no others are proposed."""
    can = [upright(0.0, [0, 0, 0.09], [0.1, 0.1, 0.18], CYLINDER)]
    cubes = [upright(0.4, [0, 0, 0.05], [0.1] * 3), upright(1.2, [0.01, 0, 0.14], [0.08] * 3)]
    box = [upright(0.4, [0, 0, 0.09], [0.09, 0.09, 0.18])]
    right, wrong = (cubes, can) if shown == "cubes" else (can, box)
    image = view_of(rng, np.array(right))[0]
    state = State().add(wrong[0], UPRIGHT, False, FLOOR, 0.0)
    rough = []
    for row in (*right, *wrong):
        row = row.copy()
        row[10:12] += 0.01
        row[13:16] *= 1.1
        rough.append(Solid(row, UPRIGHT, False))
    climb = Climb(rng, Task(image, Settings(), rough[len(right) :]), state)
    explain_otherwise(climb)
    assert climb.state is state
    climb.task = Task(image, Settings(), rough)
    explain_otherwise(climb)
    new = climb.state
    assert [int(row[0]) for row in new.rows] == [int(row[0]) for row in right]
    np.testing.assert_allclose(sorted(highest(row) for row in new.rows), [highest(row) for row in right], atol=0.006)
    assert [len(each) for each, _ in climb.pool] == [0, len(right)]


THREE = np.array([upright(0.4 * k, [0.2 * k - 0.2, 0, 0.05], [0.1, 0.1, 0.1]) for k in range(3)])


def standing(rows):
    """Return the State of upright solids on the floor."""
    state = State()
    for row in rows:
        state = state.add(row, UPRIGHT, False, FLOOR, 0.0)
    return state


@pytest.mark.parametrize(("lean", "thick"), [(0.0, 0.1), (12.0, 0.03)])
def test_one_slab_that_explains_two_things_badly_becomes_two(lean, thick):
    """A telephone that leans and the book beside it were one box in four searches of five; about one in twenty makes
    three of them."""
    turned, centre = rotation_x(np.deg2rad(lean))[:3, :3], np.array([-0.12, 0.0, 0.05])
    thing = make_row(BOX, turned, centre, np.array([0.2, 0.2, thick]))
    book = upright(0.0, [0.1, 0.0, 0.02], [0.22, 0.2, 0.04])
    slab = upright(0.0, [0.0, 0.0, 0.025], [0.44, 0.2, 0.05])
    right = 0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        climb = Climb(rng, Task(view_of(rng, np.array([thing, book]))[0], Settings()), standing([slab]))
        explain_by_two(climb)
        new = climb.state
        if len(new) == 2 and sorted(new.forms) == [UPRIGHT, FREE if lean else UPRIGHT]:
            right += 1
            np.testing.assert_allclose(sorted(new.rows[:, 10]), [-0.12, 0.1], atol=0.01)
            explain_by_two(climb)
            assert climb.state is new  # neither leaves as much as another costs
    assert right >= 2


def test_what_shows_two_planes_is_cut_where_they_meet(rng):
    across = rng.uniform(-1.0, 1.0, 200)
    points = np.column_stack([across, rng.uniform(-1.0, 1.0, 200), np.maximum(across - 0.3, 0.0)])
    low = lower_side(points, across)
    assert 0.2 < across[low].max() < across[~low].min() < 0.5
    assert lower_side(points[:6], across[:6]) is None


def test_each_body_of_pixels_that_nothing_explains_gets_a_proposal(rng):
    image = view_of(rng, THREE)[0]
    climb = Climb(rng, Task(image, Settings()), standing(THREE[:1]))
    explain_rest(climb)
    new = climb.state
    centres = sorted(new.rows[:, 10])
    np.testing.assert_allclose(centres, THREE[:, 10], atol=0.005)
    explain_rest(climb)
    assert climb.state is new  # where all is explained nothing is tried


@pytest.mark.parametrize(("gain", "goes_on"), [(0.1, False), (5.0, True)])
def test_what_floats_is_supported_as_long_as_that_is_worthwhile(rng, monkeypatch, gain, goes_on):
    """A polish gains a little each time: one search made 5,700 tries."""
    image = view_of(rng, THREE)[0]
    floating = standing(THREE[:1]).add(upright(0.0, [-0.2, 0, 0.25], [0.1] * 3), UPRIGHT, False)
    climb, tries = Climb(rng, Task(image, Settings()), floating), []

    def takes(proposed):
        tries.append(proposed)
        climb.energy -= gain
        return len(tries) < 50

    monkeypatch.setattr(climb, "takes", takes)
    support_all(climb)
    assert (len(tries) >= 50) == goes_on


def test_of_two_searches_each_part_is_taken_from_the_one_that_explains_it(rng):
    """One has the first solid wrong and the last one right, the other the other way round, and both the middle one."""
    image = view_of(rng, THREE)[0]
    worse = THREE.copy()
    worse[:, 1:10] = rotation_z(1.2)[:3, :3].ravel()
    worse[:, 13:15] *= [0.5, 1.6]
    one, two = (standing([left, THREE[1], right]) for left, right in
                ((worse[0], THREE[2]), (THREE[0], worse[2])))  # fmt: skip
    assert sorted(parts(image, one, two)) == [((0,), (0,)), ((1,), (1,)), ((2,), (2,))]
    new = crossed(rng, image, one, two, Settings())
    by_place = new.rows[np.argsort(new.rows[:, 10])]
    np.testing.assert_allclose(by_place[:, 13:16], THREE[:, 13:16], atol=0.005)
    assert total_energy(image, new, Settings()) < min(total_energy(image, each, Settings()) for each in (one, two))


@pytest.mark.parametrize("seed", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_two_stacks_seen_by_a_sensor_are_three_cubes_with_every_seed(seed):
    """Greedy searches take a can for one stack, and searches that went on from there ended there."""
    image = read_depth(FRAMES / "realsense_two_stacks.png", FRAMES / "realsense_camera.json")
    state, _ = point_estimate(np.random.default_rng(seed), image.depth, image.camera)
    assert state.cubes == [True] * 3
    assert state.parents.count(FLOOR) == 2


def test_an_empty_floor_has_no_solids(rng):
    scene = photograph(rng, ["box"], np.full((1, 3), 0.1), np.eye(4)[None], ["floor"])
    depth, _ = render_floor_scene([], np.empty((0, 4, 4)), np.empty((0, 3)), scene["floor"], scene["camera"])
    noisy = kinect_noise(rng, depth, np.full(depth.shape, -1))
    state, _ = point_estimate(rng, noisy, scene["camera"])
    assert len(state) == 0


@pytest.mark.parametrize("seed", [1103, 1141])
def test_blurred_silhouettes_are_not_filled_with_thin_solids(seed):
    """1103 has too few steps to tell its blur before it is explained; 1141 is seen before the horizon."""
    graph, image, _, camera = drawn_scene(seed, "tabletop")
    state, seen = point_estimate(np.random.default_rng(seed), image, camera)
    assert len(state) == len(graph.names) - 1
    assert seen.image.taps.size == 2  # the blur was half a pixel


def test_what_a_floor_is_uneven_by_is_no_solid(rng):
    """A slab of 6 mm and half a metre on a floor, as real tables are off their plane."""
    camera = Camera(140.0, 140.0, 79.5, 59.5, 160, 120)
    floor = np.array([[1, 0, 0, 0], [0, -0.6, -0.8, 0.15], [0, 0.8, -0.6, 0.9], [0, 0, 0, 1.0]])
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[0, :3, 3], poses[1, :3, 3] = [0.0, 0.25, 0.003], [0.0, -0.1, 0.05]
    sizes = np.array([[0.5, 0.3, 0.006], [0.1, 0.08, 0.1]])
    depth, _ = render_floor_scene(["box", "box"], floor @ poses, sizes, floor, camera)
    state, _ = point_estimate(rng, depth + 0.001 * rng.normal(size=depth.shape), camera)
    assert len(state) == 1 and state.rows[0, 13:16] == pytest.approx(sizes[1], abs=0.004)


def test_a_slab_is_no_higher_than_its_top_though_it_is_tilted():
    """It is sunk in the floor, whose bend it stands for, and one of its edges is over that."""
    turned = rotation_x(np.radians(2.0))[:3, :3]
    slab = make_row(BOX, turned, np.array([0.0, 0.0, -0.002]), np.array([0.2, 0.3, 0.014]))
    assert highest(slab) > Settings().uneven > rise(Solid(slab, UPRIGHT))
    assert rise(Solid(slab, FREE)) == highest(slab)
    image = make_image(np.full((9, 9), 1.0), np.full((9, 9), 0.002), Camera(9.0, 9.0, 4.0, 4.0, 9, 9), np.eye(4), 0.0)
    assert not len(prune(image, State().add(slab, UPRIGHT, False, FLOOR, 0.0), Settings(price=-np.inf)))


def test_a_quick_look_searches_once():
    """With one try there is no second search to agree with, and the scene is found nevertheless."""
    scene = make_scene(np.random.default_rng(4), "cubes")
    assert settings_of(Options(method="map", quick=True)).tries == 1 < settings_of(Options(method="map")).tries
    graph = infer_structure(
        scene["depth"], scene["camera"], Options(method="map", quick=True), np.random.default_rng(0)
    ).best_graph()
    assert len(graph.names) == len(scene["objects"]) + 1
