"""Images that are hard to like: each is explained, or answered in one line."""

from itertools import islice

import numpy as np
import pytest

from derender.camera.intrinsics import Camera
from derender.detection.floor import read_floor
from derender.detection.pyramid import reduce
from derender.detection.search import observation
from derender.document import read_prior_document
from derender.errors import DerenderError
from derender.posterior.forward import draw_documents
from derender.render.raycast.depth import render_depth
from derender.scene.pose import rotation_x, rotation_y, rotation_z, translation
from derender.structures.infer import infer_structure
from derender.structures.options import Options
from worlds.made_scenes import camera_of, kinect_noise, render_floor_scene

SIZES = np.array([[0.1, 0.08, 0.06], [0.07, 0.07, 0.12]])
POSES = np.stack([translation(-0.06, 0, 0.03) @ rotation_z(0.3), translation(0.09, 0.04, 0.06) @ rotation_z(0.9)])


def floor_pose(distance=0.8, elevation=35.0, roll=0.0):
    """Return the pose (4, 4) of a floor, z up, whose origin the camera looks at from this height, rolled."""
    pose = rotation_x(np.pi / 2 + np.radians(elevation))
    pose[:3, 3] = [0.0, 0.0, distance]
    return rotation_z(np.radians(roll)) @ pose


def picture(floor, width=160, height=120, count=2, noise=0.001, factor=0.87):
    """Return depth (H, W) of the first `count` boxes on a floor with noise, and the camera."""
    camera = Camera(factor * width, factor * width, (width - 1) / 2, (height - 1) / 2, width, height)
    poses = floor @ POSES[:count] if count else np.zeros((0, 4, 4))
    depth, _ = render_floor_scene(["box"] * count, poses, SIZES[:count], floor, camera)
    depth = np.where(depth > 5, np.nan, depth)
    return depth + noise * np.random.default_rng(0).normal(size=depth.shape), camera


def answer(depth, camera, **options):
    """Return the best graph of a quick inference."""
    return infer_structure(
        depth, camera, Options(**{"method": "map", **options}), np.random.default_rng(0)
    ).best_graph()


def solids(graph):
    """Return the sorted sizes of the solids, largest volume first."""
    found = [np.sort(v.body.size()) for v in graph.vertices if v.shape != "plane"]
    return sorted(found, key=lambda size: -np.prod(size))


def assert_both_boxes(graph, tolerance=0.008):
    found = solids(graph)
    assert len(found) == 2
    truth = sorted((np.sort(s) for s in SIZES), key=lambda size: -np.prod(size))
    assert np.abs(np.array(found) - np.array(truth)).max() < tolerance


@pytest.mark.parametrize("rounding", [None, 3], ids=["floats", "whole millimetres"])
def test_a_rendering_without_noise_hides_no_solid(rounding, monkeypatch):
    """A cube of 5 cm, also where the image's rounding passes for a sensor's bends."""
    scene = next(islice(draw_documents(read_prior_document("tabletop"), 8, 100, {}), 7, None))
    depth, _ = render_depth(scene.graph.solids(), scene.camera)
    depth = depth if rounding is None else np.round(depth, rounding)
    assert answer(depth, scene.camera).names == ("floor", "cube_1")
    monkeypatch.setattr(observation, "drawn", lambda *_: False)
    assert len(answer(depth, scene.camera).names) == 2  # taken for a sensor's, it is there all the same


def test_an_empty_table_is_a_floor_alone():
    depth, camera = picture(floor_pose(), count=0)
    graph = answer(depth, camera)
    assert [v.shape for v in graph.vertices] == ["plane"]
    assert graph.down() == pytest.approx(-floor_pose()[:3, 2], abs=0.01)


def test_a_wall_alone_is_a_plane_before_the_camera():
    depth = 1.5 + 0.002 * np.random.default_rng(0).normal(size=(120, 160))
    graph = answer(depth, Camera(140.0, 140.0, 79.5, 59.5, 160, 120))
    assert [v.shape for v in graph.vertices] == ["plane"]
    assert graph.poses()["floor"][:3, 3] @ graph.down() == pytest.approx(1.5, abs=0.01)


@pytest.mark.parametrize("roll", [90.0, 180.0])
def test_a_rolled_camera_changes_nothing(roll):
    floor = floor_pose(roll=roll)
    depth, camera = picture(floor)
    graph = answer(depth, camera)
    assert_both_boxes(graph)
    assert graph.down() == pytest.approx(-floor[:3, 2], abs=0.01)


