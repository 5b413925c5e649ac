"""Matching, F1, edges and errors on scenes whose answers are known by construction."""

import numpy as np
import pytest

from derender.evaluation.convex import distance_to_surface, surface_points
from derender.evaluation.metrics import (
    add_s,
    assign,
    compare_scenes,
    edges_of,
    mask_f1,
    match_planes,
    pose_and_size_errors,
    relabellings,
)


def turn(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation[i, i], rotation[i, j], rotation[j, i], rotation[j, j] = c, -s, s, c
    return rotation


def pose_of(x=0.0, y=0.0, z=0.0, rotation=None):
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    if rotation is not None:
        pose[:3, :3] = rotation
    return pose


def box(name, size, pose, parent="floor", kind="box", **more):
    return {"name": name, "type": kind, "size": list(size), "pose": pose.tolist(), "parent": parent, **more}


def floor(name="floor", pose=None):
    return {
        "name": name,
        "type": "plane",
        "size": None,
        "pose": (np.eye(4) if pose is None else pose).tolist(),
        "parent": "root",
    }


def scene(*objects):
    return {"frame": "camera", "gravity": [0, 0, -1], "objects": list(objects)}


TRUTH = scene(
    floor(),
    box("a", (0.1, 0.1, 0.1), pose_of(z=0.05), kind="cube"),
    box("b", (0.1, 0.06, 0.04), pose_of(z=0.12), "a"),
    box("c", (0.1, 0.06, 0.04), pose_of(0.4, z=0.02)),
)


def test_truth_against_itself_is_perfect():
    result = compare_scenes(TRUTH, TRUTH)
    assert result["graph_exact"] is True
    assert result["edges"]["f1"] == 1 and result["edges"]["truth"] == 3
    assert [result["objects"][t]["f1"] for t in ("0.5", "0.75", "0.9")] == [1, 1, 1]
    for pair in result["pairs"]:
        assert max(pair["position"], pair["rotation"], pair["add_s"], *map(abs, pair["size"])) < 1e-9


def test_names_of_the_prediction_do_not_matter_but_parents_do():
    renamed = scene(
        floor("table"),
        box("one", (0.1, 0.1, 0.1), pose_of(z=0.05), "table"),
        box("two", (0.1, 0.06, 0.04), pose_of(z=0.12), "one"),
        box("three", (0.1, 0.06, 0.04), pose_of(0.4, z=0.02), "table"),
    )
    assert compare_scenes(renamed, TRUTH)["graph_exact"] is True
    renamed["objects"][2]["parent"] = "table"
    result = compare_scenes(renamed, TRUTH)
    assert result["graph_exact"] is False
    assert result["edges"]["f1"] == pytest.approx(2 / 3)
    assert result["objects"]["0.9"]["f1"] == 1


def test_a_floating_object_has_no_edge_and_costs_recall_only():
    floating = scene(*TRUTH["objects"][:3], box("c", (0.1, 0.06, 0.04), pose_of(0.4, z=0.02), "root"))
    result = compare_scenes(floating, TRUTH)
    assert result["edges"]["precision"] == 1
    assert result["edges"]["recall"] == pytest.approx(2 / 3)
    assert result["graph_exact"] is False


def test_a_wrong_floor_makes_its_edges_wrong():
    lower = scene(floor(pose=pose_of(z=-0.05)), *TRUTH["objects"][1:])
    assert match_planes(lower, TRUTH) == {}
    assert compare_scenes(lower, TRUTH)["edges"]["hits"] == 1


def test_second_supports_are_edges():
    bridge = scene(floor(), box("d", (0.1, 0.1, 0.1), pose_of(), "a", supports=["c"]))
    assert edges_of(bridge) == {("d", "a"), ("d", "c")}
    assert edges_of({"objects": [{"name": "x", "type": "box", "size": [1, 1, 1], "pose": np.eye(4)}]}) is None


def test_missed_and_invented_objects():
    fewer = scene(*TRUTH["objects"][:3], box("ghost", (0.1, 0.1, 0.1), pose_of(-1, z=0.05)))
    result = compare_scenes(fewer, TRUTH)
    assert result["missed"] == ["c"] and result["extra"] == ["ghost"]
    assert result["objects"]["0.5"]["f1"] == pytest.approx(2 * 2 / (3 + 3))
    spared = compare_scenes(fewer, TRUTH, ignored={"c"})
    assert spared["missed"] == [] and spared["objects"]["0.5"]["recall"] == 1
    # Finding an object that need not be found is no fault either.
    assert compare_scenes(TRUTH, TRUTH, ignored={"c"})["graph_exact"] is True
    assert compare_scenes(TRUTH, TRUTH, ignored={"c"})["objects"]["0.5"]["predicted"] == 2


def test_thresholds_are_on_iou():
    taller = scene(floor(), box("a", (0.1, 0.1, 0.16), pose_of(z=0.08)))
    result = compare_scenes(taller, scene(floor(), TRUTH["objects"][1]))
    assert result["pairs"][0]["iou"] == pytest.approx(0.1 / 0.16)
    assert [result["objects"][t]["hits"] for t in ("0.5", "0.75", "0.9")] == [1, 0, 0]


def test_assignment_prefers_more_pairs_to_more_overlap():
    # Greedy would take the .9 and leave the second object alone.
    assert sorted(assign(np.array([[0.9, 0.6], [0.6, 0.0]]), 0.5)) == [(0, 1), (1, 0)]
    assert assign(np.zeros((0, 3)), 0.5) == []


def test_rotation_error_is_up_to_the_symmetry_of_the_shape():
    cases = [
        ("cube", (0.1, 0.1, 0.1), turn(0, np.pi / 2) @ turn(2, np.pi / 2)),
        ("box", (0.1, 0.06, 0.04), turn(1, np.pi)),
        ("cylinder", (0.1, 0.1, 0.2), turn(2, 1.234)),
        ("cylinder", (0.1, 0.1, 0.2), turn(0, np.pi)),
        ("sphere", (0.1, 0.1, 0.1), turn(0, 1.0) @ turn(1, 0.5)),
    ]
    tilt = turn(0, 0.1)
    for kind, size, symmetry in cases:
        base = turn(0, 0.7) @ turn(1, 0.3)
        truth = box("t", size, pose_of(rotation=base), kind=kind)
        same = box("p", size, pose_of(rotation=base @ symmetry), kind=kind)
        assert pose_and_size_errors(same, truth)["rotation"] == pytest.approx(0, abs=1e-7)
        tilted = box("p", size, pose_of(rotation=base @ tilt @ symmetry), kind=kind)
        expected = 0 if kind == "sphere" else 0.1
        assert pose_and_size_errors(tilted, truth)["rotation"] == pytest.approx(expected, abs=1e-7)
    # A quarter turn is no symmetry of a box of three lengths: broken twin of the above.
    wrong = box("p", (0.1, 0.06, 0.04), pose_of(rotation=turn(0, np.pi / 2)))
    errors = pose_and_size_errors(wrong, box("t", (0.1, 0.06, 0.04), pose_of()))
    assert errors["rotation"] > 1 or max(np.abs(errors["size"])) > 0.01


def test_size_error_follows_the_naming_of_axes():
    truth = box("t", (0.10, 0.06, 0.04), pose_of())
    renamed = box("p", (0.06, 0.105, 0.04), pose_of(rotation=turn(2, np.pi / 2)))
    errors = pose_and_size_errors(renamed, truth)
    assert errors["rotation"] == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(errors["size"], [0.005, 0, 0], atol=1e-12)


def test_relabellings_name_the_same_box():
    size = np.array([0.1, 0.06, 0.04])
    corners = {
        tuple(np.round(sign * size / 2, 9))
        for sign in np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).T.reshape(-1, 3)
    }
    ways = relabellings(size)
    assert len(ways) == 24
    for rotation, named in ways:
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).T.reshape(-1, 3)
        assert {tuple(np.round(rotation @ (sign * named / 2), 9)) for sign in signs} == corners


