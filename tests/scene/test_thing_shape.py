"""Free-form things: their surface survives text, files and drawing; a damaged one is told."""

import numpy as np
import pytest
from on_floor import face, on_floor

from derender.camera.intrinsics import Camera
from derender.document import document_text, read_document
from derender.errors import DerenderError
from derender.render.raycast.depth import render_depth
from derender.scene.graph import Vertex
from derender.scene.shapes import shapes
from derender.scene.shapes.mesh import decode_surface, encode_surface

CAMERA = Camera.from_field_of_view(64, 48)


def lumpy():
    """Return a closed surface that is no primitive: a ball with a waist, off the origin."""
    import trimesh

    ball = trimesh.creation.icosphere(2, 0.05)
    return ball.vertices * [1.0, 1.0, 1.4] * (1.0 - 0.3 * np.exp(-((ball.vertices[:, 2:] / 0.02) ** 2))), ball.faces


def scene():
    vertices, triangles = lumpy()
    text, size, _ = encode_surface(vertices, triangles)
    numbers = dict(zip(("length", "width", "height"), map(float, size), strict=True))
    thing = Vertex("thing_1", "thing", numbers, "floor", face(x=0.01, theta=0.3), {"surface": text})
    return on_floor(thing, distance=0.6)


def test_a_surface_is_what_it_was_to_a_hundredth_of_a_millimetre():
    vertices, triangles = lumpy()
    text, size, centre = encode_surface(vertices, triangles)
    again, faces = decode_surface(text)
    assert np.array_equal(faces, triangles)
    assert np.abs(again * size + centre - vertices).max() < 1e-5
    assert np.allclose(np.ptp(again, axis=0), 1.0)


def test_a_thing_is_drawn_and_survives_a_scene_file(tmp_path):
    graph = scene()
    depth, label = render_depth(graph.solids(), CAMERA)
    assert (label == 1).sum() > 50
    assert depth[label == 1].min() == pytest.approx(0.6 - graph.body("thing_1").size()[2], abs=3e-3)
    (tmp_path / "scene.yaml").write_text(document_text(graph, CAMERA))
    again = read_document(tmp_path / "scene.yaml").prior.sample(np.random.default_rng(0))
    assert np.array_equal(render_depth(again.solids(), CAMERA)[1], label)


@pytest.mark.parametrize("text", ["x", "eJwDAAAAAAE=", "%%%"])
def test_a_damaged_surface_is_told(text):
    with pytest.raises(DerenderError, match="damaged"):
        shapes["thing"].mesh((0.1, 0.1, 0.1), {"surface": text})


def test_without_a_surface_it_is_its_box():
    assert shapes["thing"].mesh((0.1, 0.2, 0.3)).volume == pytest.approx(0.006)
