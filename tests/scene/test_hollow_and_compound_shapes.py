"""Frustums, open boxes and compounds: their surfaces, their faces, their convex parts, and files that say them."""

import numpy as np
import pytest
from on_floor import on_floor

from derender.camera.intrinsics import Camera
from derender.document import document_text, read_document
from derender.errors import DerenderError
from derender.physics.bodies import matter_of_graph
from derender.physics.simulate import simulate
from derender.physics.statics import Equilibrium, find_contacts
from derender.posterior.compiled.model import NotCompiled, model_of
from derender.posterior.target import ObservedImage, SceneTarget
from derender.render.raycast.depth import render_depth
from derender.scene.contacts import contacts
from derender.scene.graph import Contact, Vertex
from derender.scene.pose import inverse
from derender.scene.shapes import Body, shapes

CAMERA = Camera.from_field_of_view(64, 48)
TOTE = {"length": 0.3, "width": 0.2, "height": 0.1, "wall": 0.01}
CUP = (0.03, 0.1, 0.7)
HEAD = {"type": "box", "length": 0.12, "width": 0.05, "height": 0.05}
HANDLE = {"type": "cylinder", "radius": 0.012, "height": 0.2, "position": [0.0, 0.0, 0.125]}
PARTS = (HEAD, HANDLE)
# Of a polygon with 128 corners for a circle: its area is short by 2 pi^2 / (3 * 128^2).
ROUND = 5e-4


def above(*vertices):
    """Return a scene on a floor of which the camera, 0.8 m above it, looks straight down."""
    return on_floor(*vertices, distance=0.8)


def on(parent="floor", **values):
    return Contact("face-to-face", "+z", "-z", values)


def tote(**contents):
    box = Vertex("tote", "open-box", TOTE, "floor", on(x=0.0, y=0.0, theta=0.0))
    return above(box, *contents.values())


def test_volumes_are_those_of_the_formulas():
    radius, height, taper = CUP
    volume = np.pi * height / 3 * radius**2 * (1 + taper + taper**2)
    mesh = shapes["frustum"].mesh(CUP)
    assert mesh.is_watertight and mesh.volume == pytest.approx(volume, rel=ROUND)
    mesh = shapes["open-box"].mesh(tuple(TOTE.values()))
    assert mesh.is_watertight and mesh.volume == pytest.approx(0.3 * 0.2 * 0.1 - 0.28 * 0.18 * 0.09, rel=1e-12)
    mesh = shapes["compound"].mesh((2.0,), {"parts": PARTS})
    assert mesh.volume == pytest.approx(8 * (0.12 * 0.05 * 0.05 + np.pi * 0.012**2 * 0.2), rel=ROUND)


@pytest.mark.parametrize(
    ("name", "psi", "options"),
    [("frustum", CUP, {}), ("open-box", tuple(TOTE.values()), {}), ("compound", (1.5,), {"parts": PARTS})],
)
def test_extents_faces_and_parts_agree_with_the_mesh(name, psi, options):
    shape = shapes[name]
    mesh, size = shape.mesh(psi, options), shape.size(psi, options)
    assert np.allclose(mesh.bounds, [-0.5 * size, 0.5 * size], atol=1e-12)
    assert np.allclose(shape.size(shape.psi_from_size(size, options), options), size)
    (vertices, _), drawn = shape.drawn_mesh(psi, options)[1], size
    assert np.allclose(vertices * (drawn / np.ptp(vertices, axis=0)), mesh.vertices, atol=1e-12)
    for face in (shape.face(name, psi, options) for name in shape.face_names):
        assert np.isclose(np.linalg.det(face.frame[:3, :3]), 1.0)
        assert np.abs((mesh.vertices - face.frame[:3, 3]) @ face.frame[:3, 2]).min() < 1e-12
    for corners in shape.convex_parts(psi, options):
        assert (np.abs(corners) <= 0.5 * size + 1e-12).all()


