"""A new shape and a new contact from one small file of another package are picked up by everything."""

import importlib.metadata
import sys

import numpy as np
import pytest
from geometry import all_choices, contact_faults, random_body, random_values

from derender.scene.contacts import contacts
from derender.scene.graph import Contact, SceneGraph, Vertex
from derender.scene.shapes import shapes
from derender.scene.solids import MESH


@pytest.fixture
def plugin(monkeypatch):
    """Announce the plug-in's module by an entry point, as its package's metadata would, and forget it afterwards."""
    point = importlib.metadata.EntryPoint("pyramid", "plugin_pyramid", "derender.shapes")
    ask = importlib.metadata.entry_points

    def announced(**wanted):
        return [point] if wanted.get("group") == "derender.shapes" else ask(**wanted)

    monkeypatch.setattr(importlib.metadata, "entry_points", announced)
    for each in (shapes, contacts):
        monkeypatch.setattr(each, "_entries", dict(each._entries))
        monkeypatch.setattr(each, "_loaded", False)
    monkeypatch.delitem(sys.modules, "plugin_pyramid", raising=False)
    yield
    sys.modules.pop("plugin_pyramid", None)


def test_registries_find_it(plugin):
    assert "pyramid" in list(shapes)  # asking loads the entry points
    assert "concentric" in list(contacts)


def test_registry_driven_geometry_holds_for_it(plugin):
    """The same round trip and brute force that the built-in types go through, wherever the new ones take part."""
    assert shapes["pyramid"]
    rng = np.random.default_rng(1)
    cases = [case for case in all_choices() if "pyramid" in case or "concentric" in case]
    assert len(cases) > 200
    for kind, first, second, parent_face, child_face in cases:
        parent, child = random_body(rng, first), random_body(rng, second)
        faces = parent, child, parent_face, child_face
        parameters = contacts[kind].parameters(parent.shape, child.shape, parent_face, child_face)
        values = random_values(rng, parameters) if kind != "6dof" else {"x": 0.1}
        pose = contacts[kind].relative_pose(values, *faces)
        found = contacts[kind].invert(pose, *faces)
        assert found.outside < 1e-12 and found.angle == 0
        assert np.abs(contacts[kind].relative_pose(found.values, *faces) - pose).max() < 1e-12
        if kind != "6dof" and second != "plane":
            assert contact_faults(pose, parent, child, parent_face) == []


def test_scene_graph_draws_it_through_its_mesh(plugin):
    base = Vertex("base", "pyramid", {"base": 0.2, "height": 0.1}, contact=Contact("6dof", values={"z": 1.0}))
    top = Vertex("top", "cube", {"side": 0.05}, "base", Contact("concentric", "+z", "-z", {"theta": 0.2}))
    graph = SceneGraph(np.eye(4), (base, top))
    solids = graph.solids()
    assert solids.kind[0] == MESH and solids.mesh[0] == 0 and len(solids.meshes) == 1
    assert np.allclose(np.ptp(solids.meshes[0][0], axis=0), [0.2, 0.2, 0.1])
    assert graph.degrees_of_freedom() == 7
    assert graph.poses()["top"][2, 3] == pytest.approx(1.0 + 0.05 + 0.025)


def test_yaml_and_renderer_take_it(plugin, tmp_path):
    from derender.document import read_document
    from derender.render.raycast.depth import render_depth

    path = tmp_path / "scene.yaml"
    path.write_text(
        "derender: 1\n"
        "camera: {fx: 60, fy: 60, cx: 31.5, cy: 23.5, width: 64, height: 48}\n"
        "root: {position: [0, 0, 1.0], quat_wxyz: [0, 1, 0, 0]}\n"
        "objects:\n"
        "  base: {shape: {type: pyramid, base: 0.4, height: 0.2}, contact: {type: 6dof}}\n"
        "  top: {shape: {type: cube, side: 0.1}, parent: base, contact: {type: concentric, theta: 0}}\n"
    )
    document = read_document(path)
    graph = document.prior.sample(np.random.default_rng(0))
    depth, label = render_depth(graph.solids(), document.camera)
    # Straight from above (z of the root towards the camera): the cube's top at 0.8 m, the pyramid's at 0.9 m.
    assert depth[24, 32] == pytest.approx(0.8, abs=1e-6) and label[24, 32] == 1
    assert depth[24, 32 + 5] == pytest.approx(0.9, abs=1e-6) and label[24, 32 + 5] == 0
