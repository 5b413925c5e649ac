"""A box that may be a grid of equal cartons: what its seams show, and what it is where they show nothing."""

from itertools import combinations, product

import numpy as np
import pytest
from scipy.stats import lognorm

from derender.camera.intrinsics import Camera
from derender.detection.solids.beliefs import bare_image, box_log_density
from derender.detection.solids.graph import pose_of, scene_graph
from derender.detection.solids.image import make_row
from derender.detection.solids.polish import UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.results.posterior import StructurePosterior
from derender.scene.pose import rotation_x, rotation_z
from derender.scene.solids import BOX
from derender.structures.grids import (
    GAPS,
    Grid,
    Image,
    Shown,
    blocks_of,
    bodies_of,
    divide,
    gaps_drawn,
    grids_of,
    hull_of,
    odds_before,
    prior_odds,
    seam_gain,
    with_grids,
)
from worlds.made_scenes import render_floor_scene

CAMERA = Camera(fx=290.0, fy=290.0, cx=159.5, cy=119.5, width=320, height=240)
SIZE, SIGMA, GAP = np.array([0.36, 0.25, 0.22]), 0.004, 0.004
EVEN = np.full(3, GAP), lambda rng, count: np.full((count, 3), GAP)  # of a Grid whose gaps are known


def pallet(gap=GAP, counts=(2, 3, 2), turn=0.05, slabs=1, board=0.0):
    """Return (part with one box, or so many slabs, Image) of cartons that stand so close on a floor, or a board so many
    metres high."""
    floor = rotation_x(np.pi / 2 + np.radians(40))
    floor[:3, 3] = [0.0, 0.1, 2.2]
    counts = np.array(counts)
    way, whole = rotation_z(turn)[:3, :3], counts * SIZE + (counts - 1) * [gap, gap, 0.0]
    cells = [(np.array(cell) - 0.5 * (counts - 1)) * (SIZE + [gap, gap, 0.0]) for cell in np.ndindex(*counts)]
    poses = []
    for cell in cells:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = way, way @ cell + [0.0, 0.0, board + 0.5 * whole[2]]
        poses.append(floor @ pose)
    camera = Camera(290.0, 290.0, 159.5, 119.5, 320, 240)
    sizes, below = [SIZE] * len(cells), [*(whole[:2] + 0.1), board]
    if board:
        pose = np.eye(4)
        pose[:3, :3], pose[2, 3] = way, 0.5 * board
        poses, sizes = [*poses, floor @ pose], [*sizes, np.array(below)]
    depth, _ = render_floor_scene(["box"] * len(sizes), np.array(poses), sizes, floor, camera)
    depth = depth + SIGMA * np.random.default_rng(1).standard_normal(depth.shape)
    block = make_row(BOX, way, [0.0, 0.0, board + 0.5 * whole[2]], whole)
    slab = (whole - [(slabs - 1) * gap, 0.0, 0.0]) / [slabs, 1.0, 1.0]
    middles = [way @ [(k - 0.5 * (slabs - 1)) * (slab[0] + gap), 0.0, board + 0.5 * whole[2]] for k in range(slabs)]
    rows = np.array([make_row(BOX, way, middle, slab) for middle in middles])
    parents, bottoms = [FLOOR] * slabs, [board] * slabs
    if board:
        rows = np.array([*rows, make_row(BOX, way, [0.0, 0.0, 0.5 * board], below)])
        parents, bottoms = [slabs] * slabs + [FLOOR], [*bottoms, 0.0]
    graph = scene_graph(State(rows, [UPRIGHT] * len(rows), [False] * len(rows), parents, bottoms), floor)
    addresses = ("box_1.length", "box_1.contact.x")
    start = [graph.numbers()[address] for address in addresses]
    values = np.array(start) + 1e-4 * np.random.default_rng(2).standard_normal((2, 30, 2))
    values[0, 0] = start
    density = np.zeros((2, 30))
    density[0, 0] = 1.0
    part = StructurePosterior(graph, addresses, values, np.zeros((2, 30)), density)
    return part, Image(depth, CAMERA, np.full(depth.shape, SIGMA), 1.0, 1.0), pose_of(block), whole


def counts_of(graph):
    boxes = [vertex for vertex in graph.vertices if vertex.shape == "box"]
    layers = sum(vertex.parent == "floor" for vertex in boxes)
    return len(boxes) // layers, layers


