"""The floor beside what stands on it, where another surface behind it lies nearly in its plane."""

import numpy as np

from derender.detection.floor import floor_beside
from derender.detection.floors import find_floor
from derender.scene.pose import rotation_x, rotation_z, translation
from worlds.made_scenes import camera_of, render_floor_scene

LOWER = 0.015  # metres by which what lies behind the table is lower
BOX = np.array([0.1, 0.08, 0.12])


def table_before_a_shelf(rng):
    """Return depth (H, W), camera, the table's pose (4, 4), and (H, W) bool: pixels of the box that stands on it."""
    table = rotation_x(np.pi / 2 + np.radians(35.0))
    table[:3, 3] = [0.0, 0.0, 0.9]
    camera = camera_of(160, 120)
    box = (table @ translation(0.0, -0.05, 0.06) @ rotation_z(0.4))[None]
    depth, label = render_floor_scene(["box"], box, BOX[None], table, camera)
    lower = table @ translation(0, 0, -LOWER)
    behind, _ = render_floor_scene([], np.zeros((0, 4, 4)), np.zeros((0, 3)), lower, camera)
    rows = np.arange(depth.shape[0])[:, None] < 50
    depth = np.where(rows & (label < 0), behind, depth)
    return depth + 0.001 * rng.normal(size=depth.shape), camera, table, label == 0


def height_off(floor, table):
    """Return how far a plane lies from the table at the box's foot, in metres."""
    foot = (table @ [0.0, -0.05, 0.0, 1.0])[:3]
    return abs((foot - floor.pose[:3, 3]) @ floor.pose[:3, 2])


def test_the_floor_is_the_one_beside_the_feet():
    rng = np.random.default_rng(0)
    depth, camera, table, standing = table_before_a_shelf(rng)
    first = find_floor(depth, camera)
    found = floor_beside(first, depth, camera, standing)
    assert height_off(found, table) < 0.001
    assert found.sigma < 0.002
    assert height_off(first, table) > 0.002  # the plane of most pixels lies between the two


def test_the_floor_of_an_even_image_stays_where_it_is():
    rng = np.random.default_rng(1)
    depth, camera, table, standing = table_before_a_shelf(rng)
    even, _ = render_floor_scene([], np.zeros((0, 4, 4)), np.zeros((0, 3)), table, camera)
    depth = np.where(standing, depth, even + 0.001 * rng.normal(size=depth.shape))
    found = floor_beside(find_floor(depth, camera), depth, camera, standing)
    assert height_off(found, table) < 2e-4
    assert found.pose[:3, 2] @ table[:3, 2] > np.cos(np.radians(0.1))
