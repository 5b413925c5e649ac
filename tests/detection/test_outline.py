"""The convex outline against scipy's hull."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from derender.detection.outline import convex_outline, outline_planes


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
    planes = outline_planes(found)
    np.testing.assert_allclose((elsewhere @ planes[:, :2].T + planes[:, 2]).max(axis=1), expected, atol=1e-12)


def test_points_on_a_line_have_no_outline():
    line = np.linspace(0.0, 1.0, 9)[:, None] * [1.0, 0.3]
    assert convex_outline(line) is None
    assert convex_outline(line[:2]) is None
    assert convex_outline(np.ones((5, 2))) is None
