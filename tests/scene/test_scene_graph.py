"""Definition 2.1 and Eq. 1 on graphs: Figure 3, Figure 1, reparenting, and what is not a graph."""

import math
from dataclasses import replace

import numpy as np
import pytest
from geometry import contact_faults, overlaps

from derender import data_path
from derender.document import read_document
from derender.errors import DerenderError
from derender.scene.contacts import contacts
from derender.scene.graph import Contact, SceneGraph, Vertex
from derender.scene.pose import from_quaternion, random_rotation, translation
from derender.scene.solids import BOX, PLANE
from derender.structures.bridges import nearest_to_resting


def figure_3(which):
    return read_document(data_path(f"scenes/figure-3-{which}.yaml")).prior.sample(np.random.default_rng(0))


def on(parent, **values):
    faces = values.pop("parent_face", "+z"), values.pop("child_face", "-z")
    return {"parent": parent, "contact": Contact("face-to-face", *faces, values)}


def tower(rng, sides=(0.12, 0.1, 0.08)):
    """Return a floor and a stack of cubes on it, contacts at random."""
    vertices = [Vertex("floor", "plane")]
    for index, side in enumerate(sides):
        parent = vertices[-1].name
        offsets = dict(zip("xy", rng.uniform(-0.2, 0.2, 2), strict=True))
        offsets = offsets if index == 0 else dict(zip("uv", rng.uniform(0, 1, 2), strict=True))
        theta = rng.uniform(0, math.pi / 2)
        vertices.append(Vertex(f"cube_{index}", "cube", {"side": side}, **on(parent, theta=theta, **offsets)))
    return SceneGraph(from_quaternion((0.5, -0.866, 0, 0), (0, 0.1, 0.8)), tuple(vertices))


def largest_difference(first, second, names=None):
    a, b = first.poses(), second.poses()
    return max(np.abs(a[name] - b[name]).max() for name in names or a)


def test_figure_3_is_one_scene_as_two_graphs():
    left, right = figure_3("contacts"), figure_3("free")
    assert set(left.poses()) == set(right.poses())
    assert largest_difference(left, right) < 1e-12
    assert left.degrees_of_freedom() == 15 and right.degrees_of_freedom() == 24
    assert overlaps(left.solids()).max() < 1e-12


def test_figure_3_perturbing_phi_3_moves_4_and_5_in_the_first_graph_only():
    left, right = figure_3("contacts"), figure_3("free")
    moved = left.with_numbers({"green.contact.x": 0.05, "green.contact.theta": 0.6})
    for name in ("green", "red", "yellow"):
        assert largest_difference(left, moved, [name]) > 1e-2
    assert largest_difference(left, moved, ["floor", "root"]) == 0.0
    # What hangs on green moves with it as one rigid body.
    for name in ("red", "yellow"):
        relative = [np.linalg.inv(g.poses()["green"]) @ g.poses()[name] for g in (left, moved)]
        assert np.abs(relative[0] - relative[1]).max() < 1e-14
    moved = right.with_numbers({"green.contact.x": 0.05})
    assert largest_difference(right, moved, ["green"]) > 1e-2
    assert largest_difference(right, moved, ["floor", "root", "red", "yellow"]) == 0.0


def test_a_graph_that_forgets_its_parent_is_seen():
    """Broken twin of Eq. 1: poses relative to the root in place of the parent are not those of the second graph."""
    left, right = figure_3("contacts"), figure_3("free")
    wrong = left.root_pose @ np.linalg.inv(left.poses()["red"]) @ left.poses()["yellow"]
    assert np.abs(wrong - right.poses()["yellow"]).max() > 1e-2


def test_figure_1_touching_free_scenes_all_interpenetrate_and_stacks_never_do():
    """Under free poses every pair of solids that meets shares volume; under the stack no edge's pair ever does."""
    rng = np.random.default_rng(1)
    touching = interpenetrating = 0
    for _ in range(400):
        vertices = []
        for index in range(3):
            pose = random_rotation(rng)
            pose[:3, 3] = rng.uniform(-0.15, 0.15, 3)
            found = contacts["6dof"].invert(pose)
            vertices.append(Vertex(f"cube_{index}", "cube", {"side": 0.1}, contact=Contact("6dof", values=found.phi)))
        depth = overlaps(SceneGraph(np.eye(4), tuple(vertices)).solids())
        touching += (depth > 0).any()  # a pair that meets has separation 0 or less; 0 exactly has probability nought
        interpenetrating += (depth > 1e-9).any()
    assert touching == interpenetrating > 50
    for _ in range(200):
        graph = tower(rng)
        depth = overlaps(graph.solids())
        for name in graph.names[1:]:
            first, second = (graph.solid_names.index(each) for each in (name, graph.vertex(name).parent))
            assert depth[first, second] < 1e-9
    assert tower(rng).degrees_of_freedom() == 15


def test_tree_queries():
    graph = figure_3("contacts")
    assert graph.names == ("floor", "green", "red", "yellow")
    assert graph.children("root") == ("floor",) and graph.children("green") == ("red",)
    assert graph.descendants("green") == ("red", "yellow") and graph.descendants("yellow") == ()
    assert graph.path("yellow", "green") == ("yellow", "red")
    with pytest.raises(ValueError):
        graph.path("green", "yellow")
    assert hash(graph.structure()) == hash(graph.with_numbers({"red.side": 0.2}).structure())
    assert graph.structure() != figure_3("free").structure()
    assert graph == figure_3("contacts") and graph != graph.with_numbers({"red.side": 0.2})
    solids = graph.solids()
    assert solids.kind.tolist() == [PLANE, BOX, BOX, BOX] and solids.kind.dtype == np.int32
    assert np.allclose(solids.size[3], 0.07) and not solids.size[0].any()
    assert np.allclose(graph.down(), graph.root_pose[:3, :3] @ [0, 0, -1])
    assert graph.with_numbers(graph.numbers()) == graph


