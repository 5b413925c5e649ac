"""What a scene file says, and the one line about what it says wrong."""

import math
from pathlib import Path

import numpy as np
import pytest

from derender.document import document_from, document_text, read_document, read_prior_document, write_document
from derender.errors import DerenderError
from derender.scene.codec.yaml_tree import parse_yaml

DESIGN = """
derender: 1
camera: {fx: 150, fy: 150, cx: 79.5, cy: 59.5, width: 160, height: 120}
root: {position: [0, 0.2, 0.9], quat_wxyz: [0.5, -0.866, 0, 0]}
objects:
  floor: {shape: plane, contact: {type: 6dof}}
  red:   {shape: {type: cube, side: 0.10}, parent: floor, contact: {type: face-to-face, x: 0.02, y: 0.0, theta: 20 deg}}
  green: {shape: {type: cube, side: {uniform: [0.05, 0.12]}}, parent: red,
          contact: {type: face-to-face, parent_face: +z, child_face: -z, theta: {uniform: [0, 90 deg]}, u: {uniform: [0, 1]}, v: {uniform: [0, 1]}}}
likelihood: {type: gaussian, sigma: 0.005, blur: 1.0}
"""  # noqa: E501  (the example as the design has it)

SCENE = """derender: 1
objects:
  floor: {shape: plane, contact: {type: 6dof}}
  red: {shape: {type: cube, side: 0.1}, parent: floor, contact: {type: face-to-face, theta: 0.1, x: 0.2, y: 0}}
  green: {shape: {type: cube, side: 0.1}, parent: red, contact: {type: face-to-face, theta: 0.1, u: 0.2, v: 0.3}}
"""


def read(text, folder="."):
    return document_from(parse_yaml(text, "bad.yaml"), Path(folder))


def test_the_design_example():
    document = read(DESIGN)
    free = document.prior.free_addresses(document.prior.sample(np.random.default_rng(0)))
    assert list(free) == ["green.side", "green.contact.theta", "green.contact.u", "green.contact.v"]
    assert free["green.contact.theta"].support == (0.0, math.pi / 2)
    graph = document.prior.sample(np.random.default_rng(1))
    red = graph.vertex("red").contact
    assert (red.parent_face, red.child_face) == ("+z", "-z") and red.values["theta"] == pytest.approx(math.radians(20))
    assert document.camera.fx == 150 and dict(document.likelihood.values) == {"sigma": 0.005, "blur": 1.0}
    assert not document.is_scene
    with pytest.raises(DerenderError, match="this is a prior, not a scene"):
        _ = document.graph


def test_a_scene_is_written_and_read_whole(tmp_path):
    text = SCENE + "constraints: [{does-not-touch: {objects: [floor, green], margin: 1 cm}}]\n"
    text = text.replace("parent: red,", "parent: red, supports: [floor], mass: 200 g, colour: [1, 0.5, 0],")
    graph = read(text).graph
    write_document(tmp_path / "a.yaml", graph, made={"seed": 3, "command": 'derender sample it\'s "so"'})
    again = read_document(tmp_path / "a.yaml")
    assert again.graph == graph and again.made["command"] == 'derender sample it\'s "so"'
    green = again.graph.vertex("green")
    assert green.supports == ("floor",) and green.options == {"mass": 0.2, "colour": (1.0, 0.5, 0.0)}
    assert again.graph.constraints[0].margin == 0.01


def test_a_place_as_near_to_the_middle_as_it_likes_comes_back():
    """A chain came within a tenth of a micrometre of it, and what it had drawn could not be read any more."""
    graph = read(SCENE.replace("x: 0.2", "x: 1.37224e-7")).graph
    assert read(document_text(graph)).graph == graph


def test_a_pose_that_no_quaternion_holds_is_written_as_a_matrix():
    graph = read(SCENE).graph
    rng = np.random.default_rng(0)
    from dataclasses import replace

    from derender.scene.pose import random_rotation

    kept = 0
    for _ in range(30):
        moved = replace(graph, root_pose=random_rotation(rng) @ random_rotation(rng))
        assert np.array_equal(read(document_text(moved)).graph.root_pose, moved.root_pose)
        kept += "pose:" in document_text(moved)
    assert kept > 0


