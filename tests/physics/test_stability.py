"""Floating and overlapping bodies."""

import pytest
from test_simulate import FLOOR, GRAVITY, cube, matter

from derender.evaluation.metrics import floating, gaps, intersecting


def test_gaps_floating_and_intersecting():
    scene = matter(FLOOR, cube("a", 0, 0.05), cube("b", 0.09, 0.052), cube("c", 0.3, 0.07), cube("d", 0, 0.153))
    found = gaps(scene)
    assert found["floor", "c"] == pytest.approx(0.02) and found["a", "b"] == pytest.approx(-0.01)
    assert floating(scene) == ["c"]
    assert floating(scene, tolerance=0.0005) == ["c", "d"]
    assert [(a, b) for a, b, _ in intersecting(scene)] == [("a", "b")]
    assert intersecting(scene)[0][2] == pytest.approx(0.01)
    assert floating(matter(cube("a", 0, 0.05))) == ["a"]
    # Two that touch each other and nothing else float together.
    assert floating(matter(FLOOR, cube("a", 0, 0.25), cube("b", 0, 0.35))) == ["a", "b"]
    assert floating(matter(FLOOR, gravity=GRAVITY)) == []
