"""What stands on the table and what is background; how rough an image is by itself."""

import numpy as np
import pytest
from table_scenes import CAMERA, SIGMA, TABLE, seen_on_the_table

from derender.camera.intrinsics import Camera
from derender.detection.background import (
    along_edge,
    cut_off,
    frame_seen,
    is_background,
    length,
    main_part,
    shows_foot,
    standing_bodies,
)
from derender.detection.compounds import with_borne
from derender.detection.floor import local_noise
from derender.detection.patches import SeenSurface
from derender.detection.search.observation import observe
from derender.render.raycast.depth import render_depth
from derender.scene.solids import BOX, PLANE, Solids
from worlds.frontier_scenes import KINDS, make


def scene_of(solids, table=TABLE):
    """Return (depth, label of the solids), (H, W), of boxes (x, y, bottom, size) about the table."""
    poses, sizes = [table], [np.zeros(3)]
    for x, y, bottom, size in solids:
        pose = np.eye(4)
        pose[:3, 3] = x, y, bottom + 0.5 * size[2]
        poses.append(table @ pose), sizes.append(np.array(size, float))
    kinds = np.array([PLANE] + [BOX] * len(solids), np.int32)
    scene = Solids(kinds, np.array(poses), np.array(sizes), np.full(len(kinds), -1, np.int32))
    depth, label = render_depth(scene, CAMERA)
    return depth + SIGMA * np.random.default_rng(0).standard_normal(depth.shape), label


def told_apart(solids, table=TABLE):
    """Return (Observation, label (H, W) of the solids behind it) of boxes (x, y, bottom, size) about the table."""
    depth, label = scene_of(solids, table)
    return observe(depth, CAMERA), label


CARTON = (0.0, 0.0, 0.0, (0.1, 0.08, 0.12))


@pytest.mark.parametrize(
    "clutter",
    [(0.0, 0.45, 0.0, (1.6, 0.05, 0.7)), (-0.42, 0.2, 0.0, (0.05, 0.8, 0.3)), (0.15, 0.1, 0.2, (0.12, 0.1, 0.05))],
    ids=["a wall behind", "a wall at the side", "something that hangs in the air"],
)
def test_a_carton_stands_on_the_table_and_clutter_does_not(clutter):
    seen, label = told_apart([CARTON, clutter])
    assert seen.mask[label == 1].mean() > 0.9
    assert seen.mask[label == 2].mean() < 0.1
    assert seen.behind[label == 2].mean() > 0.9


@pytest.mark.parametrize("times", [1, 2, 3])
def test_what_stands_is_told_by_what_is_below_it_however_the_camera_was_held(times):
    """A phone in portrait: what hung in the air stood on the floor, for it was looked for beside it."""
    clutter = (0.15, 0.1, 0.2, (0.12, 0.1, 0.05))
    depth = scene_of([CARTON, clutter])[0]
    numbers = {"fx": CAMERA.fx, "fy": CAMERA.fy, "cx": CAMERA.cx, "cy": CAMERA.cy}
    for _ in range(times):
        numbers.update(cx=numbers["cy"], cy=CAMERA.width - 1 - numbers["cx"] if len(depth) == CAMERA.height else
                       CAMERA.height - 1 - numbers["cx"])  # fmt: skip
        depth = np.ascontiguousarray(np.rot90(depth))
    turned = observe(depth, Camera(**numbers, width=depth.shape[1], height=depth.shape[0]))
    upright = observe(scene_of([CARTON, clutter])[0], CAMERA)
    assert (np.rot90(turned.mask, -times) != upright.mask).mean() < 0.002


@pytest.mark.parametrize(("aside", "bottom", "whole"), [(0.0, 0.08, True), (0.1, 0.08, False), (0.0, 0.2, False)])
def test_what_the_border_cuts_is_part_of_the_foot_that_it_is_all_over(aside, bottom, whole):
    """A chair's seat was background, for the border cuts its back, and its foot an object; an arm reaches beyond."""
    seen, label = told_apart([(0.0, 0.0, 0.0, (0.16, 0.14, 0.03)), (aside, 0.0, bottom, (0.14, 0.1, 0.6))])
    foot, seat = label == 1, label == 2
    there, masks = with_borne(seen._replace(behind=seat), [foot])
    assert (there.behind.any(), len(masks)) == (not whole, 1)
    assert (masks[0] == (foot | seat if whole else foot)).all()