def test_a_mesh_is_named_relative_to_the_file(tmp_path):
    import trimesh

    (tmp_path / "meshes").mkdir()
    trimesh.creation.box((0.1, 0.06, 0.04)).export(tmp_path / "meshes" / "brick.ply")
    text = "derender: 1\nobjects:\n  a: {shape: {type: mesh, file: meshes/brick.ply, scale: {uniform: [0.9, 1.1]}}}\n"
    (tmp_path / "prior.yaml").write_text(text)
    graph = read_document(tmp_path / "prior.yaml").prior.sample(np.random.default_rng(0))
    write_document(tmp_path / "scene.yaml", graph)
    assert "file: meshes/brick.ply" in (tmp_path / "scene.yaml").read_text()
    assert read_document(tmp_path / "scene.yaml").graph == graph
    for wrong, says in (("meshes/nothing.ply", "cannot read the mesh"), ("prior.yaml", "not a mesh")):
        with pytest.raises(DerenderError, match=says) as caught:
            read(text.replace("meshes/brick.ply", wrong), tmp_path)
        assert "objects.a.shape.file" in str(caught.value)


FAULTS = [
    ("green: {shape", "red: {shape", "the key 'red' stands here for the second time"),
    ("parent: red", "parent: rod", "'rod' is no choice here; did you mean 'red'?"),
    ("parent: floor", "parent: green", "the parents go round in a circle: red on green on red"),
    ("parent: red", "parent: green", "green rests on itself"),
    ("side: 0.1}, parent: floor", "side: -0.1}, parent: floor", "side is -0.1, out of range"),
    ("side: 0.1}, parent: floor", "side: 0}, parent: floor", "side is 0, out of range"),
    ("side: 0.1}, parent: floor", "side: '0.1'}, parent: floor", "stands in quotes and so is text; write 0.1"),
    ("side: 0.1}, parent: floor", "side: 1e-1}, parent: floor", "write 1.0e-1"),
    ("side: 0.1}, parent: floor", "sied: 0.1}, parent: floor", "did you mean 'side'?"),
    ("side: 0.1}, parent: floor", "side: {unifrom: [0, 1]}}, parent: floor", "did you mean 'uniform'?"),
    ("side: 0.1}, parent: floor", "side: {uniform: [1, 0]}}, parent: floor", "lower 1 is not below upper 0"),
    ("side: 0.1}, parent: floor", "side: {normal: [0.1, 0.1]}}, parent: floor", "leaves the range"),
    ("side: 0.1}, parent: floor", "side: {poisson: 3}}, parent: floor", "no distribution over a length"),
    ("side: 0.1}, parent: floor", "side: 10 deg}, parent: floor", "write a number and m or cm or mm, such as 10 mm"),
    ("type: cube", "type: cubus", "did you mean 'cube'?"),
    ("shape: plane", "shape: plain", "did you mean 'plane'?"),
    ("u: 0.2", "u: 1.2", "u is 1.2, out of range; u lies in [0, 1]"),
    ("u: 0.2", "w: 0.2", "objects.green.contact.w: this key is unknown here"),
    ("theta: 0.1, u", "parent_face: +w, theta: 0.1, u", "the parent_face '+w' of a cube has no face-to-face contact"),
    (
        "{type: face-to-face, theta: 0.1, u: 0.2, v: 0.3}",
        "{type: 6dof}",
        "a cube cannot be in 6dof contact with a cube",
    ),
    (", contact: {type: face-to-face, theta: 0.1, u: 0.2, v: 0.3}", "", "the contact is missing"),
    ("derender: 1", "derender: 2", "this version reads format 1; take a newer derender"),
    ("derender: 1", "made: {}", "begin it with derender: 1"),
    ("objects:", "objets:", "did you mean 'objects'?"),
    ("floor: {shape", "root: {shape", "'root' cannot name an object"),
    ("floor: {shape", "a.b: {shape", "'a.b' cannot name an object"),
    ("derender: 1", "derender: 1\nconstraints: [does-not-touch]", "write does-not-touch: [a, b]"),
    ("derender: 1", "derender: 1\nconstraints: [{does-not-touch: [red, rod]}]", "did you mean 'red'?"),
    ("derender: 1", "derender: 1\nconstraints: [no-overlop]", "did you mean 'no-overlap'?"),
    ("derender: 1", "derender: 1\nlikelihood: {type: gaussian, sigma: 0}", "sigma is 0, out of range"),
    ("derender: 1", "derender: 1\nlikelihood: {type: gauss}", "did you mean 'gaussian'?"),
    ("derender: 1", "derender: 1\ncamera: {fx: 1, fy: 1, cx: 1, cy: 1, width: 0, height: 1}", "give at least 1"),
    (
        "derender: 1",
        "derender: 1\ncamera: {fx: -1, fy: 1, cx: 1, cy: 1, width: 4, height: 1}",
        "give a positive number",
    ),
    (
        "derender: 1",
        "derender: 1\nroot: {position: [0, 0, 1], quat_wxyz: [1, 1, 0, 0]}",
        "the quaternion has length 1.41",
    ),
    ("derender: 1", "derender: 1\nroot: {distance: -1, elevation: 0.5}", "the distance is not positive"),
    ("derender: 1", "derender: 1\nroot: {distance: 1, elevation: 100 deg}", "the elevation leaves"),
    ("derender: 1", "derender: 1\nroot: {pose: [[1,0,0,0],[0,1,0,0],[0,0,2,0],[0,0,0,1]]}", "no rigid pose"),
    ("derender: 1", "derender: 1\nshapes: {}", "shapes belongs to a file with structure:"),
]