def test_a_floor_seen_from_straight_above():
    depth, camera = picture(floor_pose(elevation=89.9))
    assert_both_boxes(answer(depth, camera))


def test_one_object_that_fills_the_image():
    floor = floor_pose(distance=0.2) @ translation(0.06, 0.0, -0.03)  # the box's middle is looked at
    depth, camera = picture(floor, 80, 60, count=1)
    near = depth < np.nanquantile(depth, 0.5)
    assert near.mean() > 0.4
    found = solids(answer(depth, camera))
    assert len(found) == 1 and np.abs(found[0] - np.sort(SIZES[0])).max() < 0.015


@pytest.mark.slow
def test_large_images_in_millimetres_with_holes():
    depth, camera = picture(floor_pose(), 640, 480)
    depth = np.round(depth, 3)
    depth[np.random.default_rng(1).random(depth.shape) < 0.4] = np.nan
    assert_both_boxes(answer(depth, camera))


def test_a_tiny_image():
    depth, camera = picture(floor_pose(), 32, 24)  # each box has about ten pixels: it may be missed
    graph = answer(depth, camera)
    assert len(solids(graph)) <= 2
    assert graph.down() == pytest.approx(-floor_pose()[:3, 2], abs=0.02)


def test_noise_is_one_clear_line():
    depth = np.random.default_rng(0).uniform(0.5, 2.0, (120, 160))
    with pytest.raises(DerenderError, match="plane"):
        answer(depth, Camera(140.0, 140.0, 79.5, 59.5, 160, 120))


def test_a_given_floor_is_taken_as_it_is():
    floor = floor_pose()
    normal = floor[:3, 2]
    plane = [*normal, -normal @ floor[:3, 3]]
    depth, camera = picture(floor)
    for sign in (1, -1):  # whichever way the normal points
        graph = answer(depth, camera, floor=",".join(str(sign * x) for x in plane))
        assert_both_boxes(graph)
        assert graph.down() == pytest.approx(-normal, abs=1e-3)


@pytest.mark.slow
def test_without_a_floor_nothing_rests():
    depth, camera = picture(floor_pose())
    above = picture(floor_pose(), noise=0.0)[0] < picture(floor_pose(), count=0, noise=0.0)[0] - 0.003
    graph = answer(np.where(above, depth, np.nan), camera, floor="none")
    assert "plane" not in {v.shape for v in graph.vertices}
    assert len(solids(graph)) == 2
    assert "root" in {v.parent for v in graph.vertices}


@pytest.mark.parametrize("floor", ["flat", "1,2,3", "0,0,0,1", "nan,0,1,1"])
def test_a_floor_that_is_none_is_one_clear_line(floor):
    with pytest.raises(DerenderError, match="--floor.*a,b,c,d"):
        read_floor(floor)


def test_a_floor_far_from_every_point_is_one_clear_line():
    depth, camera = picture(floor_pose())
    with pytest.raises(DerenderError, match="2 cm of the floor given"):
        answer(depth, camera, floor="0,1,0,-9")


@pytest.mark.parametrize("kind", ["box", "cylinder"])
def test_two_ends_that_show_on_either_side_of_something_are_of_one_solid(kind):
    camera = Camera(140.0, 140.0, 79.5, 59.5, 160, 120)
    floor = floor_pose()
    lying = translation(0.0, 0.06, 0.03) @ rotation_y(np.pi / 2)
    poses = floor @ np.stack([lying, translation(0.0, -0.06, 0.11)])
    sizes = np.array([[0.06, 0.06, 0.26], [0.1, 0.05, 0.22]])
    depth, label = render_floor_scene([kind, "box"], poses, sizes, floor, camera)
    depth[depth > 5] = np.nan
    middle = np.flatnonzero((label == 0).any(axis=0))
    assert np.diff(middle).max() > 15  # columns that the post hides from top to bottom
    depth += 0.001 * np.random.default_rng(0).normal(size=depth.shape)
    found = solids(answer(depth, camera))
    assert len(found) == 2
    assert found[1] == pytest.approx([0.06, 0.06, 0.26], abs=0.01)  # a row of pixels on its top is as wide