def test_seams_that_show_tell_the_grid_and_layers_that_do_not_stay_open():
    part, image, block, whole = pallet()
    found = with_grids(np.random.default_rng(0), [part], image, bare_image())
    assert sum(each.weight for each in found) == pytest.approx(1.0)
    assert found == sorted(found, key=lambda each: -each.weight) and found[0].weight < 0.95
    right = [each for each in found if counts_of(each.graph) == (2, 6)]
    assert right, "two layers of six are among them"
    graph, _ = right[0].best()
    down = np.linalg.inv(graph.root_pose)
    corners = []
    for vertex in graph.vertices:
        if vertex.shape == "box":
            assert np.array(graph.body(vertex.name).size()) == pytest.approx(SIZE, abs=0.003)
            ends = np.array([[a, b, c] for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (-0.5, 0.5)])
            pose = down @ graph.poses()[vertex.name]
            corners.append(ends * np.array(graph.body(vertex.name).size()) @ pose[:3, :3].T + pose[:3, 3])
    local = (np.concatenate(corners) - block[:3, 3]) @ block[:3, :3]
    assert np.ptp(local, axis=0) == pytest.approx(whole, abs=1e-4)
    for each in found:
        assert each.values.shape[2] == len(each.addresses) == len(each.periods)
        assert each.graph_at(0, 0).names == each.graph.names


def test_cartons_are_as_open_as_the_gaps_between_them_and_drawn_as_often_as_their_box():
    """Of twenty draws chains that agreed seemed not to, and all had one gap: .2 of the sizes' intervals held them."""
    part, image, *_ = pallet()
    found = with_grids(np.random.default_rng(0), [part], image, bare_image())
    whole = [each for each in found if each.values.shape[:2] == part.values.shape[:2]]
    assert whole == found[:1]  # of the others the best draw alone is told
    sizes = whole[0].values[..., [k for k, name in enumerate(whole[0].addresses) if name.endswith("_1.length")][0]]
    assert 8e-5 < sizes.std() < 5e-4 and sizes.min() < SIZE[0] < sizes.max()  # their box alone leaves 5e-5
    gains = [np.log([0.5, *[1e-9] * 7, 0.5]), np.zeros(1), np.log([1e-9, 1.0, *[1e-9] * 7])]
    gaps = gaps_drawn(np.random.default_rng(0), 4000, gains, 0.008)
    assert gaps[:, 0].mean() == pytest.approx(0.5 * (0.00025 + 0.008), abs=1e-4) and not gaps[:, 1].any()
    assert gaps[:, 2].mean() == pytest.approx(0.001, abs=5e-5) and np.ptp(gaps[:, 2]) == pytest.approx(0.001, rel=0.02)


def test_a_carton_is_as_probable_as_its_grid():
    """One at the same place among others, of another size, had its name: all were told at P 1.00, most wrong."""
    part, image, *_ = pallet(gap=0.0)
    found = with_grids(np.random.default_rng(0), [part], image, bare_image())
    names = [set(each.graph.names) - {"floor"} for each in found]
    assert len(found) > 1 and not any(one & other for one, other in combinations(names, 2))


def test_what_stands_on_a_pallet_may_be_a_grid_as_what_stands_on_the_floor():
    """Eleven cartons on a pallet were three boxes at P .95, and trusted."""
    part, image, block, _ = pallet(board=0.14)
    found = with_grids(np.random.default_rng(0), [part], image, bare_image())
    right = [each for each in found if each.graph.children("box_1") and len(each.graph.children("box_1")) == 6]
    assert right and max(each.weight for each in found) < 0.95
    graph, _ = right[0].best()
    low = [graph.poses()[name] for name in graph.children("box_1")]
    middles = [(np.linalg.inv(graph.root_pose @ block) @ pose)[2, 3] for pose in low]
    assert middles == pytest.approx([-0.5 * SIZE[2]] * 6, abs=1e-3)  # the lower of two layers about the block's middle


