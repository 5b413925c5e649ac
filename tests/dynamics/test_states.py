"""Bodies that lie on a plane begin flush with it and stay so; a held pose is one measurement."""

import numpy as np

from derender.dynamics.engine import Engine, Scales
from derender.dynamics.motion import HELD_WITHIN, motion_of
from derender.dynamics.parameters import Parameters, read_dynamics_prior
from derender.dynamics.shooting import Shooting
from derender.dynamics.states import flush, from_poses, moved, plane_under, to_poses, ways_of
from derender.physics.bodies import Body, Matter
from derender.scene.pose import from_rotation_vector, inverse

BOX = Body("box", "box", np.array([0.08, 0.07, 0.05]), np.eye(4))


def lying(rng):
    """Return a plane, and a box on it that is off by some millimetres and degrees and moves."""
    plane = from_rotation_vector(rng.normal(0, 1, 3))
    plane[:3, 3] = rng.normal(0, 1, 3)
    pose = np.eye(4)
    pose[2, 3] = BOX.size[2] / 2
    pose = plane @ pose @ from_rotation_vector([0, 0, rng.uniform(0, 3)])
    state = moved(
        from_poses(pose), np.concatenate([rng.normal(0, 1e-3, 3), rng.normal(0, 0.01, 3), rng.normal(0, 1, 6)])
    )
    return plane, state


def corners(plane, state):
    """Return the heights of a box's corners above a plane (8,)."""
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1)
    points = BOX.size[:, None] / 2 * signs
    pose = inverse(plane) @ to_poses(state)
    return pose[2, :3] @ points + pose[2, 3]


def test_a_flush_state_touches_with_four_corners_and_does_not_leave():
    rng = np.random.default_rng(0)
    for _ in range(20):
        plane, state = lying(rng)
        result, metres, radians = flush(BOX, plane, state)
        heights = np.sort(corners(plane, result))
        np.testing.assert_allclose(heights[:4], 0.0, atol=1e-12)
        np.testing.assert_allclose(heights[4:], BOX.size[2], atol=1e-12)
        assert abs(result[7:10] @ plane[:3, 2]) < 1e-12
        assert 0 < metres < 0.006 and 0 < radians < 0.06
        np.testing.assert_allclose(flush(BOX, plane, result)[0], result, atol=1e-12)


def test_changes_along_the_plane_keep_it_flush_and_others_do_not():
    rng = np.random.default_rng(1)
    plane, state = lying(rng)
    state = flush(BOX, plane, state)[0]
    ways = ways_of(plane, state)
    for _ in range(10):
        after = moved(state, ways @ rng.normal(0, 0.1, 6))
        np.testing.assert_allclose(flush(BOX, plane, after)[0], after, atol=1e-9)
    wrong = ways.copy()
    wrong[:3, 0] = plane[:3, 2]
    assert not np.allclose(
        flush(BOX, plane, moved(state, wrong @ np.full(6, 0.1)))[0], moved(state, wrong @ np.full(6, 0.1))
    )


def test_what_flies_or_stands_on_an_edge_lies_on_nothing():
    rng = np.random.default_rng(2)
    plane, state = lying(rng)
    assert plane_under(BOX, [plane], np.tile(state, (4, 1))) is plane
    flying = state.copy()
    flying[:3] += 0.02 * plane[:3, 2]
    assert plane_under(BOX, [plane], np.array([state, flying, flying])) is None
    tilted = moved(state, np.array([0, 0, 0, 0.2, 0, 0, 0, 0, 0, 0, 0, 0.0]))
    assert plane_under(BOX, [plane], np.tile(tilted, (4, 1))) is None


def test_a_held_pose_counts_twice_and_not_once_a_frame():
    frames = 10
    x = np.concatenate([0.02 * np.arange(4), np.full(6, 0.06)])
    poses = np.tile(np.eye(4), (frames, 1, 1, 1))
    poses[:, 0, 0, 3] = x
    covariances = np.tile(1e-6 * np.eye(6), (frames, 1, 1, 1))
    matter = Matter((BOX,), np.array([0, 0, -9.81]), ())
    motion = motion_of(matter, ("box",), np.arange(frames) / 30, poses, covariances)
    assert np.flatnonzero(motion.fresh[:, 0]).tolist() == [0, 1, 2, 3, 9]
    # it came to rest before tracking held it: by how little it jitters there nothing is told of what errs as it moves
    poses[4:6, 0, :2, 3] += [[2e-4, -1e-4], [-2e-4, 3e-4]]
    assert np.flatnonzero(motion._replace(poses=poses).fresh[:, 0]).tolist() == [0, 1, 2, 3, 9]
    parameters = Parameters(("box",), np.ones(1), read_dynamics_prior())
    shooting = Shooting(motion, parameters, Engine(motion.matter, motion.names, motion.step))
    factor = shooting.errors(shooting.first_path(parameters.middle()), Scales(0.1, 0.1, 2.0, 3.0)).factors[0]
    covariance = (factor @ factor.T).reshape(5, 6, 5, 6)
    np.testing.assert_allclose(covariance[0, :, 0], np.diag(np.repeat([4e-6, 9e-6], 3)))  # nothing has happened yet
    assert np.abs(covariance[0, :, 1:]).max() == 0.0  # poses of two frames err independently
    # a box that was struck and is held where it was has moved by less than a millimetre, and not by nothing
    assert covariance[4, 0, 4, 0] > HELD_WITHIN**2
