"""Exports, read back by the programs they are for, or by a second reader."""

import json
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
import trimesh

from derender.camera.intrinsics import Camera
from derender.errors import DerenderError
from derender.physics.bodies import matter_of_graph
from derender.physics.simulate import judge, simulate
from derender.report.export import EXPORTERS, export_scene, roll_pitch_yaw
from derender.report.geometry import upright_pose
from derender.scene.graph import Contact, SceneGraph, Vertex
from derender.scene.pose import rotation_x, rotation_y, rotation_z, translation


def face(**values):
    return Contact("face-to-face", "+z", "-z", values)


@pytest.fixture
def graph():
    """A box on the floor with a can on it and a ball beside it, seen from above, tilted; with a hull if asked."""
    return SceneGraph(
        translation(0.05, 0.1, 0.9) @ rotation_x(2.2) @ rotation_y(0.1) @ rotation_z(0.3),
        (
            Vertex("floor", "plane"),
            Vertex(
                "big box", "box", {"length": 0.2, "width": 0.14, "height": 0.08}, "floor", face(theta=0.4, x=0.1, y=0.0)
            ),
            Vertex("can", "cylinder", {"radius": 0.03, "height": 0.1}, "big box", face(u=0.5, v=0.5)),
            Vertex(
                "ball",
                "sphere",
                {"radius": 0.04},
                "floor",
                Contact("point-on-face", "+z", "surface", {"x": -0.15, "y": 0.1}),
            ),
        ),
    )


def test_upright_world(graph):
    up = upright_pose(graph)
    poses = {name: up @ pose for name, pose in graph.poses().items()}
    np.testing.assert_allclose(poses["floor"][2, 3], 0, atol=1e-12)
    # Heights are what the contacts say, whatever the camera's tilt.
    assert poses["big box"][2, 3] == pytest.approx(0.04)
    assert poses["can"][2, 3] == pytest.approx(0.13)
    assert poses["ball"][2, 3] == pytest.approx(0.04)
    np.testing.assert_allclose(up[:3, :3] @ graph.down(), [0, 0, -1], atol=1e-12)


def test_glb_holds_the_tree_and_the_solids(graph, tmp_path):
    (path,) = export_scene(graph, tmp_path / "scene.glb")
    scene = trimesh.load(path)
    up = rotation_x(-np.pi / 2) @ upright_pose(graph)
    for name in graph.solid_names:
        pose, mesh_name = scene.graph[name]
        np.testing.assert_allclose(pose, up @ graph.poses()[name], atol=1e-6)
        extents = scene.geometry[mesh_name].bounding_box.extents
        if name != "floor":
            np.testing.assert_allclose(extents, graph.body(name).size(), rtol=2e-3)
    assert scene.graph.transforms.parents["can"] == "big box"
    # A child's mesh stands on its parent's: the can's lowest point is at the height of the box's top (y is up).
    can = scene.geometry[scene.graph["can"][1]].copy().apply_transform(scene.graph["can"][0])
    assert can.bounds[0, 1] == pytest.approx(0.08, abs=1e-6)


def test_obj(graph, tmp_path):
    path, library = export_scene(graph, tmp_path / "scene.obj")
    assert library.name == "scene.mtl" and "newmtl big_box" in library.read_text()
    scene = trimesh.load(path, split_object=True, group_material=False)
    meshes = list(scene.geometry.values()) if isinstance(scene, trimesh.Scene) else scene.split()
    lowest = sorted(mesh.bounds[0, 2] for mesh in meshes)
    np.testing.assert_allclose(lowest, [0, 0, 0, 0.08], atol=1e-6)


def test_mjcf_runs_and_says_what_simulate_says(graph, tmp_path):
    for scene, stable in ((graph, True), (graph.replace("can", contact=face(u=0.01, v=0.5)), False)):
        (path,) = export_scene(scene, tmp_path / "scene.xml")
        model = mujoco.MjModel.from_xml_path(str(path))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        before = data.xpos.copy()
        np.testing.assert_allclose(model.opt.gravity, [0, 0, -9.81], atol=1e-6)
        mujoco.mj_step(model, data, int(2 / model.opt.timestep))
        moved = np.linalg.norm(data.xpos - before, axis=1)
        assert bool(moved.max() < 0.003) is stable
        assert judge(simulate(matter_of_graph(scene))).stable is stable
    assert model.body("big box").id > 0 and model.geom("floor").type == mujoco.mjtGeom.mjGEOM_PLANE


