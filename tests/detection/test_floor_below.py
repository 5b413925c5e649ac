"""A floor on which nothing stands, with sides that go on from it down to another, is the top of a box."""

import numpy as np
import pytest

from derender.detection.estimate import point_estimate
from derender.detection.levels import floor_below
from derender.detection.search.greedy import Settings
from derender.detection.search.observation import observe
from worlds.frontier_scenes import KINDS, make


def filled(number):
    return make(np.random.default_rng([number, list(KINDS).index("fills")]), "fills")


@pytest.mark.parametrize("number", [701, 702, 705])
def test_the_floor_below_a_top_is_found(number):
    scene = filled(number)
    seen = observe(scene.depth, scene.camera)
    plane, table = floor_below(seen), scene.tables["floor"]
    if plane is None:  # it was found at once
        normal = seen.floor.pose[:3, 2]
        plane = np.append(normal, -normal @ seen.floor.pose[:3, 3])
    assert plane[:3] @ table[:3, 2] > 0.999
    assert abs(plane[:3] @ table[:3, 3] + plane[3]) < 0.01
    assert floor_below(observe(scene.depth, scene.camera, plane=plane)) is None


@pytest.mark.parametrize("number", [700, 703, 707])
def test_a_bare_table_before_a_room_is_no_top_of_a_box(number):
    """A table from which its mug was taken became sixteen cartons on a floor of which nothing was seen."""
    scene = make(np.random.default_rng([number, list(KINDS).index("edge")]), "edge")
    seen = observe(np.where(scene.label < 0, scene.depth, np.nan), scene.camera)
    assert seen.floor.pose[:3, 2] @ scene.tables["floor"][:3, 2] > 0.999
    assert floor_below(seen) is None


@pytest.mark.slow
def test_a_box_that_fills_the_view_stands_on_the_floor_below():
    scene = filled(705)
    state, seen = point_estimate(np.random.default_rng(0), scene.depth, scene.camera, Settings())
    assert len(state) == 1 and seen.floor.pose[:3, 2] @ scene.tables["floor"][:3, 2] > 0.999
    assert abs(state.rows[0][15] - scene.objects[0]["size"][2]) < 0.01
