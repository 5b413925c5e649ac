"""Planes at several heights: each with what stands on it, one posterior of all."""

from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from on_floor import cube, on_floor

from derender.camera.intrinsics import Camera
from derender.document import read_document, write_document
from derender.errors import DerenderError
from derender.evaluation.metrics import match_planes
from derender.physics.bodies import matter_of_graph
from derender.physics.simulate import judge, simulate
from derender.render.raycast.depth import render_depth
from derender.report.scene_json import scene_json
from derender.results.posterior import StructurePosterior
from derender.scene.graph import ROOT, Contact, SceneGraph, Vertex
from derender.scene.pose import rotation_x
from derender.scene.shapes import shapes
from derender.structures.graph_posterior import MOST_PARTS
from derender.structures.infer import infer_structure
from derender.structures.options import Options
from derender.structures.supports import multiplied, new_names, renamed, with_supports
from worlds.frontier_scenes import KINDS, make

CAMERA = Camera(fx=140.0, fy=140.0, cx=79.5, cy=59.5, width=160, height=120)
PATCH = [0.1, 0.0, 0.2, 0.1, 0.5]


def floor_seen(height=0.0):
    """Return the pose (4, 4) of a plane, z up, 40 degrees below a level camera and 0.8 m away, raised by a height."""
    pose = rotation_x(np.pi / 2 + np.radians(40))
    pose[:3, 3] = np.array([0.0, 0.0, 0.8]) + height * pose[:3, 2]
    return pose


def posterior_over(pose, rng, shape, weight=1.0, x=0.0):
    """Return a StructurePosterior of a box of unknown height on a plane whose pose is unknown, and one that floats."""
    graph = SceneGraph(pose, (
        Vertex("floor", "plane"),
        Vertex("box_1", "box", {"length": 0.1, "width": 0.1, "height": 0.1}, "floor",
               Contact("face-to-face", "+z", "-z", {"theta": 0.1, "x": x, "y": 0.0})),
        Vertex("cube_1", "cube", {"side": 0.05}, ROOT, Contact("6dof", values={"x": x, "y": 0.1, "z": 0.3})),
    ))  # fmt: skip
    values = rng.normal(0.1, 0.01, (*shape, 1))
    roots = np.tile(pose, (*shape, 1, 1))
    roots[..., :3, 3] += rng.normal(0.0, 0.001, (*shape, 3))
    log_prior, log_likelihood = rng.normal(size=(2, *shape))
    return StructurePosterior(graph, ("box_1.height",), values, log_prior, log_likelihood, weight, (None,), roots)


def test_structures_of_two_planes_that_are_not_told_keep_their_share():
    """Of six structures each on two planes twelve pairs are told: each weighs what the product of the two says."""
    rng = np.random.default_rng(1)
    weights = np.array([0.3, 0.2, 0.15, 0.15, 0.1, 0.1])
    parts, more = ([posterior_over(floor_seen(height), rng, (1, 2), weight, x) for weight in weights]
                   for height, x in ((0.2, 0.3), (0.0, 0.0)))  # fmt: skip
    seen, other = (
        SimpleNamespace(floor=SimpleNamespace(pose=floor_seen(height)), points=None) for height in (0.2, 0.0)
    )
    with mock.patch("derender.structures.supports.patch_of", return_value=None):
        found = with_supports(parts, seen, [(more, other)])
    products = np.sort(np.outer(weights, weights).ravel())[::-1]
    assert [each.weight for each in found] == pytest.approx(products[: len(found)])
    assert len(found) == MOST_PARTS and sum(each.weight for each in found) < 0.65


def test_two_planes_posteriors_multiply():
    rng = np.random.default_rng(0)
    first, second = (
        posterior_over(floor_seen(), rng, (2, 30), 0.8),
        posterior_over(floor_seen(0.2), rng, (1, 7), 0.5, 0.3),
    )
    names = new_names([first], [second], 2)
    assert names == {"floor": "support_2", "box_1": "box_2", "cube_1": "cube_2"}
    both = multiplied(first, renamed(second, names, None), 0.4)
    assert both.weight == 0.4 and both.log_density.shape == (2, 30)
    assert both.graph.vertex("box_2").parent == "support_2"
    height = both.values[..., both.addresses.index("box_2.height")]
    assert set(np.round(height.ravel(), 12)) == set(np.round(second.values.ravel(), 12))  # all its draws, no others
    assert np.unique(np.round(height, 12), return_counts=True)[1].min() == 60 // 7
    density, best = both.best()[1], [part.best() for part in (first, second)]
    assert density == pytest.approx(best[0][1] + best[1][1])  # the best of both is one draw
    there, told = best[1][0].poses(), both.best()[0].poses()
    for name, new in names.items():
        assert told[new] == pytest.approx(there[name], abs=1e-9)
    for chain, draw in ((0, 3), (1, 17)):  # every draw is one of either, where it was
        poses = both.graph_at(chain, draw).poses()
        assert poses["box_1"] == pytest.approx(first.graph_at(chain, draw).poses()["box_1"])
        own = np.flatnonzero(np.isclose(second.values[0, :, 0], height[chain, draw]))[0]
        assert poses["box_2"] == pytest.approx(second.graph_at(0, int(own)).poses()["box_1"], abs=1e-9)
        assert poses["cube_2"] == pytest.approx(second.graph_at(0, int(own)).poses()["cube_1"], abs=1e-9)