def test_urdf(graph, tmp_path):
    (path,) = export_scene(graph, tmp_path / "scene.urdf")
    root = ElementTree.parse(path).getroot()
    up = upright_pose(graph)
    links = {link.get("name") for link in root.findall("link")}
    assert links == {"world", *graph.solid_names}
    for joint in root.findall("joint"):
        name = joint.find("child").get("link")
        if name == "floor":
            assert joint.get("type") == "fixed"
            continue
        origin = joint.find("origin")
        roll, pitch, yaw = map(float, origin.get("rpy").split())
        pose = (
            translation(*map(float, origin.get("xyz").split())) @ rotation_z(yaw) @ rotation_y(pitch) @ rotation_x(roll)
        )
        np.testing.assert_allclose(pose, up @ graph.poses()[name], atol=1e-7)
    box = root.find("link[@name='big box']")
    np.testing.assert_allclose(
        [float(x) for x in box.find("visual/geometry/box").get("size").split()], [0.2, 0.14, 0.08]
    )
    mass = float(box.find("inertial/mass").get("value"))
    assert mass == pytest.approx(500 * 0.2 * 0.14 * 0.08)
    assert float(box.find("inertial/inertia").get("izz")) == pytest.approx(mass * (0.2**2 + 0.14**2) / 12)
    # MuJoCo reads URDF too: an independent parser of the whole file.
    assert mujoco.MjModel.from_xml_path(str(path)).ngeom >= 4


def test_roll_pitch_yaw_straight_up():
    for pose in (rotation_y(np.pi / 2) @ rotation_x(0.3), rotation_z(0.2) @ rotation_y(-np.pi / 2)):
        roll, pitch, yaw = roll_pitch_yaw(pose)
        np.testing.assert_allclose(rotation_z(yaw) @ rotation_y(pitch) @ rotation_x(roll), pose, atol=1e-9)


def test_bop_round_trip(graph, tmp_path):
    from derender.evaluation.truth import read_json_scene

    camera = Camera(100, 101, 31.5, 23.5, 64, 48)
    written = export_scene(graph, tmp_path / "scene_gt.json", camera)
    assert [path.name for path in written] == ["scene_gt.json", "models_info.json", "scene_camera.json"]
    scene = read_json_scene(written[0])
    for item, name in zip(scene["objects"], ["big box", "can", "ball"], strict=True):
        np.testing.assert_allclose(item["pose"], graph.poses()[name], atol=1e-12)
        np.testing.assert_allclose(item["size"], graph.body(name).size())
    from derender.camera.camera_file import read_camera

    assert read_camera(written[2], shape=(48, 64)).fy == 101
    assert json.loads(written[1].read_text())["1"]["size_x"] == pytest.approx(200)


def test_an_unknown_suffix_is_the_users_fault_and_writes_nothing(graph, tmp_path):
    with pytest.raises(DerenderError, match=".glb"):
        export_scene(graph, tmp_path / "scene.fbx")
    for suffix in EXPORTERS:
        with pytest.raises(DerenderError):
            export_scene(graph, f"/proc/nowhere/scene{suffix}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", sorted(EXPORTERS))
def test_a_mesh_is_exported_everywhere(suffix, tmp_path):
    trimesh.creation.icosphere(subdivisions=1, radius=0.05).export(tmp_path / "stone.obj")
    graph = SceneGraph(
        translation(0, 0.1, 0.9) @ rotation_x(2.2),
        (
            Vertex("floor", "plane"),
            Vertex("stone", "mesh", {"scale": 1.0}, "floor", face(x=0.0, y=0.0), {"file": str(tmp_path / "stone.obj")}),
        ),
    )
    written = export_scene(graph, tmp_path / f"scene{suffix}")
    assert all(path.stat().st_size > 0 for path in written)
    if suffix == ".xml":
        assert mujoco.MjModel.from_xml_path(str(written[0])).nmesh == 1