def test_without_gaps_nothing_is_sure_and_seams_are_evidence_for_their_own_number_alone():
    part, image, *_ = pallet(gap=0.0)
    assert max(each.weight for each in with_grids(np.random.default_rng(0), [part], image, bare_image())) < 0.6
    rng, count = np.random.default_rng(3), 4000
    place = np.column_stack([rng.uniform(0.0, 0.9, count), rng.uniform(0.0, 0.6, count), np.full(count, 0.4)])
    step, slope = np.full((count, 3), 0.006), np.full((count, 3), 0.02)
    deeper = SIGMA * rng.standard_normal(count)
    none = Shown(place, step, slope, np.full(count, 2), deeper, np.full(count, SIGMA))
    assert (np.diff(seam_gain(none, 0, 0.9, 3, 0.006)) < 0.0).all()
    seam = (np.abs(place[:, 0] % 0.3 - 0.15) > 0.15 - 0.002) & (np.abs(place[:, 0] - 0.45) < 0.3)
    gains = [seam_gain(none._replace(deeper=deeper + 0.05 * seam), 0, 0.9, n, 0.006).max() for n in (2, 3, 4, 5)]
    assert np.argmax(gains) == 1 and gains[1] > 50.0 > 10.0 > max(gains[0], gains[2], gains[3])
    ends = np.minimum(place[:, 0], 0.9 - place[:, 0]) < 0.002  # the box ends there, which is no seam
    assert seam_gain(none._replace(deeper=deeper + 0.05 * ends), 0, 0.9, 3, 0.006).max() < 1.0
    assert len(GAPS) == len(seam_gain(none, 0, 0.9, 3, 0.006))


@pytest.mark.filterwarnings("error")
def test_of_a_box_that_nothing_shows_no_seam_tells():
    unseen = Shown(*np.zeros((2, 0, 3)), np.zeros((0, 3)), np.zeros(0, int), np.zeros(0), np.zeros(0))
    assert not seam_gain(unseen, 0, 0.9, 3, 0.006).any()


def test_layers_rest_on_each_other_and_what_shows_between_two_is_a_groove_of_their_edges(monkeypatch):
    """Nine gaps, of which the widest is told e times as well by the image as none: in one of ten it is asked."""
    shows = {0: np.zeros(9), 1: np.zeros(9), 2: np.append(np.zeros(8), 1.0)}
    monkeypatch.setattr("derender.structures.grids.seam_gain", lambda seen, axis, *_: shows[axis])
    part, image, *_ = pallet()
    beliefs = bare_image()
    graph = part.best()[0]
    found = {grid.parts: grid for grid in grids_of(graph, ("box_1",), image, beliefs)}
    before = odds_before(graph, ("box_1",), beliefs.loose.cartons, beliefs, image.unit)
    for parts, grid in found.items():
        gain = np.log(0.9 + 0.1 * (8.0 + np.e) / 9.0) if parts[2] > 1 else 0.0
        assert grid.odds - before[parts] == pytest.approx(gain) and grid.gap[2] == 0.0


def test_slabs_that_are_flush_are_parts_of_one_grid():
    """Layers that no seam tells are as many in one slab as in the other, and both are made of the same cartons."""
    part, image, block, whole = pallet(slabs=2)
    found = with_grids(np.random.default_rng(0), [part], image, bare_image())
    assert sum(each.weight for each in found) == pytest.approx(1.0) and found[0].weight < 0.95
    assert sum(each.weight for each in found if counts_of(each.graph)[1] == 6) > 0.9
    for each in found:
        graph, _ = each.best()
        sizes = np.array([graph.body(vertex.name).size() for vertex in graph.vertices if vertex.shape == "box"])
        assert len(sizes) >= 4 and np.ptp(sizes, axis=0) == pytest.approx(0.0, abs=1e-4)
        assert each.values.shape[2] == len(each.addresses) == len(each.periods)


@pytest.mark.parametrize("step, together", [((0.352, 0.0, 0.0), True), ((0.38, 0.0, 0.0), False),
                                            ((0.352, 0.03, 0.0), False), ((0.0, 0.254, 0.0), True)])  # fmt: skip
def test_boxes_are_asked_together_where_they_are_flush(step, together):
    rows = np.array([make_row(BOX, np.eye(3), np.array([0.0, 0.0, 0.2]) + k * np.array(step), [0.35, 0.25, 0.4])
                     for k in range(3)])  # fmt: skip
    graph = scene_graph(State(rows, [UPRIGHT] * 3, [False] * 3, [FLOOR] * 3, [0.0] * 3), np.eye(4))
    groups = bodies_of(graph, blocks_of(graph), 0.006, 0.01)
    assert sorted(map(len, groups)) == ([3] if together else [1, 1, 1])
    if together:
        _, size = hull_of(graph, groups[0])
        assert size == pytest.approx(np.array([0.35, 0.25, 0.4]) + 2.0 * np.array(step))


HOUSEHOLD = ([[0.1] * 3] * 2, [[0.1, 0.12, 0.1], [0.05, 0.12, 0.1]], [[0.04] * 3] * 3, [[0.12, 0.09, 0.1]] * 2)
SLABS = ([[0.36, 0.8, 0.6]] * 2, [[0.4, 0.7, 0.5], [0.8, 0.7, 0.5]])