def test_what_seems_to_hang_over_a_carton_may_stand_on_it():
    carton, above = (0.0, 0.05, 0.0, (0.1, 0.1, 0.12)), (0.0, -0.02, 0.17, (0.12, 0.12, 0.08))
    seen, label = told_apart([carton, above])
    assert seen.mask[label == 2].mean() > 0.9
    seen, label = told_apart([above])  # a broken twin: nothing there that could bear it
    assert seen.behind[label == 1].mean() > 0.9


def test_a_carton_right_below_the_camera_stands_though_no_side_of_it_shows():
    table = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.8], [0.0, 0.0, 0.0, 1.0]])
    seen, label = told_apart([(0.0, 0.0, 0.0, (0.12, 0.1, 0.15)), (0.2, 0.1, 0.0, (0.1, 0.1, 0.05))], table)
    assert seen.mask[label == 1].mean() > 0.9
    assert seen.mask[label == 2].mean() > 0.9


def test_a_small_thing_at_the_edge_of_the_image_stands_there():
    seen, label = told_apart([CARTON, (0.1, -0.19, 0.0, (0.08, 0.08, 0.08))])
    assert (label == 2).sum() > 100 and seen.mask[label == 2].mean() > 0.9


def test_a_carton_that_touches_a_wall_stands_before_it():
    seen, label = told_apart([(0.0, 0.37, 0.0, (0.1, 0.1, 0.12)), (0.0, 0.45, 0.0, (1.6, 0.05, 0.7))])
    assert seen.mask[label == 1].mean() > 0.8
    assert seen.mask[label == 2].mean() < 0.1


def test_what_the_side_border_cuts_goes_on_as_a_wall_does_only_where_it_is_long():
    mask = np.zeros((40, 60), bool)
    mask[10:30, 45:] = True
    along, frame = np.linspace(0.0, 1.0, mask.sum()), (0, 39, 0, 59)
    for metres, cut in ((0.15, False), (0.3, True)):
        points = np.zeros((*mask.shape, 3))
        points[mask, 0] = metres * along
        assert cut_off(points, mask, frame) is cut


def test_length_and_edge():
    wall = np.column_stack([np.linspace(-0.2, 0.2, 50), np.zeros(50), np.linspace(0, 0.1, 50)])
    turn = np.array([[np.cos(0.4), -np.sin(0.4), 0], [np.sin(0.4), np.cos(0.4), 0], [0, 0, 1]])
    assert length(wall @ turn.T) == pytest.approx(0.4, rel=0.05)
    assert along_edge(wall, np.full(50, -0.01))
    assert not along_edge(wall, np.full(50, -0.1))
    assert not along_edge(0.3 * wall, np.full(50, -0.01))


def test_roughness_is_that_of_the_noise_whatever_stands_there():
    image = seen_on_the_table([(BOX, 0.0, 0.0, (0.2, 0.15, 0.15), None)])
    assert local_noise(image, CAMERA) == pytest.approx(SIGMA, rel=0.3)


@pytest.mark.parametrize("number", [0, 1, 17104])
def test_a_carton_whose_top_shows_stands_there_though_the_border_cuts_it_and_a_wall_does_not(number):
    """In the last one it shows in a tenth of the carton's pixels, at a grazing angle: it was "nothing", trusted."""
    scene = make(np.random.default_rng([number, list(KINDS).index("fills")]), "fills")
    seen = observe(scene.depth, scene.camera)
    carton = scene.label[::2, ::2] == 0
    assert carton.mean() > 0.4 and carton[0].any()  # the border cuts it
    assert seen.mask[carton].mean() > 0.9 and seen.background < 0.1


def flat_surface(height, width, across=0.005):
    """Return the SeenSurface of a level plane, so many metres from pixel to pixel, seen from the last row's side."""
    row, column = np.indices((height, width))
    points = np.stack([across * column, across * row, np.zeros((height, width))], axis=-1)
    eye = across * np.array([0.5 * width, 2.0 * height, height])
    everywhere = np.ones((height, width), bool)
    return SeenSurface.of(points, everywhere, np.full((height, width), across), np.zeros((height, width)), eye)