def test_changes():
    graph = figure_3("contacts")
    renamed = graph.renamed({"green": "lime"})
    assert renamed.vertex("red").parent == "lime" and "green" not in renamed.names
    exchanged = graph.renamed({"green": "red", "red": "green"})
    assert exchanged.vertex("green").parent == "red" and exchanged.renamed({"green": "red", "red": "green"}) == graph
    assert graph.remove("red").names == ("floor", "green")
    assert graph.remove("red").add(Vertex("ball", "sphere", {"radius": 0.1})).names[-1] == "ball"


@pytest.mark.parametrize("name", ["cube_0", "cube_1", "cube_2"])
def test_nearest_contacts_keep_every_pose_in_the_world(name):
    """Of every other possible parent, and back: poses to 1e-12, the ideal contact comes back without slack."""
    rng = np.random.default_rng(2)

    def hung(graph, parent, kind):
        contact, left = graph.nearest_contact(name, parent, kind)
        assert left.outside < 1e-9 and left.angle < 1e-9
        return graph.replace(name, parent=parent, contact=contact)

    for _ in range(20):
        graph = tower(rng)
        free = hung(graph, "root", "6dof")
        assert largest_difference(graph, free) < 1e-12
        assert free.degrees_of_freedom() == graph.degrees_of_freedom() + 3
        if name != "cube_0":  # hung under the floor it floats above it: the gap is slack, and counts
            under = hung(graph, "floor", "face-to-face")
            assert largest_difference(graph, under) < 1e-12
            assert under.vertex(name).contact.values["gap"] > 0.05
            assert under.degrees_of_freedom() == graph.degrees_of_freedom() + 1
        back = hung(free, graph.vertex(name).parent, "face-to-face")
        assert largest_difference(graph, back) < 1e-12
        assert back.structure() == graph.structure()
        assert back.degrees_of_freedom() == graph.degrees_of_freedom()


def bridge(height_of_second=0.1, span=0.3, tilt=0.0):
    """Return two towers on a floor and a plank on the first that reaches over the second."""
    floor = Vertex("floor", "plane")
    first = Vertex("left", "cube", {"side": 0.1}, **on("floor", x=-0.1, y=0.0, theta=0.0))
    size = {"length": 0.1, "width": 0.1, "height": height_of_second}
    second = Vertex("right", "box", size, **on("floor", x=0.1, y=0.0, theta=0.0))
    size = {"length": span, "width": 0.08, "height": 0.02}
    reach = 0.5 * (0.1 + span)
    u = 0.5 + 0.5 * 0.1 / reach
    plank = Vertex("plank", "box", size, **on("left", theta=0.0, u=u, v=0.5, tilt_y=tilt), supports=("right",))
    return SceneGraph(np.eye(4), (floor, first, second, plank))


def test_second_support_of_a_bridge():
    contact, level = nearest_to_resting(bridge(), "plank", "right")
    assert (contact.parent_face, contact.child_face) == ("+z", "-z")
    assert abs(level.gap) < 1e-12 and level.tilt + level.angle < 1e-12 and level.outside == 0.0
    _, short = nearest_to_resting(bridge(height_of_second=0.093), "plank", "right")
    assert short.gap == pytest.approx(0.007, abs=1e-12)
    _, tilted = nearest_to_resting(bridge(tilt=0.02), "plank", "right")
    assert tilted.tilt + tilted.angle == pytest.approx(0.02)
    _, stub = nearest_to_resting(bridge(span=0.05), "plank", "right")
    assert stub.outside > 0.0


def test_what_is_not_a_graph():
    cube = Vertex("a", "cube", {"side": 0.1})
    for vertices, words in (
        ((cube, cube), "two objects are called 'a'"),
        ((Vertex("root", "cube", {"side": 0.1}),), "two objects are called 'root'"),
        ((Vertex("b", "cube", {"side": 0.1}, "a"), cube), "comes after its child"),
        ((Vertex("b", "cube", {"side": 0.1}, "c"), cube), "b.parent: the parent 'c' does not exist; choose from root"),
    ):
        with pytest.raises(DerenderError, match=words):
            SceneGraph(np.eye(4), vertices)
    with pytest.raises(DerenderError, match="no object is called"):
        SceneGraph(np.eye(4), (cube,)).vertex("aa")


def test_brute_force_agrees_on_a_whole_stack():
    """The poses of the graph, not only each contact alone: every pair with an edge is flush in the world."""
    rng = np.random.default_rng(6)
    graph = tower(rng)
    poses = graph.poses()
    for name in graph.names[1:]:
        parent = graph.vertex(name).parent
        relative = np.linalg.inv(poses[parent]) @ poses[name]
        assert contact_faults(relative, graph.body(parent), graph.body(name), "+z", 4) == []
    shifted = translation(0, 0, 1e-6) @ relative
    assert contact_faults(shifted, graph.body(parent), graph.body(name), "+z", 4) == ["hovers"]


def test_a_graph_that_grows_stands_as_one_made_whole():
    whole = bridge()
    grown = replace(whole, vertices=whole.vertices[:1])
    for vertex in whole.vertices[1:]:
        grown.poses()
        grown = grown.add(vertex)
    for name, pose in whole.poses().items():
        assert np.array_equal(grown.poses()[name], pose), name
