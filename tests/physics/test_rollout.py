"""Rollouts against mechanics: sliding, pushing, bouncing, colliding with given numbers."""

import numpy as np
import pytest
from test_simulate import FLOOR, cube, matter

from derender.physics.bodies import Body, bounce_damping, pair_frictions, restitution_of
from derender.physics.intervention import Push
from derender.physics.simulate import Rollout
from derender.scene.pose import translation


def test_a_rollout_takes_its_numbers_at_each_call():
    run = Rollout(matter(FLOOR, cube("a", 0, 0.05), supports=[("a", "floor")]))
    times = np.linspace(0, 1, 11)
    for speed, friction in ((0.5, 0.3), (1.0, 0.5), (0.5, 0.3)):
        poses = run(times, velocity={"a": (speed, 0, 0)}, friction={"a": friction})
        assert poses.shape == (11, 1, 4, 4) and run.names == ("a",)
        assert poses[-1, 0, 0, 3] == pytest.approx(speed**2 / (2 * friction * 9.81), abs=3e-4)
        assert np.abs(poses[:, 0, 2, 3] - 0.05).max() < 3e-4  # it does not hop
    np.testing.assert_array_equal(run(times)[:, 0, 0, 3], run(times)[:, 0, 0, 3])
    assert abs(run(times)[-1, 0, 0, 3]) < 1e-6


@pytest.mark.parametrize("friction", [0.3, 0.8])
def test_the_push_that_slides_a_box_is_its_weight_times_friction(friction):
    run = Rollout(matter(FLOOR, cube("a", 0, 0.05, friction=friction), supports=[("a", "floor")]))
    limit = friction * 0.5 * 9.81
    for share, slides in ((0.98, False), (1.02, True)):
        end = run([1.0], pushes=[Push("a", np.array([share * limit, 0, 0]), 0.0, 1.0)])[0, 0, 0, 3]
        assert bool(end > 2e-3) is slides


@pytest.mark.parametrize("elasticity", [0.0, 0.2, 0.5, 0.8])
@pytest.mark.parametrize("height", [0.05, 0.3, 1.0])
def test_restitution_is_that_stated(elasticity, height):
    ball = Body("ball", "sphere", np.full(3, 0.07), translation(0, 0, height + 0.035))
    run = Rollout(matter(FLOOR, ball), timestep=0.00025, keep_contacts=False)
    times = np.arange(0, 1.2, 0.0005)
    z = run(times, elasticity={"ball": elasticity})[:, 0, 2, 3] - 0.035
    speed = np.gradient(z, times)
    landed = np.flatnonzero(z < 0)[0]
    measured = max(speed[landed:].max(), 0.0) / np.sqrt(2 * 9.81 * height)
    assert measured == pytest.approx(elasticity, abs=0.03 if elasticity else 0.05)


def test_masses_and_gravity_are_arguments():
    left, right = cube("left", 0, 0.05, friction=0.0), cube("right", 0.12, 0.05, friction=0.0)
    run = Rollout(matter(FLOOR, left, right, supports=[("left", "floor"), ("right", "floor")]))
    for mass in (0.1, 2.0):
        poses = run([0.3, 0.5], velocity={"left": (1, 0, 0)}, mass={"left": 0.5, "right": mass})
        speeds = (poses[1, :, 0, 3] - poses[0, :, 0, 3]) / 0.2
        # momentum is kept, whatever the masses
        assert 0.5 * speeds[0] + mass * speeds[1] == pytest.approx(0.5, rel=0.02)
    falling = Rollout(matter(cube("a", 0, 1.0)))([0.2], gravity=(0, 0, -1.62))
    assert falling[0, 0, 2, 3] == pytest.approx(1 - 0.5 * 1.62 * 0.04, abs=2e-4)
    turned = Rollout(matter(cube("a", 0, 1.0)))([0.1], angular_velocity={"a": (0, 0, 2.0)})
    assert np.arctan2(turned[0, 0, 1, 0], turned[0, 0, 0, 0]) == pytest.approx(0.2, abs=1e-3)


def test_friction_of_a_pair_is_the_geometric_mean_and_one_that_says_nothing_takes_the_others():
    nan = np.nan
    said = pair_frictions(np.array([0.2, 0.4, nan, nan, 0.0]), np.array([0.8, nan, 0.3, nan, 0.5]))
    np.testing.assert_allclose(said, [0.4, 0.4, 0.3, 0.8, 0.0])


def test_the_damping_of_a_bounce_is_the_inverse_of_its_restitution():
    for elasticity in (0.1, 0.5, 0.9):
        assert restitution_of(bounce_damping(elasticity, 60.0, 0.0025), 60.0, 0.0025) == pytest.approx(
            elasticity, abs=2e-3
        )
