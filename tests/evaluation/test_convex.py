"""Volumes of intersections against closed forms and Monte Carlo."""

import numpy as np
import pytest

from derender.evaluation.convex import intersection_over_union, intersection_volume, volume_of
from derender.scene.pose import random_rotation, rotation_x, rotation_z, translation


def solid(kind, size, pose=None, **more):
    return {"name": kind, "type": kind, "size": size, "pose": np.eye(4) if pose is None else pose, **more}


def box_iou(pose_a, size_a, pose_b, size_b):
    return intersection_over_union(solid("box", size_a, pose_a), solid("box", size_b, pose_b))


def inside(item, points):
    local = (points - item["pose"][:3, 3]) @ item["pose"][:3, :3]
    size = np.asarray(item["size"])
    if item["type"] == "sphere":
        return np.linalg.norm(local, axis=1) <= size[0] / 2
    if item["type"] == "cylinder":
        return (np.hypot(local[:, 0], local[:, 1]) <= size[0] / 2) & (np.abs(local[:, 2]) <= size[2] / 2)
    return np.all(np.abs(local) <= size / 2, axis=1)


def test_aligned_boxes_have_the_product_of_their_overlaps():
    a, b = np.eye(4), translation(0.5, 0.25, 0.0)
    shared = 0.5 * 0.75 * 1.0
    assert box_iou(a, np.ones(3), b, np.ones(3)) == pytest.approx(shared / (2 - shared), rel=1e-12)


def test_turned_square_is_an_octagon():
    # Two unit squares at 45 degrees share a regular octagon of area 2 (sqrt 2 - 1).
    shared = intersection_volume(solid("box", [1, 1, 1]), solid("box", [1, 1, 3], rotation_z(np.pi / 4)))
    assert shared == pytest.approx(2 * (np.sqrt(2) - 1), rel=1e-12)


def test_equal_touching_and_nested_boxes():
    rng = np.random.default_rng(3)
    for _ in range(50):
        pose = translation(*rng.standard_normal(3)) @ random_rotation(rng)
        size = rng.uniform(0.04, 0.14, 3)
        assert box_iou(pose, size, pose, size) == pytest.approx(1, abs=1e-9)
        assert box_iou(pose, size, pose, 0.5 * size) == pytest.approx(1 / 8, rel=1e-9)
        assert box_iou(pose, size, pose @ translation(0, 0, size[2]), size) == pytest.approx(0, abs=1e-9)


def test_iou_does_not_change_with_order_frame_or_naming_of_axes():
    rng = np.random.default_rng(4)
    swap = np.eye(4)[[1, 2, 0, 3]]
    for _ in range(50):
        a, b = (translation(*rng.normal(0, 0.01, 3)) @ random_rotation(rng) for _ in range(2))
        size_a, size_b = rng.uniform(0.04, 0.14, (2, 3))
        world = translation(*rng.standard_normal(3)) @ random_rotation(rng)
        value = box_iou(a, size_a, b, size_b)
        assert 0 < value < 1
        assert box_iou(b, size_b, a, size_a) == pytest.approx(value, rel=1e-9)
        assert box_iou(world @ a, size_a, world @ b, size_b) == pytest.approx(value, rel=1e-9)
        assert box_iou(a @ swap, size_a[[2, 0, 1]], b, size_b) == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize(
    "kinds", [("box", "box"), ("box", "cylinder"), ("sphere", "cylinder"), ("cylinder", "cylinder"), ("sphere", "box")]
)
def test_against_monte_carlo(kinds):
    rng = np.random.default_rng(5)
    count = 200_000
    for _ in range(6):
        pair = []
        for kind in kinds:
            size = rng.uniform(0.08, 0.14, 3)
            size = {"sphere": [size[0]] * 3, "cylinder": [size[0], size[0], size[2]]}.get(kind, size)
            pair.append(solid(kind, np.asarray(size), translation(*rng.normal(0, 0.02, 3)) @ random_rotation(rng)))
        points = rng.uniform(-0.2, 0.2, (count, 3))
        share = np.mean(inside(pair[0], points) & inside(pair[1], points))
        expected, spread = share * 0.4**3, np.sqrt(share * (1 - share) / count) * 0.4**3
        # Five standard errors of the sample, and the half percent by which a polyhedron stands for a round solid.
        round_solids = 0.005 * expected if kinds != ("box", "box") else 0
        assert intersection_volume(*pair) == pytest.approx(expected, abs=5 * spread + round_solids)


def test_round_solids():
    a, b = solid("sphere", [0.1] * 3), solid("sphere", [0.1] * 3, translation(0.05, 0, 0))
    # Two balls of radius r at distance r share 5 pi r^3 / 12.
    assert intersection_volume(a, b) == pytest.approx(5 * np.pi * 0.05**3 / 12, rel=0.005)
    rng = np.random.default_rng(6)
    cylinder = solid("cylinder", [0.06, 0.06, 0.2], random_rotation(rng))
    turned = cylinder["pose"] @ rotation_z(np.deg2rad(31)) @ rotation_x(np.pi)
    same = solid("cylinder", [0.06, 0.06, 0.2], turned)
    # Turned about its axis and upside down it is the same solid; nothing of the prism's sides may show.
    assert intersection_over_union(cylinder, same) == pytest.approx(1, abs=1e-6)
    # Inside a box both have their own volumes.
    box = solid("box", [1, 1, 1])
    for item in (cylinder, a):
        assert intersection_volume(item, box) == pytest.approx(volume_of(item), rel=1e-6)


def test_hull_of_vertices():
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.05
    hull = solid("mesh", [0.1] * 3, vertices=corners)
    assert volume_of(hull) == pytest.approx(1e-3, rel=1e-9)
    assert intersection_over_union(hull, solid("box", [0.1, 0.1, 0.05])) == pytest.approx(0.5, rel=1e-9)
    octahedron = solid("mesh", [2, 2, 2], vertices=np.vstack([np.eye(3), -np.eye(3)]))
    assert volume_of(octahedron) == pytest.approx(4 / 3, rel=1e-9)


def test_far_apart_share_nothing():
    assert intersection_volume(solid("box", [1, 1, 1]), solid("sphere", [1] * 3, translation(0, 0, 5))) == 0


def test_solids_whose_faces_all_but_coincide_are_compared(monkeypatch):
    """Qhull gave up on two free-form things that were nearly the same, and `derender eval` with it."""
    import scipy.spatial

    halfspaces = scipy.spatial.HalfspaceIntersection

    def strict(planes, inside, qhull_options=None):
        if qhull_options is None:
            raise scipy.spatial.QhullError("precision error")
        return halfspaces(planes, inside, qhull_options=qhull_options)

    monkeypatch.setattr(scipy.spatial, "HalfspaceIntersection", strict)
    assert box_iou(np.eye(4), np.ones(3), translation(0.5, 0.0, 0.0), np.ones(3)) == pytest.approx(1.0 / 3.0, rel=1e-6)
