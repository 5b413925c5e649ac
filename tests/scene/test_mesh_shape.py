"""Meshes from files: the oriented box, the hull, and every way in which a file is at fault."""

import warnings

import numpy as np
import pytest
import trimesh

from derender.errors import DerenderError
from derender.scene.graph import Contact, SceneGraph, Vertex
from derender.scene.pose import random_rotation
from derender.scene.shapes import Body, shapes
from derender.scene.shapes.mesh import load_mesh
from derender.scene.solids import MESH


@pytest.fixture
def turned_box(tmp_path):
    """A file with a 10 x 6 x 4 cm box, turned and shifted in the file's own axes."""
    mesh = trimesh.creation.box(extents=(0.1, 0.06, 0.04))
    mesh.apply_transform(random_rotation(np.random.default_rng(1)))
    mesh.apply_translation((0.5, -0.2, 0.1))
    path = tmp_path / "box.ply"
    mesh.export(path)
    return path


def test_oriented_box_is_fitted(turned_box):
    loaded = load_mesh(turned_box)
    assert np.allclose(np.sort(loaded.extents), [0.04, 0.06, 0.1], atol=1e-6)  # the file holds float32
    assert np.allclose(loaded.vertices.max(axis=0), -loaded.vertices.min(axis=0), atol=1e-12)
    assert np.allclose(np.ptp(loaded.vertices, axis=0), loaded.extents, rtol=1e-12)
    file = trimesh.load_mesh(turned_box)
    again = trimesh.transform_points(file.vertices, loaded.box_from_file)
    assert all(np.abs(loaded.vertices - point).max(axis=1).min() < 1e-6 for point in again)
    assert np.linalg.det(loaded.box_from_file[:3, :3]) == pytest.approx(1.0)
    assert not loaded.vertices.flags.writeable


def test_upright_mesh_keeps_its_axes(tmp_path):
    """A mesh that is aligned already is not turned on its side because another axis is longer."""
    path = tmp_path / "can.stl"
    trimesh.creation.cylinder(radius=0.03, height=0.12, sections=64).export(path)
    loaded = load_mesh(path)
    assert abs(loaded.box_from_file[2, 2]) == pytest.approx(1.0, abs=1e-6)
    assert loaded.extents[2] == pytest.approx(0.12, abs=1e-6)


def test_mesh_in_a_scene(turned_box):
    options = {"file": str(turned_box)}
    contact = Contact("face-to-face", "+z", "-z", {"x": 0.1})
    mug = Vertex("mug", "mesh", {"scale": 2.0}, "floor", contact, options)
    other = Vertex("other", "mesh", {}, "floor", contact, options)
    graph = SceneGraph(np.eye(4), (Vertex("floor", "plane"), mug, other))
    solids = graph.solids()
    assert solids.kind.tolist() == [0, MESH, MESH] and len(solids.meshes) == 1  # shared
    assert np.allclose(solids.size[1], 2 * solids.size[2])
    vertices = solids.meshes[0][0] * (solids.size[1] / np.ptp(solids.meshes[0][0], axis=0))
    placed = vertices @ solids.pose[1, :3, :3].T + solids.pose[1, :3, 3]
    assert placed[:, 2].min() == pytest.approx(0.0, abs=1e-9)  # it stands on the floor
    body = Body(shapes["mesh"], np.array([2.0]), options)
    assert np.allclose(shapes["mesh"].psi_from_size(body.size(), options), 2.0)


def test_hull_or_full(tmp_path):
    ring = trimesh.creation.annulus(r_min=0.02, r_max=0.05, height=0.03)
    path = tmp_path / "ring.obj"
    ring.export(path)
    hull, full = load_mesh(path, hull=True), load_mesh(path, hull=False)
    assert trimesh.Trimesh(hull.vertices, hull.triangles).volume > trimesh.Trimesh(full.vertices, full.triangles).volume
    assert np.allclose(hull.extents, full.extents)


def test_warnings(tmp_path):
    open_box = trimesh.creation.box(extents=(0.1, 0.1, 0.1))
    open_box.update_faces(np.arange(len(open_box.faces)) > 1)
    open_box.export(tmp_path / "open.ply")
    with pytest.warns(UserWarning, match="not watertight"):
        load_mesh(tmp_path / "open.ply", hull=False)
    trimesh.creation.box(extents=(100, 60, 40)).export(tmp_path / "millimetres.ply")
    with pytest.warns(UserWarning, match="millimetres"):
        load_mesh(tmp_path / "millimetres.ply")
    trimesh.creation.box(extents=(0.1, 0.06, 0.04)).export(tmp_path / "good.ply")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_mesh(tmp_path / "good.ply")


def test_faults_are_one_line(tmp_path):
    (tmp_path / "garbage.ply").write_bytes(b"ply\nnothing of the kind" * 9)
    (tmp_path / "garbage.obj").write_bytes(bytes(range(256)))
    (tmp_path / "empty.stl").write_bytes(b"")
    (tmp_path / "mesh.xyzzy").write_bytes(b"what")
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).export(tmp_path / "flat.ply")
    square = [[0, 0, 1.7e-17], [0.4, 0, 1.7e-17], [0.4, 0.4, 2e-17], [0, 0.4, 2e-17]]  # thinner than any number is told
    trimesh.Trimesh(square, [[0, 1, 2], [0, 2, 3]]).export(tmp_path / "sheet.obj")
    trimesh.PointCloud(np.random.default_rng(0).random((9, 3))).export(tmp_path / "points.ply")
    for name in ("missing.ply", "garbage.ply", "garbage.obj", "empty.stl", "mesh.xyzzy", "flat.ply", "points.ply",
                 "sheet.obj", "."):  # fmt: skip
        with pytest.raises(DerenderError) as caught:
            load_mesh(tmp_path / name)
        assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value), name
    with pytest.raises(DerenderError, match="a mesh needs its file"):
        shapes["mesh"].size((1.0,), {})
