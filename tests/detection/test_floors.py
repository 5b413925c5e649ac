"""Which plane is the floor where several might be, and lengths that follow how far away it is."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from table_scenes import CAMERA, SIGMA, TABLE

from derender.camera.intrinsics import LEVEL, Camera
from derender.detection.estimate import point_estimate
from derender.detection.floors import find_backdrop, find_floor, floors_of
from derender.detection.search.greedy import Settings
from derender.detection.search.observation import CORRELATED, Rival, observe
from derender.detection.solids.beliefs import bare_image
from derender.render.raycast.depth import render_depth
from derender.scene.priors.bare_image import Floors, Missed
from derender.scene.solids import BOX, PLANE, Solids
from derender.structures.answer import missed_by
from worlds.frontier_scenes import KINDS, make

WIDE = Camera(150.0, 150.0, 79.5, 59.5, 160, 120)
TILT = np.radians(35.0)
DOWN = np.array([0.0, np.cos(TILT), np.sin(TILT)])  # in the axes of a camera that looks down by TILT


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def plane_depth(normal, offset):
    """Return the depth (H, W) of the plane n . x = offset, NaN where no ray meets it."""
    along = WIDE.rays() @ normal
    with np.errstate(divide="ignore"):
        depth = offset / along
    return np.where(depth > 0.0, depth, np.nan)


def smooth_noise(rng, sigma):
    """Return noise (H, W) in metres that neighbours share, as a sensor's do."""
    white = rng.standard_normal((124, 164))
    rows = sum(white[k : k + 120] for k in range(5))
    return sigma / 5.0 * sum(rows[:, k : k + 160] for k in range(5))


@pytest.mark.parametrize("turns", range(4))
def test_a_table_before_a_wall_is_the_floor_however_the_image_is_turned(rng, turns):
    """The wall fills a quarter of the image, and in an image upside down it is what faces its upper edge more."""
    wall = plane_depth(np.array([0.0, -np.sin(TILT), np.cos(TILT)]), 1.3)
    depth = np.fmin(plane_depth(DOWN, 0.5), wall) + 0.001 * rng.standard_normal(wall.shape)
    assert 0.1 < np.mean(depth > wall - 0.005) < 0.3
    normal, turned = -DOWN, depth
    for _ in range(turns):
        normal, turned = normal[[1, 0, 2]] * [1, -1, 1], np.rot90(turned)
    camera = Camera(150.0, 150.0, 0.5 * (turned.shape[1] - 1), 0.5 * (turned.shape[0] - 1), *turned.shape[::-1])
    assert find_floor(turned, camera).pose[:3, 2] @ normal > 0.999


def test_of_a_room_that_a_level_camera_sees_the_floor_is_the_little_at_the_bottom(rng):
    """The wall opposite fills most of the image, a cupboard the side of it, the floor a twentieth."""
    wall, side = plane_depth(np.array([0.0, 0.0, 1.0]), 2.4), plane_depth(np.array([1.0, 0.0, 0.05]), 0.9)
    floor = plane_depth(np.array([0.0, 1.0, 0.02]), 0.9)
    depth = np.fmin(np.fmin(wall, side), floor)
    assert 0.03 < np.mean(depth == floor) < 0.06
    found = find_floor(depth + 0.003 * depth**2 * rng.standard_normal(depth.shape), WIDE)
    assert found.pose[:3, 2] @ [0.0, -1.0, -0.02] > LEVEL


def seen_at(scale):
    """Return (Observation, label (H, W)) of a carton on a table and a long box beside, all so many times as large."""
    boxes = [((0.0, 0.0, 0.06), (0.1, 0.08, 0.12)), ((-0.42, 0.2, 0.15), (0.05, 0.8, 0.3))]
    poses, table = [], TABLE.copy()
    table[:3, 3] *= scale
    for centre, _ in boxes:
        pose = np.eye(4)
        pose[:3, 3] = scale * np.array(centre)
        poses.append(table @ pose)
    sizes = np.array([np.zeros(3), *(size for _, size in boxes)]) * scale
    kinds = np.array([PLANE, BOX, BOX], np.int32)
    scene = Solids(kinds, np.array([table, *poses]), sizes, np.full(3, -1, np.int32))
    depth, label = render_depth(scene, CAMERA)
    return observe(depth + scale * SIGMA * np.random.default_rng(0).standard_normal(depth.shape), CAMERA), label


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.35])
def test_what_is_long_shrinks_with_the_distance(scale):
    seen, label = seen_at(scale)
    assert seen.mask[label == 1].mean() > 0.9
    assert seen.mask[label == 2].mean() < 0.1


@pytest.fixture
def corner(rng):
    """Two planes that share the image: one faces its upper edge, the other, three times as large, its side."""
    upright = plane_depth(np.array([0.0, 0.7, 0.714]), 0.75)
    aside = plane_depth(np.array([0.7, 0.0, 0.714]), 0.62)
    return np.fmin(upright, aside) + smooth_noise(rng, 0.001)