def test_what_has_grown_together_with_the_background_belongs_to_it():
    surface, mask, behind = flat_surface(60, 80), np.zeros((60, 80), bool), np.zeros((60, 80), bool)
    mask[20:40, 30:40], behind[:, 40:60] = True, True
    upright = np.zeros_like(surface.points)
    frame, inside, edge = (0, 59, 0, 79), np.full((60, 80), -1.0), np.zeros((60, 80))
    assert is_background(surface, mask, upright, behind, inside, frame)  # a third of its outline goes on in the wall
    behind[27:] = False
    assert not is_background(surface, mask, upright, behind, inside, frame)
    assert is_background(surface, mask, upright, behind, edge, frame)  # it stands where the floor ends
    behind[27:40, 40:60] = True
    surface.points[:, 40:, 2] = 0.1
    assert not is_background(surface, mask, upright, behind, inside, frame)  # the wall is ten centimetres behind it


@pytest.mark.parametrize(("eye", "stands"), [((0.4, 0.3, 0.9), True), ((-0.9, 0.3, 0.5), False)])
def test_a_carton_against_a_bins_wall_stands_where_its_sides_would_not_show_from_above(eye, stands):
    """Of a carton seen from above the top alone shows: it was taken for what hangs on the wall, without a word."""
    row, column = np.indices((60, 80))
    height = 0.015 * np.maximum(column - 40, 0)
    carton = (abs(row - 25) < 6) & (column >= 35) & (column < 44)
    points = np.stack([0.01 * column, 0.01 * row, np.where(carton, 0.05, height)], axis=-1)
    even = np.full(row.shape, 0.01)
    surface = SeenSurface.of(points, even > 0.0, even, 0.0 * even, np.array(eye))
    nothing = np.zeros(row.shape, bool)
    found = standing_bodies(surface, points[..., 2] > 0.005, 0.01 * (column - 44.0), nothing)
    assert (found[carton].mean() > 0.8) == stands == found.any() and not found[~carton].any()


def test_what_the_side_of_the_image_cuts_as_a_hand_belongs_to_it():
    surface, mask, nothing = flat_surface(60, 80), np.zeros((60, 80), bool), np.zeros((60, 80), bool)
    mask[20:40, 70:80], surface.points[..., 2] = True, 0.05  # it does not stand on the floor
    inside, upright = np.full((60, 80), -1.0), np.zeros_like(surface.points)
    assert is_background(surface, mask, upright, nothing, inside, (0, 59, 0, 79))
    assert not is_background(surface, np.roll(mask, -5, axis=1), upright, nothing, inside, (0, 59, 0, 79))


@pytest.mark.parametrize(("columns", "wall"), [(50, True), (30, False)])
def test_a_solid_that_is_long_and_stands_along_the_edge_of_the_floor_is_the_wall_of_a_bin(columns, wall):
    """Of a wall that a mug before it hid in part, the rest was a sheet, which leant on the mug: a box at P .94."""
    surface, mask, nothing = flat_surface(60, 80), np.zeros((60, 80), bool), np.zeros((60, 80), bool)
    mask[20:24, 15 : 15 + columns] = True
    near_the_edge, upright = np.full((60, 80), -0.02), np.zeros_like(surface.points)
    assert is_background(surface, mask, upright, nothing, near_the_edge, (0, 59, 0, 79)) == wall


INSIDE, FRAME = np.full((60, 80), -1.0), (0, 59, 0, 79)


def with_a_front(side, rows, bottom=0.0):
    """Return (SeenSurface, mask) of a plane with an upright front of so many rows before it, cut by the top or right
    border, that begins so many metres over the plane."""
    surface, mask = flat_surface(60, 80), np.zeros((60, 80), bool)
    top, columns = (0, slice(30, 54)) if side == "top" else (16, slice(56, 80))
    part = slice(top, top + rows), columns
    mask[part] = True
    surface.points[part][..., 1] = 0.005 * (top + rows)
    surface.points[part][..., 2] = bottom + 0.005 * np.arange(rows)[::-1, None]
    return surface, mask