@pytest.mark.parametrize("kind", ["face-to-face", "edge-on-face", "corner-on-face"])
@pytest.mark.parametrize(("name", "psi", "top"), [("frustum", CUP, 0.05), ("open-box", tuple(TOTE.values()), -0.04)])
def test_a_box_on_their_upper_face_touches_it_and_the_contact_is_found_again(kind, name, psi, top):
    rng, psi = np.random.default_rng(3), np.array(psi)
    parent, child = Body(shapes[name], psi), Body(shapes["box"], np.array([0.04, 0.03, 0.02]))
    for by in [pair[1] for pair in contacts[kind].choices(parent.shape, child.shape) if pair[0] == "+z"]:
        parameters = contacts[kind].parameters(parent.shape, child.shape, "+z", by)
        values = {p.name: rng.uniform(p.lower, p.upper) for p in parameters if not p.slack}
        pose = contacts[kind].relative_pose(values, parent, child, "+z", by)
        corners = child.shape.mesh(child.psi).vertices @ pose[:3, :3].T + pose[:3, 3]
        assert corners[:, 2].min() == pytest.approx(top, abs=1e-12)
        lowest = corners[corners[:, 2] < top + 1e-9]
        outline = parent.face("+z").outline
        reach = np.array([0.5 * outline.length + outline.radius, 0.5 * outline.width + outline.radius])
        assert (lowest[:, :2].min(axis=0) <= reach + 1e-9).all() and (lowest[:, :2].max(axis=0) >= -reach - 1e-9).all()
        found = contacts[kind].invert(pose, parent, child, "+z", by)
        assert np.abs(contacts[kind].relative_pose(found.values, parent, child, "+z", by) - pose).max() < 1e-12


def test_the_parts_of_an_open_box_fill_it_once():
    rng = np.random.default_rng(0)
    psi = tuple(TOTE.values())
    points = rng.uniform(-0.5, 0.5, (2000, 3)) * shapes["open-box"].size(psi)
    boxes = [(corners.min(axis=0), corners.max(axis=0)) for corners in shapes["open-box"].convex_parts(psi)]
    count = sum(((points > low) & (points < high)).all(axis=1).astype(int) for low, high in boxes)
    hollow = (np.abs(points[:, 0]) < 0.14) & (np.abs(points[:, 1]) < 0.09) & (points[:, 2] > -0.04)
    assert np.array_equal(count, (~hollow).astype(int))


@pytest.mark.slow
def test_what_an_open_box_holds_rests_on_its_bottom_and_is_seen():
    cube = Vertex("cube", "cube", {"side": 0.05}, "tote", on("tote", theta=0.0, u=0.5, v=0.5))
    graph = tote(cube=cube)
    relative = inverse(graph.poses()["floor"]) @ graph.poses()["cube"]
    assert relative[2, 3] == pytest.approx(0.01 + 0.025)
    depth, label = render_depth(graph.solids(), CAMERA)
    assert depth[24, 32] == pytest.approx(0.8 - 0.06, abs=1e-6) and label[24, 32] == 2
    beside = depth[label == 1]
    assert beside.max() == pytest.approx(0.8 - 0.01, abs=1e-6)  # the bottom's inside
    assert beside.min() == pytest.approx(0.8 - 0.1, abs=1e-6)  # the rim
    matter = matter_of_graph(graph)
    assert Equilibrium(matter).stands
    found = find_contacts(matter)
    assert found.gap[found.first == 2] == pytest.approx(0.0, abs=1e-6)  # the walls end 1 cm over the floor
    assert set(zip(found.first, found.second, strict=True)) <= {(1, 0), (2, 1)}  # no part bears on its own body


def test_a_cube_over_the_rim_falls_in_and_not_through():
    cube = Vertex("cube", "cube", {"side": 0.05}, "floor", Contact("6dof", values={"x": 0.0, "y": 0.0, "z": 0.2}))
    trajectory = simulate(matter_of_graph(tote(cube=cube)), 2.0)
    height = trajectory.poses[-1, trajectory.names.index("cube"), 2, 3]
    assert 0.8 - height == pytest.approx(0.01 + 0.025, abs=2e-3)


def test_a_compound_balances_by_its_parts():
    """An L hangs over where its hull's centre of mass would not be."""
    long, tall = {"type": "box", "length": 0.2, "width": 0.05, "height": 0.02}, {"type": "box"}
    tall |= {"length": 0.02, "width": 0.05, "height": 0.2, "position": [-0.09, 0.0, 0.11]}
    body = matter_of_graph(above(Vertex("l", "compound", {}, "floor", on(x=0, y=0), {"parts": (long, tall)}))).bodies[1]
    assert body.volume() == pytest.approx(2 * 0.2 * 0.05 * 0.02)
    assert (inverse(body.pose)[:3, :3] @ (body.centre_of_mass() - body.pose[:3, 3]))[0] == pytest.approx(-0.045)
    pieces = body.pieces()
    assert [piece.weight_in_kg() for piece in pieces] == pytest.approx([0.1, 0.1])