@pytest.mark.parametrize(
    ("kind", "size"), [("box", (0.1, 0.06, 0.04)), ("cylinder", (0.06, 0.06, 0.1)), ("sphere", (0.1,) * 3)]
)
def test_surface_points_are_on_the_surface_and_even(kind, size):
    item = box("x", size, pose_of(0.1, 0.2, 0.3, turn(0, 0.4)), kind=kind)
    points = surface_points(item)
    assert distance_to_surface(points, item).max() < 1e-12
    assert 700 < len(points) < 1400
    local = (points - np.asarray(item["pose"])[:3, 3]) @ np.asarray(item["pose"])[:3, :3]
    # Evenly spread: the moments of the surface about its centre, E[z^2], known in closed form for each.
    a, b, c = size
    expected = {
        "box": (a * b * c**2 / 4 * 2 + 2 * (a + b) * c**3 / 12) / (2 * (a * b + b * c + c * a)),
        "cylinder": (2 * np.pi * a**2 / 4 * c**2 / 4 + np.pi * a * c**3 / 12) / (2 * np.pi * a**2 / 4 + np.pi * a * c),
        "sphere": a**2 / 12,
    }[kind]
    assert np.mean(local[:, 2] ** 2) == pytest.approx(expected, rel=0.05)


def test_distance_to_surface_inside_and_outside():
    item = box("x", (0.2, 0.2, 0.2), pose_of())
    points = np.array([[0, 0, 0], [0.2, 0, 0], [0.2, 0.2, 0.1], [0.09, 0, 0]])
    np.testing.assert_allclose(distance_to_surface(points, item), [0.1, 0.1, np.sqrt(0.02), 0.01], atol=1e-12)


def test_add_s_of_a_shifted_and_of_a_grown_sphere():
    truth = box("t", (0.1,) * 3, pose_of(), kind="sphere")
    grown = box("p", (0.12,) * 3, pose_of(rotation=turn(0, 1.0)), kind="sphere")
    assert add_s(grown, truth) == pytest.approx(0.01, abs=1e-12)
    # Far smaller than the radius, a shift d moves the surface by d |cos|, whose mean over the sphere is d / 2.
    shifted = box("p", (0.1,) * 3, pose_of(0.0005), kind="sphere")
    assert add_s(shifted, truth) == pytest.approx(0.00025, rel=0.02)


def test_mask_f1():
    truth = np.zeros((10, 20), int)
    truth[2:6, 2:6], truth[2:6, 10:14], truth[8:] = 2, 3, 1
    said = np.full((10, 20), -1)
    said[2:6, 2:6], said[2:6, 10:12] = 7, 8
    result = mask_f1(said, truth, background=(0, 1))
    assert result["pairs"] == {7: 2, 8: 3}
    assert result["iou"] == {7: 1.0, 8: 0.5}
    assert mask_f1(said, truth, background=(0,))["recall"] == pytest.approx(2 / 3)
    with pytest.raises(ValueError, match="cannot be compared"):
        mask_f1(said[:5], truth)
