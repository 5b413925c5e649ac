"""Open boxes are one object, solids that stand around a place are not."""

import numpy as np
import pytest

import derender
from derender.camera.intrinsics import Camera
from derender.detection.openings import walls
from derender.detection.search.observation import observe
from derender.detection.solids.image import make_row
from derender.detection.solids.polish import UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.render.raycast.depth import render_depth
from derender.scene.pose import rotation_z
from derender.scene.solids import BOX, PLANE, Solids

CAMERA = Camera.from_field_of_view(160, 120, 58.0)
SIGMA = 0.001


def table_pose():
    """Return the pose (4, 4) of a table that is seen from 45 degrees above, 80 cm away."""
    down = np.radians(45.0)
    up = np.array([0.0, -np.cos(down), -np.sin(down)])
    table = np.eye(4)
    table[:3, :3] = np.column_stack([[1.0, 0.0, 0.0], np.cross(up, [1.0, 0.0, 0.0]), up])
    table[:3, 3] = 0.0, 0.02, 0.8
    return table


TABLE, TURN = table_pose(), 0.4


def seen(boxes):
    """Return a DepthImage of upright boxes (x, y, (length, width, height)) on a table, with white noise."""
    poses, sizes = [TABLE], [np.zeros(3)]
    for x, y, size in boxes:
        pose = rotation_z(0.0)
        pose[:3, 3] = x, y, 0.5 * size[2]
        poses.append(TABLE @ rotation_z(TURN) @ pose)
        sizes.append(np.array(size))
    kinds, which = [PLANE] + [BOX] * len(boxes), [-1] * (1 + len(boxes))
    solids = Solids(np.array(kinds, np.int32), np.array(poses), np.array(sizes), np.array(which, np.int32), ())
    depth = render_depth(solids, CAMERA)[0]
    return derender.DepthImage(depth + SIGMA * np.random.default_rng(0).standard_normal(depth.shape), CAMERA)


def around(length, width, height, wall):
    """Return the four walls of an open box."""
    across = (wall, width, height), 0.5 * (length - wall)
    along = (length - 2.0 * wall, wall, height), 0.5 * (width - wall)
    return [(way * across[1], 0.0, across[0]) for way in (-1, 1)] + [(0.0, way * along[1], along[0]) for way in (-1, 1)]


def test_the_walls_of_a_tray_are_one_object():
    found = derender.infer(seen(around(0.3, 0.2, 0.06, 0.006)), seed=0, quick=True)
    assert [each.type for each in found.objects] == ["thing"]
    tray = found.objects[0]
    assert np.sort(tray.size) == pytest.approx([0.06, 0.2, 0.3], abs=0.01)


@pytest.mark.parametrize("height", [0.04, 0.06])
def test_the_bottom_of_a_tray_is_no_board_that_lies_in_it(height):
    boxes = [*around(0.3, 0.2, height, 0.006), (0.0, 0.0, (0.288, 0.188, 0.015))]
    found = derender.infer(seen(boxes), seed=0, quick=True)
    assert [each.type for each in found.objects] == ["thing"]


def test_what_is_left_along_the_foot_of_a_tray_is_no_board(monkeypatch):
    """Boards and cubes at P 1.00 explained the pixels about a tray, each of which tells much of independent noise."""
    monkeypatch.setattr(f"{__name__}.CAMERA", Camera.from_field_of_view(320, 240, 58.0))
    found = derender.infer(seen([*around(0.3, 0.2, 0.06, 0.006), (0.0, 0.0, (0.288, 0.188, 0.004))]), seed=0)
    assert [each.type for each in found.objects] == ["thing"]


def test_walls_of_which_the_edges_alone_are_seen_are_walls():
    """Of a tray that two walls explain the others show nothing but their upper edges, which go around with them."""
    boxes, image = around(0.3, 0.22, 0.06, 0.006), seen(around(0.3, 0.22, 0.06, 0.006))
    there = observe(image.depth, CAMERA)
    state, place = State(), np.linalg.inv(there.floor.pose) @ TABLE @ rotation_z(TURN)
    for x, y, size in (boxes[0], boxes[3]):
        middle = place[:3] @ [x, y, 0.5 * size[2], 1.0]
        state = state.add(make_row(BOX, place[:3, :3], middle, np.array(size)), UPRIGHT, False, FLOOR, 0.0)
    solids, things, edges = walls(there, state, [])
    assert sorted(solids) == [0, 1] and not things and edges.any()
    assert walls(there._replace(mask=there.mask & ~edges), state, []) is None


def test_what_stands_in_a_tray_is_an_object_of_its_own():
    found = derender.infer(
        seen([*around(0.34, 0.24, 0.05, 0.006), (0.03, 0.0, (0.06, 0.06, 0.06))]), seed=0, quick=True
    )
    assert sorted(each.type for each in found.objects) in (["box", "thing"], ["cube", "thing"])


def test_blocks_of_one_height_around_a_place_stay_blocks():
    blocks = [(x, y, (0.07, 0.07, 0.07)) for x, y in ((-0.12, 0.0), (0.12, 0.0), (0.0, -0.12), (0.0, 0.12))]
    found = derender.infer(seen(blocks), seed=0, quick=True)
    assert [each.type for each in found.objects] == ["cube"] * 4
