"""The two renderers against each other, against hand-computed pixels, and the pictures."""

import os
import subprocess
import sys

import numpy as np
import pytest
import trimesh

from derender.camera.intrinsics import Camera
from derender.errors import DerenderError
from derender.render.renderers import find_renderer
from derender.render.renderers.opengl import choose_platform
from derender.render.renderers.preview import PLANE_COLOUR, default_colours, draw_preview
from derender.scene.pose import random_rotation
from derender.scene.solids import BOX, CYLINDER, MESH, PLANE, SPHERE, Solids

CAMERAS = [
    Camera(150, 150, 79.5, 59.5, 160, 120),
    Camera(61, 63.5, 30.2, 33.7, 64, 64),
    Camera(140, 139, 70.0, 90.0, 120, 160),
    Camera(525, 525, 319.5, 239.5, 640, 480),
]


def pyrender_works():
    try:
        choose_platform()
    except DerenderError:
        return False
    return True


needs_opengl = pytest.mark.skipif(not pyrender_works(), reason="neither OSMesa nor EGL is installed")
NAMES = ["raycast", pytest.param("pyrender", marks=needs_opengl)]


def solids_of(rows, meshes=()):
    """Return Solids of rows (kind, pose, size)."""
    kinds = np.array([row[0] for row in rows], dtype=np.int32)
    mesh = np.where(kinds == MESH, 0, -1).astype(np.int32)
    poses = np.array([row[1] for row in rows], dtype=float)
    return Solids(kinds, poses, np.array([row[2] for row in rows], dtype=float), mesh, tuple(meshes))


def random_scene(rng, count):
    """Return a floor and solids of all kinds at random places in front of the camera."""
    floor = np.eye(4)
    tilt = rng.uniform(np.radians(100), np.radians(140))
    cosine, sine = np.cos(tilt), np.sin(tilt)
    floor[:3, :3] = np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    floor[:3, 3] = [0, rng.uniform(0.1, 0.3), rng.uniform(0.7, 1.1)]
    rows = [(PLANE, floor, np.zeros(3))]
    shape = trimesh.creation.icosphere(1, radius=0.5)
    vertices = np.ascontiguousarray(shape.vertices * [0.2, 0.15, 0.1])
    vertices -= (vertices.max(0) + vertices.min(0)) / 2
    for _ in range(count):
        kind = rng.integers(BOX, MESH + 1)
        size = rng.uniform(0.04, 0.2, 3)
        if kind == SPHERE:
            size[:] = size[0]
        if kind == CYLINDER:
            size[1] = size[0]
        if kind == MESH:
            size = np.ptp(vertices, axis=0) * rng.uniform(0.5, 1.2)
        pose = random_rotation(rng)
        pose[:3, 3] = rng.uniform([-0.3, -0.2, 0.5], [0.3, 0.2, 1.2])
        rows.append((kind, pose, size))
    return solids_of(rows, [(vertices, np.ascontiguousarray(shape.faces, dtype=np.int32))])


def away_from_silhouettes(label, depth):
    """Return bool: the 5 x 5 pixels around see the same solid, and its surface is not seen at a grazing angle."""
    inner = np.zeros(label.shape, dtype=bool)
    windows = np.lib.stride_tricks.sliding_window_view(label, (5, 5))
    inner[2:-2, 2:-2] = (windows == label[2:-2, 2:-2, None, None]).all(axis=(2, 3))
    steep = np.hypot(*np.gradient(depth))
    with np.errstate(invalid="ignore"):
        return inner & (steep < 0.02)


@needs_opengl
def test_pyrender_and_raycast_agree_away_from_silhouettes():
    rng = np.random.default_rng(1)
    pyrender, raycast = find_renderer("pyrender"), find_renderer("raycast")
    compared = 0
    for index in range(60):
        camera = CAMERAS[index % 3 if index % 20 else 3]
        solids = random_scene(rng, rng.integers(1, 7))
        depth, label = pyrender.render_depth(solids, camera)
        other_depth, other_label = raycast.render_depth(solids, camera)
        # Beyond 4 m 24 bits of depth are coarser than what is asked for here.
        sure = away_from_silhouettes(other_label, other_depth) & (other_label >= 0) & (other_depth < 4)
        assert np.array_equal(label[sure], other_label[sure])
        assert np.abs(depth - other_depth)[sure].max(initial=0) < 1e-4
        compared += sure.sum()
    assert compared > 3e5


