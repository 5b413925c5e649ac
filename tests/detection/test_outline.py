"""The convex outline against scipy's hull."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from derender.detection.outline import ends_of
from derender.scene.polygon import beyond_edges, convex_outline


@pytest.mark.parametrize("seed", range(8))
def test_corners_and_lines_are_those_of_scipys_hull(seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(int(rng.integers(3, 400)), 2)) * [1.0, 0.1]
    if seed % 2:
        points = np.round(points, 1)  # many on one edge, many twice
    hull = ConvexHull(points)
    found = convex_outline(points)
    (x, y), (next_x, next_y) = found.T, np.roll(found, -1, axis=0).T
    area = 0.5 * np.sum(x * next_y - y * next_x)
    assert area == pytest.approx(hull.volume, rel=1e-12)  # counterclockwise, the same polygon
    if seed % 2 == 0:
        assert {tuple(p) for p in found} == {tuple(p) for p in points[hull.vertices]}
    elsewhere = rng.normal(size=(50, 2))
    expected = (elsewhere @ hull.equations[:, :2].T + hull.equations[:, 2]).max(axis=1)
    np.testing.assert_allclose(beyond_edges(elsewhere, found), expected, atol=1e-12)


@pytest.mark.parametrize("count", [9, 900])
def test_points_on_a_line_have_no_outline(count):
    line = np.linspace(0.0, 1.0, count)[:, None] * [1.0, 0.3]
    assert convex_outline(line) is None
    assert convex_outline(line[:2]) is None
    assert convex_outline(np.ones((count, 2))) is None


@pytest.mark.parametrize("seed", range(20))
def test_pixels_of_a_floor_lie_within_their_outline(seed):
    """Those along the image's border lie on lines but for rounding, which once turned edges to face inwards."""
    tilt = np.random.default_rng(seed).uniform(0.3, 1.2)
    rays = np.stack([*np.meshgrid(np.linspace(-0.6, 0.6, 160), np.linspace(-0.45, 0.45, 120)), np.ones((120, 160))], -1)
    normal, along = np.array([0.0, -np.cos(tilt), -np.sin(tilt)]), np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    depth = -0.6 / (rays @ normal)
    points = (depth[..., None] * rays)[depth > 0.0][::6]
    flat = np.stack([points[:, 0], points @ along], axis=-1)
    assert beyond_edges(flat, convex_outline(flat)).max() < 1e-9 * np.ptp(flat)


@pytest.mark.parametrize("shape", [(1,), (2, 3), (3,), (50, 3), (333, 2)])
def test_the_ends_of_points_are_numpys_quantiles(shape):
    values = np.random.default_rng(3).normal(size=shape)
    np.testing.assert_allclose(ends_of(values, 0.02), np.quantile(values, [0.02, 0.98], axis=0))