@pytest.mark.parametrize("sizes, cartons", [*((each, False) for each in HOUSEHOLD), *((each, True) for each in SLABS)])
def test_a_household_sets_boxes_against_each_other_without_their_being_pallets(sizes, cartons):
    ends = np.cumsum([0.0, *(size[0] + 0.002 for size in sizes)])
    rows = np.array([make_row(BOX, np.eye(3), [end + 0.5 * size[0], 0.0, 0.5 * size[2]], size)
                     for size, end in zip(sizes, ends, strict=False)])  # fmt: skip
    many = len(rows)
    graph = scene_graph(State(rows, [UPRIGHT] * many, [False] * many, [FLOOR] * many, [0.0] * many), np.eye(4))
    ((*names,),) = bodies_of(graph, blocks_of(graph), 0.006, 0.01)
    odds = odds_before(graph, names, bare_image().loose.cartons, bare_image(), 1.0)
    assert np.logaddexp.reduce([*odds.values()]) > np.log(20.0) if cartons else max(odds.values()) < np.log(0.02)


@pytest.mark.parametrize("many", [3, 40])
def test_grids_too_many_to_be_told_leave_the_one_box_its_share(many):
    """Of forty grids of .02 each and one box of .2 some are left out: the box keeps .2, and has none of their share."""
    part, *_ = pallet()
    grids = [Grid((2, 2, 1 + k % 5), np.log(0.8 / many / 0.2), *EVEN) for k in range(many)]
    found = divide(np.random.default_rng(0), part, [(("box_1",), grids)])
    assert sum(each.weight for each in found) == pytest.approx(1.0)
    assert found[0].graph.names == part.graph.names and found[0].weight == pytest.approx(0.2)


def test_one_box_that_many_unlikely_grids_outweigh_is_not_sure():
    """Each of 60 grids is below what is told, and all of them together are a third."""
    part, *_ = pallet()
    grids = [Grid((2, 2, 1), np.log(0.5 / 60), *EVEN)] * 60
    assert divide(np.random.default_rng(0), part, [(("box_1",), grids)])[0].weight == pytest.approx(2.0 / 3.0)
    assert divide(np.random.default_rng(0), part, [(("box_1",), [Grid((2, 2, 1), -20.0, *EVEN)] * 60)]) == [part]


def test_three_bodies_that_may_be_many_grids_are_told_by_what_is_likeliest_of_all_together():
    part, *_ = pallet(slabs=3)
    grids = [Grid((2, 2, 1 + k), np.log(k + 1.0), *EVEN) for k in range(4)]
    found = divide(np.random.default_rng(0), part, [((f"box_{k}",), grids) for k in (1, 2, 3)])
    assert len(found) < 15 and sum(each.weight for each in found) == pytest.approx(1.0)
    assert len(found[0].graph.names) == 1 + 3 * 16, "the likeliest of all: each in four layers of four"


def test_the_prior_of_grids_keeps_its_metres_in_any_unit_and_leaves_household_boxes_alone():
    beliefs = bare_image()
    cartons = beliefs.loose.cartons

    def odds(parts, size, unit=1.0):
        return prior_odds(np.array(size) / unit, cartons, beliefs, unit)[parts]

    assert odds((3, 3, 2), [0.9, 0.8, 0.5]) > 0.0 > odds((2, 2, 1), [0.45, 0.45, 0.3])
    assert odds((2, 2, 1), [0.1, 0.09, 0.08]) < -12.0
    parts, size = np.array([3, 2, 1]), np.array([0.5, 0.3, 0.2])
    for unit in (1.0, 1.7):  # a length in n parts is log-normal about n times the median
        many = lognorm(0.4, scale=0.2 * parts / unit).logpdf(size / unit).sum()
        carton = lognorm(0.4, scale=0.2 / unit).logpdf(size / unit).sum()
        anything = box_log_density(beliefs.sizes[BOX], size / unit, True)
        one = np.logaddexp(carton + np.log(3 * 0.8), anything) - np.log(2.0)
        counts = [n for n in (np.prod(each) for each in product(range(1, 6), repeat=3)) if n >= 4]
        before = np.log(0.02 / 0.98) - np.log(6 * np.sum(1.0 / np.array(counts)))
        upended = np.log(1.5 * 0.2)  # each carton is higher than it is wide: of three ways up one of the two others
        assert odds(tuple(parts), size, unit) == pytest.approx(before + many + upended - one)
    flat, standing = (odds((3, 3, layers), [1.2, 0.72, 0.33]) for layers in (2, 1))
    assert flat > standing, "two layers of 40 x 24 x 16 cm before one of cartons that stand 33 cm high"