@pytest.mark.parametrize("side", ["top", "right"])
def test_what_the_border_cuts_but_shows_to_stand_on_the_floor_is_no_hand_and_no_wall(side):
    """Of a block that stands on the floor all along its lower edge the border may cut off what it likes."""
    surface, mask = with_a_front(side, 24)
    nothing, upright = np.zeros((60, 80), bool), np.zeros_like(surface.points)
    assert cut_off(surface.points, mask, FRAME, least=0.0)
    assert shows_foot(surface, mask, INSIDE, FRAME)
    assert not is_background(surface, mask, upright, nothing, INSIDE, FRAME)
    assert not shows_foot(surface, mask, np.zeros((60, 80)), FRAME)  # where the floor ends, as a wall


def test_what_is_large_and_cut_by_the_border_stands_there_where_its_foot_and_both_its_sides_show():
    """A pallet of cartons whose top is cut off was background; a sofa that goes on beyond the image is."""
    for side, stands in (("top", True), ("right", False)):
        surface, mask = with_a_front(side, 24)
        large = surface.in_units_of(1.0 / 6.0)
        assert shows_foot(large, mask, INSIDE, FRAME) == stands
        assert not shows_foot(large, mask, np.full((60, 80), -0.01), FRAME)  # along the edge of the floor
    surface, mask = with_a_front("top", 24, 0.02)
    assert shows_foot(surface, mask, INSIDE, FRAME) and not shows_foot(
        surface.in_units_of(1.0 / 6.0), mask, INSIDE, FRAME
    )  # a shelf


@pytest.mark.parametrize("side", ["top", "right"])
def test_what_comes_down_near_the_floor_stands_on_it_though_its_foot_is_narrow_or_hidden(side):
    """A monitor on its foot, a cabinet on its wheels: no detail of the image, and before what is farther behind."""
    assert shows_foot(*with_a_front(side, 24, 0.035), INSIDE, FRAME)
    assert not shows_foot(*with_a_front(side, 24, 0.06), INSIDE, FRAME)  # it hangs over the floor as an arm does
    surface, mask = with_a_front(side, 24, 0.035)
    surface.points[~mask, 1] += 0.3  # what shows beside it is nearer: a wall's piece that others leave to be seen
    assert not shows_foot(surface, mask, INSIDE, FRAME)


@pytest.mark.parametrize(("first", "background"), [(0, True), (30, False)])
def test_what_both_sides_of_the_image_cut_is_background_though_it_shows_a_level_top(first, background):
    """A bin's rim before its bottom was an object at P .97."""
    surface, mask = flat_surface(60, 80), np.zeros((60, 80), bool)
    mask[34:46, first:] = True
    surface.points[mask, 2] = 0.1
    upright, nothing, inside = np.zeros_like(surface.points), np.zeros((60, 80), bool), np.full((60, 80), -1.0)
    upright[..., 2] = 1.0
    assert is_background(surface, mask, upright, nothing, inside, (0, 59, 0, 79)) == background


def test_the_border_is_where_returns_begin_not_the_top_of_a_solid():
    """A registered image has margins; before a room without returns a can's top is the first thing seen."""
    good = np.zeros((60, 80), bool)
    good[10:55, 5:78] = True
    good[9, 20:30] = True  # ragged
    assert frame_seen(good) == (10, 54, 5, 77)
    can = np.zeros((60, 80), bool)
    can[25:, :] = can[8:, 30:40] = True
    assert frame_seen(can) == (0, 59, 0, 79)


def test_a_piece_of_the_floor_that_a_solid_parts_is_kept_and_a_piece_of_a_wall_is_not():
    y, x = np.indices((60, 70)) * 0.01
    points = np.stack([x, y, np.zeros_like(x)], axis=-1)
    points[:, 66:, 2] = x[:, 66:] - 0.68  # it crosses the plane at half a right angle
    on_plane = np.ones(x.shape, bool)
    on_plane[:, 50:56] = on_plane[:, 60:66] = False
    kept = main_part(points, on_plane, np.full(x.shape, 0.01), np.array([0.3, 0.3, 1.0]))
    assert kept[:, :50].all()
    assert kept[:, 56:60].all()  # 240 pixels beside 3,000
    assert not kept[:, 66:].any()