def patched(height=0.2, patch=PATCH):
    """Return the graph of a plane that ends, with a box on it, over one that does not."""
    return SceneGraph(floor_seen(), (
        Vertex("floor", "plane"),
        Vertex("support_2", "plane", {}, ROOT, Contact("6dof", values={"z": height}), {"patch": patch}),
        Vertex("box_1", "box", {"length": 0.05, "width": 0.05, "height": 0.05}, "support_2",
               Contact("face-to-face", "+z", "-z", {"theta": 0.1, "x": 0.1, "y": 0.0})),
    ))  # fmt: skip


def test_a_plane_that_ends_is_seen_as_far_as_it_is_there(tmp_path):
    graph = patched()
    depth, label = render_depth(graph.solids(), CAMERA)
    place = graph.solid_names.index("support_2")
    rows, columns = np.nonzero(label == place)
    points = np.column_stack([(columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy, np.ones(len(rows))])
    points *= depth[rows, columns, None]
    pose = graph.poses()["support_2"]
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    turn = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    off = np.abs((local[:, :2] - [0.1, 0.0]) @ turn)
    assert np.abs(local[:, 2]).max() < 1e-4 and (off < [0.1001, 0.0501]).all()
    assert off.max(axis=0) == pytest.approx([0.1, 0.05], abs=0.008)
    write_document(tmp_path / "scene.yaml", graph, CAMERA)
    again = read_document(tmp_path / "scene.yaml").graph
    assert list(again.vertex("support_2").options["patch"]) == PATCH
    shown = {item["name"]: item for item in scene_json(graph)["objects"]}["support_2"]
    assert (shown["type"], shown["size"]) == ("plane", None)
    for wrong in ([1, 2, 3], [0, 0, -1, 1, 0], "wide"):
        with pytest.raises(DerenderError, match="patch"):
            shapes["plane"].check((), {"patch": wrong})


def test_a_plane_that_ends_bears_what_stands_on_it():
    graph = patched()
    held = {body.name: body for body in matter_of_graph(graph).bodies}["support_2"]
    assert held.fixed and held.kind == "box"
    assert judge(simulate(matter_of_graph(graph))).stable
    beside = graph.replace("support_2", options={"patch": [0.5, 0.0, 0.2, 0.1, 0.0]})
    assert not judge(simulate(matter_of_graph(beside))).stable


def test_things_on_two_tables_stand_on_their_own():
    scene = make(np.random.default_rng([1, list(KINDS).index("heights")]), "heights")
    posterior = infer_structure(scene.depth, scene.camera, Options(seed=0, method="map", quick=True))
    told = scene_json(posterior.best_graph(), posterior)
    solids = [item for item in told["objects"] if item["size"] is not None]
    planes = [{"name": name, "type": "plane", "pose": pose} for name, pose in scene.tables.items()]
    same = match_planes(
        told, {"objects": [*planes, *({**item, "name": str(k)} for k, item in enumerate(scene.objects))]}
    )
    assert len(solids) == len(scene.objects)
    for item in solids:
        apart = [np.linalg.norm(np.array(item["pose"])[:3, 3] - true["pose"][:3, 3]) for true in scene.objects]
        assert min(apart) < 0.01 and same[item["parent"]] == scene.objects[int(np.argmin(apart))]["parent"]
    assert posterior.explanation.share(scene.depth) > 0.985


@pytest.mark.parametrize(("kind", "count"), [("heights", 2), ("beside", 2)])
def test_no_more_objects_are_told_than_someone_says_there_are(kind, count):
    """Solids that were not looked for were free-form things, and further planes had as many again."""
    if kind == "heights":
        scene = make(np.random.default_rng([1, list(KINDS).index("heights")]), "heights")
        depth, camera = scene.depth, scene.camera
    else:
        graph = on_floor(cube("left", -0.2, theta=0.3, side=0.12), cube("right", 0.2, theta=0.3), distance=0.9)
        camera, depth = CAMERA, render_depth(graph.solids(), CAMERA)[0]
        depth = depth + np.random.default_rng(0).normal(0.0, 0.001, depth.shape)
    asked = (Options(seed=0, method="map", quick=True, max_objects=most) for most in (count, 1))
    found = [infer_structure(depth, camera, options) for options in asked]
    solids = [[v for v in each.best_graph().vertices if v.body.size() is not None] for each in found]
    assert [len(each) for each in solids] == [count, 1] and solids[1][0].shape != "thing"
    if kind == "beside":
        assert [round(probability, 1) for probability, *_ in found[1].meta["clutter"]] == [1.0]  # it is doubted
