"""The next best view: its linear-Gaussian estimate, and what it says of scenes where the answer is known."""

import json
from dataclasses import replace

import imageio.v3 as imageio
import numpy as np
import pytest
from click.testing import CliRunner
from on_floor import face, on_floor

from derender.camera.depth_file import DepthImage
from derender.camera.intrinsics import Camera
from derender.camera.poses import read_poses
from derender.cli import group
from derender.document import LikelihoodPrior
from derender.physics.next_view import ENOUGH, candidates, information, next_views, spreads_after
from derender.render.raycast.depth import render_depth
from derender.report.pictures import write_view
from derender.report.result_folder import write_results
from derender.results.posterior import Posterior, StructurePosterior
from derender.scene.graph import ROOT, SceneGraph, Vertex, floating
from derender.scene.pose import from_rotation_vector, inverse, translation

CAMERA = Camera(72, 72, 39.5, 29.5, 80, 60)
LIKELIHOOD = {"type": "gaussian", "sigma": 0.001, "blur": 0.5, "background": 10.0}


def scene():
    """A box on a floor, one of its level edges along the camera's line of sight."""
    size = {"length": 0.08, "width": 0.06, "height": 0.1}
    box = Vertex("box", "box", size, "floor", face())
    return on_floor(box, elevation=np.rad2deg(0.25), distance=0.7, lower=0.02)


def posterior(axis):
    """A posterior that knows all but one extent of the box, whose near side stays where it is."""
    graph, rng = scene(), np.random.default_rng(1)
    other = "x" if axis == "length" else "y"
    extents = graph.vertex("box").parameters[axis] + 0.02 * rng.random((2, 100))
    away = 1.0 if np.sign((graph.root_pose[:3, 0] if other == "x" else graph.root_pose[:3, 1])[2]) > 0 else -1.0
    shift = 0.5 * away * (extents - graph.vertex("box").parameters[axis])
    values = np.stack([extents, shift], axis=-1)
    addresses = (f"box.{axis}", f"box.contact.{other}")
    density = -np.abs(extents - extents.mean())
    part = StructurePosterior(graph, addresses, values, np.zeros_like(density), density, 1.0, (None, None),
                              extras={"likelihood": LIKELIHOOD})  # fmt: skip
    meta = {"interrupted": False, "camera": CAMERA.to_dict(), "lost_chains": []}
    return Posterior((part,), seed=0, meta=meta)


def test_expected_spreads_are_those_of_a_kalman_update():
    rng = np.random.default_rng(2)
    images, table = rng.standard_normal((30, 12)), rng.standard_normal((3, 30))
    images -= images.mean(axis=0)
    ((before, after),) = spreads_after([table], images)
    joint = np.cov(np.vstack([table, images.T]))
    own, cross, seen = joint[:3, :3], joint[:3, 3:], joint[3:, 3:]
    expected = own - cross @ np.linalg.solve(seen + np.eye(12), cross.T)
    np.testing.assert_allclose(before**2, np.diag(own), rtol=1e-10)
    np.testing.assert_allclose(after**2, np.diag(expected), rtol=1e-8)
    # a broken twin: without the noise of the image
    blind = own - cross @ np.linalg.solve(seen, cross.T)
    assert np.all(np.diag(blind) < 0.99 * after**2)


def test_what_is_known_already_tells_nothing():
    assert information(np.array([1e-4, 0.01]), np.array([1e-6, 0.001]), 3e-4) == pytest.approx(np.log(10.0))


def test_no_image_tells_more_of_structures_than_is_unknown():
    """Two structures at .9 and .1, told apart by a length that any image shows."""
    (likely,) = (one := posterior("length")).parts
    other = replace(
        likely, graph=likely.graph.add(Vertex("frame", "frame")), values=likely.values + [0.05, 0.0], weight=0.1
    )
    both = replace(one, parts=(replace(likely, weight=0.9), other))
    views = next_views(both, CAMERA, LIKELIHOOD, np.random.default_rng(0), "structure")
    assert 0.0 < views[0].nats["structure"] < 0.5  # entropy .33, as often as it was drawn


def test_two_sizes_half_told_count_for_more_than_one_told_twice():
    before = np.full(2, 0.02)
    both, one = (information(before, np.array(after), 3e-4, ENOUGH) for after in ([0.004, 0.004], [4e-4, 0.02]))
    assert both > one and information(before, np.array([4e-4, 0.02]), 3e-4) > information(before, before / 5.0, 3e-4)