@pytest.mark.parametrize("name", NAMES)
def test_half_pixels_and_axes_are_right_on_a_hand_computed_wall(name):
    """A thin box with its front face at z = 1 m from x 0.105 to 0.295 m and y -0.195 to -0.005 m, under f = 100.

    It covers the centres of the columns c + 10.5 to c + 29.5 and the rows r - 19.5 to r - 0.5: right and up.
    """
    pose = np.eye(4)
    pose[:3, 3] = [0.2, -0.1, 1.0005]
    camera = Camera(100, 100, 40.25, 50.25, 100, 80)
    depth, label = find_renderer(name).render_depth(solids_of([(BOX, pose, [0.19, 0.19, 0.001])]), camera)
    rows, columns = np.nonzero(label == 0)
    # 40.25 + 10.5 = 50.75, 40.25 + 29.5 = 69.75; 50.25 - 19.5 = 30.75, 50.25 - 0.5 = 49.75
    assert (columns.min(), columns.max(), rows.min(), rows.max()) == (51, 69, 31, 49)
    assert len(rows) == 19 * 19
    assert np.abs(depth[label == 0] - 1).max() < 1e-5
    assert np.isnan(depth[label < 0]).all()


@pytest.mark.parametrize("name", NAMES)
def test_depth_is_z_and_not_range_on_a_slanted_plane(name):
    """The plane z = 1 + x / 2 has 1 / z = 1 - (i - cx) / (2 f)."""
    normal = np.array([0.5, 0, -1]) / np.hypot(0.5, 1)
    side = np.array([0.0, 1.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([np.cross(side, normal), side, normal])
    pose[:3, 3] = [0, 0, 1]
    camera = Camera(100, 100, 31.5, 23.5, 64, 48)
    depth, label = find_renderer(name).render_depth(solids_of([(PLANE, pose, np.zeros(3))]), camera)
    expected = 1 / (1 - (np.arange(64) - 31.5) / 200)
    assert (label == 0).all()
    assert np.abs(depth - expected).max() < 1e-5


@pytest.mark.parametrize("name", NAMES)
def test_a_plane_is_seen_from_both_sides(name):
    camera = Camera(60, 60, 31.5, 31.5, 64, 64)
    for sign in (1, -1):
        pose = np.diag([1.0, sign, sign, 1.0])
        pose[2, 3] = 2
        depth, label = find_renderer(name).render_depth(solids_of([(PLANE, pose, np.zeros(3))]), camera, background=9)
        assert np.abs(depth - 2).max() < 1e-5 and (label == 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_nothing_and_what_is_behind_the_camera_give_the_background(name):
    camera = Camera(60, 60, 31.5, 31.5, 64, 64)
    behind = np.eye(4)
    behind[2, 3] = -1
    nothing = Solids(np.empty(0, np.int32), np.empty((0, 4, 4)), np.empty((0, 3)), np.empty(0, np.int32))
    for solids in (nothing, solids_of([(SPHERE, behind, [0.2] * 3)])):
        depth, label = find_renderer(name).render_depth(solids, camera, background=9.0)
        assert (depth == 9).all() and (label == -1).all()


@needs_opengl
def test_antialiasing_is_the_mean_of_the_samples():
    rng = np.random.default_rng(2)
    solids, camera = random_scene(rng, 4), CAMERAS[0]
    pyrender = find_renderer("pyrender")
    mean, _ = pyrender.render_depth(solids, camera, antialias=3, background=5.0)
    centre, label = pyrender.render_depth(solids, camera, background=5.0)
    sure = away_from_silhouettes(label, centre) & np.isin(solids.kind[label], (PLANE, BOX)) & (label >= 0)
    # On a plane the mean over a pixel differs from its centre by curvature alone: (pixel / z)^2, under 1 %.
    assert np.abs(mean - centre)[sure & (centre < 3)].max() < 5e-3
    edge = np.abs(mean - centre) > 0.05
    assert edge.any() and not edge[sure & (centre < 3)].any()


@needs_opengl
def test_a_kept_scene_forgets_what_was_drawn_before():
    """Scenes of other lengths, kinds and image sizes in between leave no trace."""
    rng = np.random.default_rng(3)
    pyrender = find_renderer("pyrender")
    scenes = [(random_scene(rng, count), CAMERAS[count % 3]) for count in (3, 6, 1, 4)]
    first = [pyrender.render_depth(*scene) for scene in scenes]
    for scene, (depth, label) in reversed(list(zip(scenes, first, strict=True))):
        again = pyrender.render_depth(*scene)
        assert np.array_equal(again[0], depth, equal_nan=True) and np.array_equal(again[1], label)


@pytest.mark.slow
@needs_opengl
def test_a_thousand_draws_leak_nothing():
    """Without the patch of GetCurrentContext each draw leaks 1.4 MB."""
    import resource

    rng = np.random.default_rng(4)
    solids = random_scene(rng, 4)
    pyrender = find_renderer("pyrender")
    for _ in range(20):
        pyrender.render_depth(solids, CAMERAS[1])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(1000):
        pyrender.render_depth(solids, CAMERAS[1])
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kilobytes


@pytest.mark.slow
@needs_opengl
@pytest.mark.skipif(os.environ.get("PYOPENGL_PLATFORM") == "egl", reason="is what is being tested")
def test_egl_draws_the_same_where_it_is_installed(tmp_path):
    import ctypes.util

    if not ctypes.util.find_library("EGL"):
        pytest.skip("EGL is not installed")
    code = """
import sys, numpy as np
from test_renderers import random_scene, CAMERAS
from derender.render.renderers import find_renderer
depth, label = find_renderer("pyrender").render_depth(random_scene(np.random.default_rng(5), 4), CAMERAS[0])
np.savez(sys.argv[1], depth=depth, label=label)
"""
    environment = os.environ | {"PYOPENGL_PLATFORM": "egl", "PYTHONPATH": os.path.dirname(__file__)}
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "egl.npz"], env=environment, capture_output=True, text=True, timeout=120
    )
    if done.returncode:
        pytest.skip(f"EGL is installed but draws nothing: {done.stderr.strip().splitlines()[-1][:100]}")
    solids = random_scene(np.random.default_rng(5), 4)
    depth, label = find_renderer("raycast").render_depth(solids, CAMERAS[0])
    with np.load(tmp_path / "egl.npz") as archive:
        sure = away_from_silhouettes(label, depth) & (label >= 0) & (depth < 4)
        assert sure.sum() > 3000
        assert np.array_equal(archive["label"][sure], label[sure])
        assert np.abs(archive["depth"] - depth)[sure].max() < 1e-4


@pytest.mark.parametrize("name", NAMES)
def test_the_picture_shows_each_solid_in_its_colour(name):
    rng = np.random.default_rng(6)
    solids, camera = random_scene(rng, 4), CAMERAS[0]
    renderer = find_renderer(name)
    colours = np.array([[200, 200, 200], [255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0]], dtype=np.uint8)
    picture = draw_preview(renderer.render_depth, solids, camera, colours)
    assert picture.shape == (120, 160, 3) and picture.dtype == np.uint8
    depth, label = renderer.render_depth(solids, camera)
    sure = away_from_silhouettes(label, depth)
    for index, colour in enumerate(colours[1:], start=1):
        seen = picture[sure & (label == index)].astype(float)
        if len(seen):
            assert (seen[:, colour > 0].min(axis=1) > seen[:, colour == 0].max(axis=1)).all()


def test_a_solids_colour_depends_on_where_it_is_and_not_on_its_place_in_a_file():
    solids = random_scene(np.random.default_rng(7), 5)
    order = np.random.default_rng(8).permutation(len(solids.kind))
    shuffled = Solids(*(array[order] for array in solids[:4]), solids.meshes)
    colours = default_colours(solids)
    assert np.array_equal(default_colours(shuffled), colours[order])
    assert len(np.unique(colours, axis=0)) == 6 and np.array_equal(colours[solids.kind == PLANE], [PLANE_COLOUR])


def test_the_sun_throws_a_shadow_beside_the_object_and_not_on_an_empty_floor():
    floor = np.array([[1, 0, 0, 0], [0, -0.5, -0.866, 0.1], [0, 0.866, -0.5, 0.9], [0, 0, 0, 1.0]])
    cube = floor.copy()
    cube[:3, 3] += 0.05 * floor[:3, 2]
    raycast = find_renderer("raycast")
    alone = draw_preview(raycast.render_depth, solids_of([(PLANE, floor, np.zeros(3))]), CAMERAS[0])
    both = solids_of([(PLANE, floor, np.zeros(3)), (BOX, cube, [0.1, 0.1, 0.1])])
    picture = draw_preview(raycast.render_depth, both, CAMERAS[0])
    _, label = raycast.render_depth(both, CAMERAS[0])
    darker = (label == 0) & (picture.mean(axis=2) < 0.8 * alone.mean(axis=2))
    assert 20 < darker.sum() < 0.2 * darker.size
    rows, columns = np.nonzero(label == 1)
    shadow_rows, shadow_columns = np.nonzero(darker)
    assert abs(shadow_rows.mean() - rows.mean()) < 40 and abs(shadow_columns.mean() - columns.mean()) < 40


def test_an_unknown_renderer_is_named():
    with pytest.raises(DerenderError, match="did you mean 'raycast'"):
        find_renderer("raycats")


def test_without_a_library_the_fault_says_what_to_install(monkeypatch):
    import ctypes.util

    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: None)
    with pytest.raises(DerenderError, match="apt-get install libosmesa6"):
        choose_platform()
