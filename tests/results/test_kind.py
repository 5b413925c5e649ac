"""Range and disparity are told from depth by the plane that fills most of an image; depth is never taken for them."""

import numpy as np
import pytest
from on_floor import face, on_floor

from derender.camera.intrinsics import Camera
from derender.render.raycast.depth import render_depth
from derender.results.check import plane_shares, wrong_kind
from derender.results.fit import flat_noise
from derender.scene.graph import Vertex

CAMERA = Camera.from_field_of_view(160, 120)
SIZES = {"length": 0.1, "width": 0.14, "height": 0.12}


def image(elevation, sigma=0.003, boxes=3):
    solids = [Vertex(f"box_{k}", "box", SIZES, "floor", face(x=0.2 * k - 0.2, theta=0.5)) for k in range(boxes)]
    graph = on_floor(*solids, elevation=elevation, distance=0.9, lower=0.05)
    depth = render_depth(graph.solids(), CAMERA)[0]
    depth = np.where(depth < 4.0, depth, np.nan)
    return depth * (1.0 + np.random.default_rng(0).normal(0.0, sigma, depth.shape))


def rays():
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    across, down = (columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy
    return np.sqrt(1.0 + across**2 + down**2)


def words_of(seen):
    return [doubt.words for doubt in wrong_kind(seen, CAMERA, flat_noise(seen))]


@pytest.mark.parametrize("elevation", [20, 40, 60, 90])
def test_depth_is_depth(elevation):
    assert words_of(image(elevation)) == [] and words_of(image(elevation, 0.02)) == []


@pytest.mark.parametrize("elevation", [40, 60, 90])
def test_range_is_told(elevation):
    (words,) = words_of(image(elevation) * rays())
    assert words.startswith("the numbers look like distances along the rays (range)")


@pytest.mark.parametrize("elevation", [20, 40, 60])
def test_disparity_is_told(elevation):
    (words,) = words_of(0.5 / image(elevation))
    assert words.startswith("the numbers look like disparities")


def test_a_depth_buffer_is_told():
    """That of a simulator was taken for metres, and two things of it were trusted."""
    near, far, seen = 0.1, 5.0, image(20, 0.0)
    (words,) = words_of(np.where(seen < 3.0, far * (1.0 - near / seen) / (far - near), 1.0))
    assert words.startswith("the numbers end in exactly 1") and "OpenGL" in words
    assert words_of(np.where(seen < 3.0, seen, np.nan) / 3.0) == []  # metres that end near 1


def test_a_plane_has_its_share_in_any_units():
    seen = image(40, 0.0, 0)
    assert plane_shares(seen, CAMERA, flat_noise(seen))["depth"] == 1.0
    assert plane_shares(7.0 * seen, CAMERA, flat_noise(7.0 * seen))["depth"] == 1.0
    for kind, other in (("range", seen * rays()), ("disparity", 0.5 / seen)):
        shares = plane_shares(other, CAMERA, flat_noise(seen))
        assert shares[kind] == 1.0 and max(share for name, share in shares.items() if name != kind) < 0.9
    assert words_of(np.full((120, 160), np.nan)) == []


def test_depths_taken_from_65535_are_told():
    """Such an image is a plane far away, where a solid is a hole that noise of centimetres explains."""
    (words,) = words_of(65.535 - image(40))
    assert words.startswith("the numbers lie about 64") and "65535 - number" in words
    assert words_of(30.0 * image(60)) == []  # far, and as it is