def test_planes_that_are_close_are_rivals_and_lower_what_is_said(corner):
    candidates = floors_of(corner, WIDE)
    assert len(candidates) == 2 and abs(candidates[0].normal @ candidates[1].normal) < 0.9
    seen = observe(corner, WIDE)
    assert seen.correlation > CORRELATED
    (rival,) = seen.rivals
    assert 0.01 < rival.probability < 0.5
    assert abs(np.dot(rival.plane[:3], seen.floor.pose[:3, 2])) < 0.9


@pytest.mark.parametrize("lower, rivals", [(0.3, 1), (0.7, 0)])
def test_the_rooms_floor_below_a_table_is_there_too_and_no_rival(rng, lower, rivals):
    depth = plane_depth(DOWN, 0.5)
    depth[:, 90:] = plane_depth(DOWN, 0.5 + lower)[:, 90:]
    seen = observe(depth + smooth_noise(rng, 0.001), WIDE)
    assert -seen.floor.pose[:3, 3] @ seen.floor.pose[:3, 2] == pytest.approx(0.5, abs=0.01)
    assert len(seen.rivals) == 1 and len(seen.other_floors) == rivals


@pytest.mark.parametrize("way", [-1.0, 1.0])
def test_a_wall_on_which_much_hangs_is_no_likelier_floor_than_the_floor_before_it(rng, way):
    """A camera held level, turned aside from the wall, shows it in most of the image, with what stands out."""
    floor = plane_depth(np.array([0.0, 0.998, 0.06]), 0.8)
    wall = plane_depth(np.array([0.3 * way, -0.06, 0.95]), 1.9)
    wall[20:80, 30:70] -= 0.15
    wall[30:90, 90:130] -= 0.12
    depth = np.fmin(wall, floor)
    assert 0.05 < np.mean(depth == floor) < 0.12
    seen = observe(depth + smooth_noise(rng, 0.003), WIDE)
    assert seen.floor.pose[:3, 2] @ [0.0, -1.0, -0.06] > LEVEL


def test_a_plane_alone_has_no_rivals(rng):
    assert len(floors_of(plane_depth(DOWN, 0.5) + smooth_noise(rng, 0.001), WIDE)) == 1


def test_what_may_stand_on_another_floor_may_be_missed():
    seen = SimpleNamespace(correlation=0.0, agreed=True, no_floor=False, other_floors=(), behind=np.zeros(4, bool),
                           floor=SimpleNamespace(inliers=np.ones(4, bool)))  # fmt: skip
    missed = Missed()
    alone = missed_by([seen], {}, missed, 1.0)
    seen.other_floors = (Rival((0.0, -1.0, 0.0, 0.5), 0.3),)
    assert 1.0 - missed_by([seen], {}, missed, 1.0) == pytest.approx(0.7 * (1.0 - alone))


@pytest.mark.parametrize("number", [1307, 1312, 1321])
def test_tables_at_two_heights_and_the_room_below_speak_for_one_another_against_a_large_wall(number):
    scene = make(np.random.default_rng([number, list(KINDS).index("heights")]), "heights")
    seen = observe(scene.depth, scene.camera)
    assert seen.floor.pose[:3, 2] @ scene.tables["floor"][:3, 2] > LEVEL


def test_the_odds_of_floors_are_those_of_the_file(rng):
    """Of the camera's height and how it is held, and that there is one at all."""
    image = plane_depth(DOWN[[1, 0, 2]], 0.5) + smooth_noise(rng, 0.001)  # a camera on its side
    usual = floors_of(image, WIDE)[0].odds
    assert floors_of(image, WIDE, believed=Floors(aside=1.0))[0].odds == pytest.approx(usual - np.log(Floors().aside))
    nearer = floors_of(image, WIDE, believed=Floors(height=0.5, spread=1.5))[0].odds
    assert nearer == pytest.approx(usual + 0.5 * (np.log(0.7 / 0.5) / np.log(2.0)) ** 2, abs=0.01)
    loose = bare_image().loose
    none = Settings(beliefs=bare_image()._replace(loose=replace(loose, floor=replace(loose.floor, none=1.0))))
    assert point_estimate(rng, image, WIDE, none)[1].no_floor and not point_estimate(rng, image, WIDE)[1].no_floor


def test_a_backdrop_reaches_three_sides_of_the_image():
    depth = np.random.default_rng(0).normal(1.0, 0.001, (48, 64))
    depth[16:32, 20:44] = 0.8  # a solid before it
    camera = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
    plane, beyond = find_backdrop(depth, camera)
    assert plane.pose[:3, 2] == pytest.approx([0.0, 0.0, -1.0], abs=0.02)
    assert beyond.mean() > 0.85 and not beyond[16:32, 20:44].any()
    island = np.full(depth.shape, np.nan)
    island[10:40, 12:52] = depth[10:40, 12:52]
    assert find_backdrop(island, camera) is None
    assert find_backdrop(np.full(depth.shape, np.nan), camera) is None