def test_all_candidates_look_at_the_scene_from_above_the_floor():
    graph = scene()
    middle = graph.poses()["box"][:3, 3]
    for pose, _, elevation, moved in candidates(graph):
        x, y, z = (np.linalg.inv(pose) @ [*middle, 1.0])[:3]
        assert abs(x) < 1e-9 and abs(y) < 1e-9 and z == pytest.approx(np.linalg.norm(middle))
        height = (pose[:3, 3] - graph.root_pose[:3, 3]) @ graph.root_pose[:3, 2]
        assert height > 0.1 and elevation > 0.2 and moved == pytest.approx(np.linalg.norm(pose[:3, 3]))
    assert min(moved for *_, moved in candidates(graph)) < 0.1


def test_without_a_floor_cameras_are_as_high_against_gravity_as_over_one():
    graph = scene()
    contact = floating(inverse(graph.root_pose) @ graph.poses()["box"])
    hung = replace(graph.vertex("box"), parent=ROOT, contact=contact)
    alone = candidates(SceneGraph(graph.root_pose, (hung,), graph.gravity))
    for (pose, *told), (expected, *wanted) in zip(alone, candidates(graph), strict=True):
        np.testing.assert_allclose(pose, expected, atol=1e-9)
        assert told == pytest.approx(wanted)


@pytest.mark.slow
def test_the_best_view_of_a_hidden_depth_is_not_the_one_that_hid_it():
    views = next_views(posterior("width"), CAMERA, LIKELIHOOD, np.random.default_rng(3))
    here = min(views, key=lambda view: view.moved)
    best = views[0]
    assert best.nats["sizes"] > here.nats["sizes"] + 0.5
    before, after = best.spreads["box.width"]
    assert before > 0.004 and after < 0.2 * before
    assert best.nats["structure"] == 0.0  # there is one alone


def test_the_picture_from_behind_has_the_colours_of_the_one_that_was_seen(tmp_path):
    """What stands left and is red stands right from behind, and is red."""
    two = [Vertex(name, "cube", {"side": 0.08}, "floor", face(x=x)) for name, x in (("left", -0.1), ("right", 0.1))]
    graph = on_floor(*two, elevation=np.rad2deg(0.5), distance=0.7, lower=0.02)
    left, right = (graph.poses()[name][:3, 3] for name in ("left", "right"))
    middle, floor = 0.5 * (left + right), graph.poses()["floor"]
    behind = translation(*middle) @ from_rotation_vector(np.pi * floor[:3, 2]) @ translation(*-middle)
    write_view(tmp_path / "poses.png", graph, CAMERA, behind)
    picture = imageio.imread(tmp_path / "poses.png").astype(int)
    red = picture[..., 0] - picture[..., 2] > 20  # planes are a grey that is 7 redder than blue
    assert red[:, 160:].sum() > 1000 and not red[:, :160].any()


@pytest.mark.slow
def test_the_command_writes_poses_that_infer_takes(tmp_path):
    found = posterior("width")
    depth, _ = render_depth(found.best_graph().solids(), CAMERA)
    seen = DepthImage(depth, CAMERA)
    (tmp_path / "result").mkdir()
    write_results(tmp_path / "result", found, seen, LikelihoodPrior("gaussian", {"sigma": 0.001}), {}, 0.0, page=False)
    run = CliRunner().invoke(group, ["look", str(tmp_path / "result"), "--json"])
    assert run.exit_code == 0, run.output
    told = json.loads(run.stdout)
    poses = read_poses(tmp_path / "result" / "poses.json", ["a.png", "b.png"])
    np.testing.assert_allclose(poses[0], np.eye(4))
    np.testing.assert_allclose(poses[1], told["views"][0]["pose"], atol=1e-12)
    assert (tmp_path / "result" / "poses.png").read_bytes().startswith(b"\x89PNG")
    table = CliRunner().invoke(group, ["look", str(tmp_path / "result"), "--about", "structure"])
    assert table.exit_code == 0 and "box.width" in table.stdout
    assert "< 0.1" in table.stdout and " 0.0 " not in table.stdout and "< 0.1 is next to nothing" in table.stderr
    assert "no view tells more than 0.1 nats" in table.stderr  # there is one structure alone
