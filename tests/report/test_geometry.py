"""Meshes are closed, face outwards and have the volume of what they stand for."""

import numpy as np
import pytest

from derender.report.geometry import SECTIONS, plane_patch, solid_mesh
from derender.scene.solids import BOX, CYLINDER, PLANE, SPHERE, Solids

SIZE = np.array([0.1, 0.1, 0.25])


def signed_volume(vertices, triangles):
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    return float(np.sum(a * np.cross(b, c))) / 6


@pytest.mark.parametrize(
    ("kind", "size", "volume"),
    [
        (BOX, SIZE, np.prod(SIZE)),
        # A prism of n sides has the share sin(2 pi / n) n / 2 pi of its circle.
        (CYLINDER, SIZE, np.prod(SIZE) * SECTIONS / 8 * np.sin(2 * np.pi / SECTIONS)),
        (SPHERE, np.full(3, 0.2), np.pi / 6 * 0.2**3),
    ],
)
def test_meshes_are_closed_and_face_outwards(kind, size, volume):
    solids = Solids(np.array([kind], np.int32), np.eye(4)[None], size[None], np.array([-1], np.int32))
    vertices, triangles = solid_mesh(solids, 0)
    edges = {}
    for triangle in triangles:
        for a, b in zip(triangle, np.roll(triangle, -1), strict=True):
            edges[a, b] = edges.get((a, b), 0) + 1
    # Closed and consistently turned: each edge is walked once in each direction.
    assert all(count == 1 and edges.get((b, a)) == 1 for (a, b), count in edges.items())
    tolerance = 0.01 if kind == SPHERE else 1e-12
    assert signed_volume(vertices, triangles) == pytest.approx(volume, rel=tolerance)
    np.testing.assert_allclose(np.ptp(vertices, axis=0), size, rtol=1e-9)


def test_a_plane_is_drawn_under_the_scene():
    pose = np.tile(np.eye(4), (2, 1, 1))
    pose[1, :3, 3] = [3.0, 4.0, 0.05]
    solids = Solids(np.array([PLANE, BOX], np.int32), pose, np.array([[0, 0, 0], [0.1] * 3]), np.full(2, -1, np.int32))
    middle, half = plane_patch(solids, 0)
    np.testing.assert_allclose(middle[:3, 3], [3.0, 4.0, 0.0])
    assert half == pytest.approx(0.1)
    middle, half = plane_patch(solids, 0, np.array([[1.0, 4.0, 2.0]]))
    np.testing.assert_allclose(middle[:3, 3], [2.0, 4.0, 0.0])
    vertices, _ = solid_mesh(solids, 0, np.array([[1.0, 4.0, 2.0]]))
    assert np.ptp(vertices[:, 0]) == pytest.approx(2 * half)
    np.testing.assert_allclose(vertices.mean(axis=0), middle[:3, 3])  # in the plane's own axes
