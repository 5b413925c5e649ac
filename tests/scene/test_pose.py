"""Poses and quaternions against scipy, and against their own definitions."""

import math

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from derender.scene import pose as p


def random_pose(rng):
    pose = p.random_rotation(rng)
    pose[:3, 3] = rng.standard_normal(3)
    return pose


@pytest.mark.parametrize("axis", "xyz")
def test_rotations_about_axes(axis):
    for angle in (-2.0, 0.0, 0.3, math.pi):
        expected = Rotation.from_euler(axis, angle).as_matrix()
        assert np.abs(getattr(p, f"rotation_{axis}")(angle)[:3, :3] - expected).max() < 1e-15


def test_inverse():
    rng = np.random.default_rng(1)
    poses = np.stack([random_pose(rng) for _ in range(20)])
    assert np.abs(p.inverse(poses) @ poses - np.eye(4)).max() < 1e-14
    assert np.array_equal(p.inverse(poses[3]), p.inverse(poses)[3])


def test_quaternions_agree_with_scipy_and_round_trip_near_half_turns():
    rng = np.random.default_rng(2)
    for k in range(300):
        vector = rng.standard_normal(3)
        if k % 3 == 0:  # half turns, about the axes too, are where a naive formula loses all digits
            vector = np.eye(3)[k % 9 // 3] if k % 2 else vector
            vector *= (math.pi - 10.0 ** -(k % 17)) / np.linalg.norm(vector)
        rotation = Rotation.from_rotvec(vector)
        quat = p.quaternion(rotation.as_matrix())
        expected = np.roll(rotation.as_quat(), 1)
        assert quat[0] >= 0 and abs(np.linalg.norm(quat) - 1) < 1e-15
        assert min(np.abs(quat - expected).max(), np.abs(quat + expected).max()) < 1e-14
        assert np.abs(p.from_quaternion(quat)[:3, :3] - rotation.as_matrix()).max() < 1e-14


def test_from_quaternion_normalises_and_refuses_zero():
    assert np.allclose(p.from_quaternion((2, 0, 0, 0), (1, 2, 3)), p.translation(1, 2, 3), atol=0)
    with pytest.raises(ValueError):
        p.from_quaternion((0, 0, 0, 0))


def test_rotation_vectors():
    rng = np.random.default_rng(3)
    for _ in range(100):
        vector = rng.standard_normal(3)
        vector *= rng.uniform(0, math.pi) / np.linalg.norm(vector)
        rotation = p.from_rotation_vector(vector)
        assert np.abs(rotation[:3, :3] - Rotation.from_rotvec(vector).as_matrix()).max() < 1e-14
        assert np.abs(p.rotation_vector(rotation) - vector).max() < 1e-12
    tiny = np.array([1e-200, 0.0, 0.0])
    assert np.array_equal(p.rotation_vector(p.from_rotation_vector(tiny)), tiny)


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.9e-4, 1.1e-4, 0.1, 2.0])
def test_twist_exp_is_the_matrix_exponential(size):
    rng = np.random.default_rng(4)
    v, w = rng.standard_normal((2, 3))
    w *= size / np.linalg.norm(w)
    generator = np.zeros((4, 4))
    generator[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
    generator[:3, 3] = v
    # Just above the switch (1 - cos a) / a^2 has lost eight of its sixteen digits, and counts with a = 1e-4.
    assert np.abs(p.twist_exp(v, w) - expm(generator)).max() < 2e-12


def test_random_rotation_is_haar():
    """Under Haar measure the trace has mean 0 and mean square 1: five standard errors."""
    rng = np.random.default_rng(5)
    traces = np.array([np.trace(p.random_rotation(rng)[:3, :3]) for _ in range(4000)])
    assert abs(traces.mean()) < 5 / math.sqrt(4000)
    assert abs((traces**2).mean() - 1) < 5 * traces.var() * math.sqrt(2) / math.sqrt(4000) + 0.02


def test_rotation_angle():
    first, second = p.rotation_x(0.3), p.rotation_x(0.3) @ p.rotation_y(0.2)
    assert p.rotation_angle(first, second) == pytest.approx(0.2, abs=1e-15)
    assert p.rotation_angle(first, first[:3, :3]) == 0.0