def test_a_scene_file_says_them_and_reads_them_again(tmp_path):
    cup = Vertex("cup", "frustum", dict(zip(("radius", "height", "taper"), CUP, strict=True)), "floor", on(x=0.2, y=0))
    graph = tote(cup=cup, mallet=Vertex("mallet", "compound", {}, "floor", on(x=-0.2, y=0), {"parts": PARTS}))
    (tmp_path / "scene.yaml").write_text(document_text(graph, CAMERA))
    again = read_document(tmp_path / "scene.yaml").prior.sample(np.random.default_rng(0))
    assert np.array_equal(render_depth(again.solids(), CAMERA)[0], render_depth(graph.solids(), CAMERA)[0])


SOMEWHERE = "contact: {type: face-to-face, theta: 0, x: {uniform: [-0.1, 0.1]}, y: 0}"
INSIDE = "contact: {type: face-to-face, theta: 0, u: {uniform: [0, 1]}, v: 0.5}"
FIXED_TOTE = f"{{shape: {{type: open-box, length: 0.3, width: 0.2, height: 0.1}}, parent: floor, {SOMEWHERE}}}"


def cup(radius, taper):
    shape = f"{{type: frustum, radius: {radius}, height: 0.1, taper: {taper}}}"
    return f"cup: {{shape: {shape}, parent: floor, {SOMEWHERE}}}"


@pytest.mark.parametrize(
    ("objects", "reason"),
    [
        (cup("{uniform: [0.02, 0.05]}", "0.7"), ""),
        (cup("0.03", "{uniform: [0.5, 0.9]}"), "taper"),
        (f"tote: {FIXED_TOTE}", ""),
        (f"tote: {FIXED_TOTE}\n  cube: {{shape: {{type: cube, side: 0.05}}, parent: tote, {INSIDE}}}", "face +z"),
    ],
)
def test_chains_are_compiled_where_only_extents_change_and_faces_are_those_of_the_box(tmp_path, objects, reason):
    """Else Python takes the steps: compiled ones would move the mesh, or what rests on it, wrongly."""
    path = tmp_path / "prior.yaml"
    path.write_text(f"derender: 1\nobjects:\n  floor: {{shape: plane, contact: {{type: 6dof}}}}\n  {objects}\n")
    prior = read_document(path).prior
    graph = prior.sample(np.random.default_rng(0))
    target = SceneTarget(prior, graph, ObservedImage(CAMERA, render_depth(graph.solids(), CAMERA)[0]))
    try:
        model_of(target)
        found = ""
    except NotCompiled as what:
        found = str(what)
    assert reason in found and bool(reason) == bool(found)


@pytest.mark.parametrize(
    ("parts", "what"),
    [
        ("[]", "1 to 100 parts"),
        ("[{type: box, length: 0.1}]", "must be fixed numbers"),
        ("[{type: plane}]", "'plane' can be no part"),
        ("[{type: cube, side: 0.1, colour: red}]", "no 'colour'"),
        ("[{type: cube, side: -0.1}]", "side is -0.1"),
        ("[{type: cube, side: 0.1, position: [0, 0]}]", "position must be 3 fixed numbers"),
        ("[{type: cube, side: 0.1, quat_wxyz: [0, 0, 0, 0]}]", "quaternion is zero"),
        ("[5]", "a part is"),
    ],
)
def test_parts_at_fault_are_told_in_one_line(tmp_path, parts, what):
    path = tmp_path / "scene.yaml"
    path.write_text(
        f"derender: 1\nobjects:\n  it: {{shape: {{type: compound, parts: {parts}}}, contact: {{type: 6dof}}}}\n"
    )
    with pytest.raises(DerenderError, match=what) as caught:
        read_document(path)
    assert "\n" not in str(caught.value) and "scene.yaml" in str(caught.value)


def test_walls_that_leave_no_room_are_told():
    with pytest.raises(DerenderError, match="leave no room"):
        shapes["open-box"].check((0.1, 0.1, 0.1, 0.06))
