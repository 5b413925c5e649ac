"""How long a search looks on; which pixels it and the draws see."""

from types import SimpleNamespace

import numpy as np
import pytest

from derender.camera.intrinsics import Camera
from derender.detection.search import searches
from derender.detection.search.greedy import Settings, Task
from derender.detection.search.observation import nearest_pixels, observe
from derender.render.raycast.depth import render_depth
from derender.scene.pose import rotation_x, translation
from derender.scene.solids import BOX, PLANE, Solids
from worlds.made_scenes import render_floor_scene

CAMERA = Camera(30.0, 30.0, 15.5, 11.5, 32, 24)
FLOOR_POSE = translation(0.0, 0.05, 0.8) @ rotation_x(np.deg2rad(135))


def test_a_quick_search_ends_where_nothing_is_left_and_a_whole_one_goes_on(monkeypatch):
    asked = []
    monkeypatch.setattr(searches, "find_places", lambda *_: SimpleNamespace(none_left=lambda settings: explained))
    monkeypatch.setattr(searches, "total_energy", lambda *_: 0.0)
    monkeypatch.setattr(searches, "propose", lambda *_: asked.append(1))

    def rounds(tries):
        asked.clear()
        task = Task(None, Settings(tries=tries, quiet=10))
        searches.repair(searches.Climb(np.random.default_rng(0), task, []))
        return len(asked)

    explained = True
    assert rounds(tries=1) == 0 and rounds(tries=2) == 10
    explained = False
    assert rounds(tries=1) == 10 and rounds(tries=2) == 10 * searches.IN_VAIN


def test_the_nearest_pixels_of_a_reduced_image():
    # reduced by 4 its pixels stand for 1, 5, 9; by 2 they stand for 0, 2, 4, 6, 8, 10
    assert nearest_pixels(6, 2, 3, 4).tolist() == [0, 0, 1, 1, 2, 2]
    assert nearest_pixels(4, 3, 4, 3).tolist() == [0, 1, 2, 3]


WHOLE = Camera.from_field_of_view(640, 480)
TABLE = np.array([[1.0, 0, 0, 0], [0, -0.5, -0.8660254, 0.02], [0, 0.8660254, -0.5, 0.75], [0, 0, 0, 1]])


def test_single_pixels_are_what_the_reduced_camera_sees_and_smoothed_blocks_are_not():
    pose = np.eye(4)
    pose[:3, :3] = [[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]
    pose[2, 3] = 0.06
    solids = Solids(np.array([PLANE, BOX], np.int32), np.array([TABLE, TABLE @ pose]),
                    np.array([np.zeros(3), [0.1, 0.12, 0.12]]), np.full(2, -1, np.int32))  # fmt: skip
    depth, _ = render_depth(solids, WHOLE)
    seen = observe(depth, WHOLE)
    assert seen.factor == 4
    exact, _ = render_depth(solids, seen.camera)
    assert np.abs(seen.single - exact).max() < 1e-9
    assert np.abs(seen.image.depth - exact).max() > 0.001  # where an edge runs through a block


def test_single_pixels_without_a_return_stay_without():
    bare = Solids(np.array([PLANE], np.int32), TABLE[None], np.zeros((1, 3)), np.full(1, -1, np.int32))
    depth, _ = render_depth(bare, WHOLE)
    depth[101, 101] = np.nan
    depth[105, 105] = 0.0
    single = observe(depth, WHOLE).single
    assert np.isnan(single[25, 25]) and np.isnan(single[26, 26]) and np.isnan(single).sum() == 2


@pytest.mark.parametrize("slip", [0.0, 1e-17, -1e-17])
@pytest.mark.parametrize("side", [-1, 1])
def test_a_box_is_drawn_whose_side_the_camera_lies_in(side, slip):
    """Whichever side of the plane rounding puts the camera on."""
    camera = Camera.from_field_of_view(96, 72)
    floor = translation(0.0, 0.0, 0.7) @ rotation_x(np.radians(125.0))
    box = floor @ translation(0.03 * side + slip, 0.0, 0.03)
    sizes = np.array([[0.0] * 3, [0.06] * 3])
    solids = Solids(np.array([PLANE, BOX]), np.stack([floor, box]), sizes, np.array([-1, -1]))
    expected, label = render_depth(solids, camera)
    depth, _ = render_floor_scene(["box"], box[None], sizes[1:], floor, camera)
    assert (label == 1).sum() > 50 and np.abs(depth - expected)[label == 1].max() < 1e-4
