"""What counts as having moved and as being at rest; bodies that float or overlap."""

import numpy as np
import pytest
from test_simulate import FLOOR, GRAVITY, cube, matter

from derender.evaluation.metrics import floating, gaps, intersecting
from derender.physics.bodies import Body, Matter
from derender.physics.simulate import simulate
from derender.physics.statics import ROLLING
from derender.physics.verdict import Fate, Trajectory
from derender.scene.pose import rotation_x, translation


@pytest.mark.parametrize(
    ("moved", "degrees", "gone"), [(0.09, 0.0, False), (0.11, 0.0, True), (0.0, 9.0, False), (0.0, 11.0, True)]
)
def test_a_body_has_moved_by_a_tenth_of_its_extent_or_ten_degrees(moved, degrees, gone):
    pose = translation(moved * 0.2, 0, 0) @ rotation_x(np.deg2rad(degrees))
    poses = np.stack([np.eye(4), pose])[:, None]
    trajectory = Trajectory(("a",), np.full((1, 3), 0.2), np.array([0.0, 1.0]), poses)
    assert bool(trajectory.first_moved()) == gone


def test_what_begins_slowly_is_not_at_rest():
    """A ball on a slope little steeper than resistance to rolling holds takes seconds to roll by its own size."""
    ball = Body("ball", "sphere", np.full(3, 0.1), translation(0, 0, 0.05))
    floor = Body("floor", "plane", np.zeros(3), np.eye(4))
    for slope, rests in ((1.1, False), (0.1, True)):
        slope *= 2 * ROLLING
        gravity = 9.81 * np.array([np.sin(slope), 0.0, -np.cos(slope)])
        trajectory = simulate(Matter((ball, floor), gravity, ()), 2.0, early=True)
        assert bool(trajectory.times[-1] < 1.0) == rests == (trajectory.greatest_displacement()["ball"] < 1e-4)


@pytest.mark.parametrize(("speed", "rests"), [(0.0005, True), (0.003, False)])
def test_what_creeps_on_a_lean_rests_and_what_a_thousandth_of_gravity_would_have_moved_so_far_does_not(speed, rests):
    """Flat blocks that had settled were never at rest by their least side, and were said to fall."""
    block = Body("block", "box", np.array([0.075, 0.025, 0.015]), translation(0, 0, 0.0075))
    fate = Fate(Matter((FLOOR, block), GRAVITY, ()), 0.015)
    times = np.arange(0.0, 1.0, 0.02)
    poses = np.tile(block.pose, (len(times), 1, 1, 1))
    poses[:, 0, 0, 3] = speed * times
    assert fate.at_rest(times, poses) == rests
    assert not fate.at_rest(times[:10], poses[:10])  # too early to say


def test_gaps_floating_and_intersecting():
    scene = matter(FLOOR, cube("a", 0, 0.05), cube("b", 0.09, 0.052), cube("c", 0.3, 0.07), cube("d", 0, 0.153))
    found = gaps(scene, 0.03)
    assert found["floor", "c"] == pytest.approx(0.02) and found["a", "b"] == pytest.approx(-0.01)
    assert floating(scene) == ["c"]
    assert floating(scene, tolerance=0.0005) == ["c", "d"]
    assert [(a, b) for a, b, _ in intersecting(scene)] == [("a", "b")]
    assert intersecting(scene)[0][2] == pytest.approx(0.01)
    assert floating(matter(cube("a", 0, 0.05))) == ["a"]
    # Two that touch each other and nothing else float together.
    assert floating(matter(FLOOR, cube("a", 0, 0.25), cube("b", 0, 0.35))) == ["a", "b"]
    assert floating(matter(FLOOR, gravity=GRAVITY)) == []
