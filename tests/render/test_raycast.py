"""Rendering against textbook ray casting in numpy, kind by kind and all together."""

import numpy as np
import pytest
from random_scenes import cast_rays, random_solids

from derender.camera.intrinsics import Camera
from derender.render.raycast.depth import render_depth
from derender.scene.pose import rotation_x, rotation_y, translation
from derender.scene.solids import BOX, CYLINDER, MESH, PLANE, SPHERE, Solids

CAMERAS = [Camera(70, 70, 31.5, 23.5, 64, 48), Camera(61, 63.5, 30.2, 40.7, 53, 64), Camera(30, 30, 31, 31, 64, 64)]


def grid(camera):
    return np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))


def clear_of_edges(solids, camera, label):
    """Return pixels where rays 1e-4 pixels to all sides meet the same solid: the others are ties of rounding."""
    columns, rows = grid(camera)
    clear = np.ones(label.shape, bool)
    for dx, dy in ((1e-4, 1e-4), (1e-4, -1e-4), (-1e-4, 1e-4), (-1e-4, -1e-4)):
        clear &= cast_rays(solids, camera, columns + dx, rows + dy)[1] == label
    return clear


def agree(solids, camera):
    depth, label = render_depth(solids, camera)
    expected, expected_label = cast_rays(solids, camera, *grid(camera))
    clear = clear_of_edges(solids, camera, expected_label)
    assert clear.mean() > 0.95
    np.testing.assert_array_equal(label[clear], expected_label[clear])
    hit = clear & (expected_label >= 0)
    # Both work in float64; near the horizon of a plane depth is ill-conditioned, inverse depth is not.
    np.testing.assert_allclose(1.0 / depth[hit], 1.0 / expected[hit], rtol=1e-9, atol=1e-9)
    assert np.isnan(depth[label < 0]).all()


@pytest.mark.parametrize("kind", [PLANE, BOX, SPHERE, CYLINDER])
def test_each_kind_agrees_with_textbook_formulas(kind):
    rng = np.random.default_rng(kind)
    for trial in range(60):
        agree(random_solids(rng, 1 + trial % 2, (kind,)), CAMERAS[trial % 3])


def test_meshes_agree_with_textbook_formulas():
    rng = np.random.default_rng(4)
    for trial in range(3):
        agree(random_solids(rng, 1, (MESH,)), CAMERAS[trial % 3])


def test_mixed_scenes_agree():
    rng = np.random.default_rng(10)
    for trial in range(60):
        agree(random_solids(rng, 8, (PLANE, BOX, SPHERE, CYLINDER)), CAMERAS[trial % 3])


@pytest.mark.parametrize("kind", [BOX, SPHERE, CYLINDER])
def test_solids_partly_or_wholly_behind_the_camera(kind):
    rng = np.random.default_rng(20 + kind)
    shown = 0
    for trial in range(60):
        solids = random_solids(rng, 1, (kind,), nearest=-0.3)
        solids.pose[:, 2, 3] = rng.uniform(-0.15, 0.15)
        inside_out = -solids.pose[0, :3, :3].T @ solids.pose[0, :3, 3]
        if (np.abs(inside_out) < solids.size[0] / 2 + 1e-3).all():
            continue  # a camera in the solid's box; what it sees is tested below
        agree(solids, CAMERAS[trial % 3])
        shown += (render_depth(solids, CAMERAS[trial % 3])[1] >= 0).any()
    assert shown > 1


@pytest.mark.parametrize("kind", [BOX, SPHERE, CYLINDER])
def test_a_camera_inside_a_solid_sees_through_it(kind):
    solids = Solids(
        np.array([kind], np.int32), translation(0.01, 0.02, 0.01)[None], np.full((1, 3), 0.5), np.array([-1], np.int32)
    )
    depth, label = render_depth(solids, CAMERAS[0])
    assert (label == -1).all()
    assert np.isnan(depth).all()


def test_a_mesh_that_crosses_the_camera_plane_is_cut_and_not_folded_over():
    corners = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 1e-9]])
    mesh = (corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    pose = translation(0.0, 0.2, 0.0) @ rotation_x(np.pi / 2)  # a floor 0.2 m below, from behind to 0.5 m ahead
    size = np.ptp(corners, axis=0)
    solids = Solids(np.array([MESH], np.int32), pose[None], size[None], np.array([0], np.int32), (mesh,))
    camera = CAMERAS[0]
    depth, label = render_depth(solids, camera)
    columns, rows = grid(camera)
    floor = 0.2 / ((rows - camera.cy) / camera.fy)
    expected = (floor > 0) & (floor < 0.5 - 1e-6) & (np.abs((columns - camera.cx) / camera.fx * floor) < 0.5 - 1e-6)
    np.testing.assert_array_equal(label >= 0, expected)
    np.testing.assert_allclose(depth[expected], floor[expected], rtol=1e-6)


def test_a_plane_ends_at_its_horizon():
    pose = translation(0.0, 0.5, 0.0) @ rotation_x(np.pi / 2)  # level with the camera, half a metre below
    solids = Solids(np.array([PLANE], np.int32), pose[None], np.zeros((1, 3)), np.array([-1], np.int32))
    camera = CAMERAS[0]
    depth, label = render_depth(solids, camera)
    rows = np.arange(camera.height)
    assert (label[rows < camera.cy] == -1).all()
    below = rows > camera.cy
    np.testing.assert_allclose(depth[below, 0], 0.5 * camera.fy / (rows[below] - camera.cy), rtol=1e-9)


def test_antialiasing_converges_to_the_area_under_a_slanted_edge():
    pose = translation(0.0, 0.0, 1.0) @ rotation_y(0.0)
    pose[:3, :3] = pose[:3, :3] @ np.array([[np.cos(0.3), -np.sin(0.3), 0], [np.sin(0.3), np.cos(0.3), 0], [0, 0, 1]])
    solids = Solids(np.array([BOX], np.int32), pose[None], np.array([[0.4, 0.3, 0.2]]), np.array([-1], np.int32))
    camera = CAMERAS[0]
    fine, _ = render_depth(solids, camera, antialias=48, background=2.0)
    errors = [np.abs(render_depth(solids, camera, antialias=n, background=2.0)[0] - fine).mean() for n in (1, 2, 4, 8)]
    # A straight edge's area is off by O(1 / n) in its pixels: each doubling gains at least a factor 1.6.
    assert all(coarse > 1.6 * finer for coarse, finer in zip(errors, errors[1:], strict=False))