def test_a_reduced_image_is_that_of_the_camera_that_goes_with_it():
    """Also where pixels are lost at edges and depths are counted in whole millimetres."""
    camera = camera_of(640, 480)
    floor = floor_pose()
    depth, label = render_floor_scene(["box"] * 2, floor @ POSES, SIZES, floor, camera)
    seen, small, factor = reduce(kinect_noise(np.random.default_rng(0), depth, label).round(3), camera, 160)
    ideal, _ = render_floor_scene(["box"] * 2, floor @ POSES, SIZES, floor, small)
    off = np.abs(seen - ideal)
    assert factor == 4 and np.isnan(seen).mean() < 1e-3
    assert np.median(off) < 0.0006  # 16 pixels of 1.5 mm noise
    assert np.mean(off > 0.01) < 0.003  # hardly a pixel takes the other side of an edge


@pytest.mark.parametrize("width", [320, 480, 640])
def test_a_reduced_sharp_image_has_its_edges_where_the_small_camera_sees_them(width):
    """The median of four pixels is on the far side of two against two: solids would shrink by half a pixel."""
    camera, floor = camera_of(width, width * 3 // 4), floor_pose()
    depth, _ = render_floor_scene(["box"] * 2, floor @ POSES, SIZES, floor, camera)
    seen, small, _ = reduce(depth, camera, 160)
    ideal, _ = render_floor_scene(["box"] * 2, floor @ POSES, SIZES, floor, small)
    assert np.sum(np.abs(seen - ideal) > 0.01) <= 1  # at an edge of little depth, which a plane may cross


@pytest.mark.slow
def test_without_a_floor_a_table_that_fills_the_image_is_background():
    depth, camera = picture(floor_pose())
    posterior = infer_structure(depth, camera, Options(method="map", floor="none"), np.random.default_rng(0))
    graph = posterior.best_graph()
    assert posterior.meta["backdrop"] > 0.5
    assert "floor" not in graph.names
    found = solids(graph)
    assert len(found) == 2
    for size in SIZES:  # how far they reach down does not show
        assert min(np.abs(np.sort(size[:2]) - np.delete(each, k)).max() for each in found for k in range(3)) < 0.005


@pytest.mark.slow
@pytest.mark.parametrize("place", [{"distance": 0.9, "elevation": 20.0}, {"distance": 1.0, "elevation": 89.9}])
def test_a_large_image_of_a_rough_sensor_shows_whole_solids(place):
    """A wall 4 m away, of which the sensor's likelihood would know nothing; from above, edges would cut boxes."""
    floor, camera = floor_pose(**place), camera_of(640, 480)
    depth, label = render_floor_scene(["box"] * 2, floor @ POSES, SIZES, floor, camera)
    depth = kinect_noise(np.random.default_rng(0), np.minimum(np.nan_to_num(depth, nan=4.0), 4.0), label)
    options = Options(chains=1, draws=5)
    assert_both_boxes(infer_structure(depth.round(3), camera, options, np.random.default_rng(1)).best_graph())


def before_walls(*walls):
    """Return depth (H, W) and camera of both boxes before walls (metres behind the middle, turned about it)."""
    _, camera = picture(floor_pose(), count=0)
    floor = floor_pose(elevation=25.0)
    upright = [floor @ rotation_z(turn) @ translation(0.0, distance + 0.025, 1.0) for distance, turn in walls]
    sizes = [*SIZES, *[np.array([8.0, 0.05, 4.0])] * len(walls)]
    poses = np.stack([*(floor @ POSES), *upright])
    depth, _ = render_floor_scene(["box"] * len(sizes), poses, np.array(sizes), floor, camera)
    return depth + 0.001 * np.random.default_rng(0).normal(size=depth.shape), camera


@pytest.mark.parametrize("walls", [[(0.2, 0.0)], [(0.35, 0.3)], [(0.4, 0.7), (0.4, -0.8)]],
                         ids=["near", "oblique", "corner"])  # fmt: skip
def test_a_wall_behind_the_objects_is_no_object(walls):
    depth, camera = before_walls(*walls)
    assert_both_boxes(answer(depth, camera))


@pytest.mark.slow
def test_a_wide_box_with_floor_behind_it_is_no_wall():
    floor = floor_pose(distance=1.5, elevation=30.0)
    size = np.array([0.7, 0.4, 0.3])
    _, camera = picture(floor, count=0)
    depth, _ = render_floor_scene(["box"], (floor @ translation(0, 0, 0.15))[None], size[None], floor, camera)
    found = solids(answer(depth + 0.001 * np.random.default_rng(0).normal(size=depth.shape), camera))
    assert len(found) == 1
    assert np.abs(found[0] - np.sort(size)).max() < 0.015