@pytest.mark.parametrize("old,new,says", FAULTS)
def test_faults_are_one_helpful_line(old, new, says):
    assert old in SCENE
    with pytest.raises(DerenderError) as caught:
        _ = read(SCENE.replace(old, new, 1)).graph
    line = str(caught.value)
    assert says in line and line.startswith("bad.yaml") and "\n" not in line, line


GRAMMAR_FAULTS = [
    ("poisson: 2.5", "poisson: 1000000000", "mean 1e+09 is not in (0, 1e4]"),
    ("poisson: 2.5", "uniform-integer: [-1, 3]", "no distribution over how many"),
    ("floor: {poisson: 2.5}", "floor: 1000000000", "give at most 1000"),
    ("floor: {poisson", "flor: {poisson", "did you mean 'floor'?"),
    ("cube: {geometric: 0.2}", "cube: {geometric: 0.9}", "the grammar is not consistent"),
    ("type: grammar", "type: gramar", "did you mean 'grammar'?"),
    ("x: {normal: [0, 0.1]}, ", "", "x of the contact is missing; add x: ..."),
    ("sphere: {weight: 0.5, radius", "sphere: {weight: -1, radius", "give at least 0"),
    ("standing: {type: face-to-face", "standing: {type: face-to-fase", "did you mean 'face-to-face'?"),
]


@pytest.mark.parametrize("old,new,says", GRAMMAR_FAULTS)
def test_faults_of_open_priors_are_one_helpful_line(old, new, says):
    from derender import data_path

    text = data_path("priors/grammar.yaml").read_text()
    assert old in text
    text = text.replace(old, new) if not new else text.replace(old, new, 1)
    with pytest.raises(DerenderError) as caught:
        read(text).prior.sample(np.random.default_rng(0))
    assert says in str(caught.value) and str(caught.value).startswith("bad.yaml"), str(caught.value)


def test_two_thousand_objects_are_too_many():
    lines = "".join(f"  o{i}: {{shape: plane}}\n" for i in range(2001))
    with pytest.raises(DerenderError, match="2001 objects are too many"):
        read("derender: 1\nobjects:\n" + lines)


def test_a_built_in_prior_has_a_name():
    assert read_prior_document("tabletop").camera.width == 160
    with pytest.raises(DerenderError, match="did you mean 'tabletop'"):
        read_prior_document("tabeltop")
