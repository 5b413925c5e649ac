"""What rests on what: gaps of known geometry, and a chain that is smoothed exactly."""

import itertools

import numpy as np

from derender.scene.pose import translation
from derender.scene.solids import BOX
from derender.tracking.contact import CHANGE, FLOOR, gaps_of, parent_probabilities, smoothed


def test_gaps_are_to_what_lies_below_and_nothing_else():
    poses = np.array([translation(0, 0, 0.05), translation(0.02, 0, 0.153), translation(0.105, 0, 0.05)])
    gaps = gaps_of(poses, np.full((3, 3), 0.1), np.full(3, BOX), np.eye(4))
    assert np.isclose(gaps[0, FLOOR], 0) and np.isclose(gaps[1, FLOOR], 0.103)
    assert np.isclose(gaps[1, 2], 0.003, atol=1e-9)  # the second hangs 3 mm over the first
    assert np.isinf(gaps[0, 3]) and np.isinf(gaps[0, 4]) and np.isinf(gaps[2, 2])  # above it, and beside it


def test_smoothing_is_the_sum_over_all_histories():
    rng = np.random.default_rng(0)
    told = rng.normal(0, 2, (5, 3))
    expected = np.zeros((5, 3))
    for path in itertools.product(range(3), repeat=5):
        weight = np.exp(sum(told[t, s] for t, s in enumerate(path)))
        for a, b in itertools.pairwise(path):
            weight *= 1 - CHANGE if a == b else CHANGE / 2
        for t, s in enumerate(path):
            expected[t, s] += weight
    assert np.allclose(smoothed(told), expected / expected.sum(axis=1, keepdims=True))


def test_a_box_that_is_lifted_changes_its_parent_when_it_leaves():
    floor = np.diag([1.0, -1.0, -1.0, 1.0])
    floor[2, 3] = 1.0
    frames, poses = 12, np.tile(np.eye(4), (12, 2, 1, 1))
    for t in range(frames):
        heights = 0.05, 0.1301 + max(0, t - 5) * 0.008
        for k, height in enumerate(heights):
            pose = np.eye(4)
            pose[2, 3] = height
            poses[t, k] = floor @ pose
    sizes = np.tile([[0.1, 0.1, 0.1], [0.06, 0.06, 0.06]], (frames, 1, 1))
    spread = np.tile(np.eye(6) * 1e-6, (frames, 2, 1, 1))
    chances = parent_probabilities(
        poses, spread, sizes, np.array([BOX, BOX]), np.tile(floor, (frames, 1, 1)), np.zeros((frames, 2), bool)
    )
    assert np.allclose(chances.sum(axis=2), 1)
    assert (chances[:, 0, FLOOR] > 0.95).all()
    assert (chances[:5, 1, 2] > 0.9).all() and (chances[8:, 1, 0] > 0.9).all()


def test_what_is_not_there_has_no_parent():
    poses = np.full((3, 1, 4, 4), np.nan)
    spread, sizes, floors = np.full((3, 1, 6, 6), np.nan), np.full((3, 1, 3), 0.1), np.tile(np.eye(4), (3, 1, 1))
    assert np.isnan(parent_probabilities(poses, spread, sizes, np.array([BOX]), floors, np.zeros((3, 1), bool))).all()


def test_a_box_that_is_taken_for_too_large_is_not_in_the_air_where_it_goes_into_what_bears_it():
    """Of a box half hidden, whose side was 2 cm too long, the frames after its first were said to hang in the air."""
    poses = np.array([[translation(0, 0, 0.04 - 0.003 * t)] for t in range(8)])
    chances = parent_probabilities(
        poses, np.tile(np.eye(6) * 1e-6, (8, 1, 1, 1)), np.full((8, 1, 3), 0.1), np.array([BOX]),
        np.tile(np.eye(4), (8, 1, 1)), np.zeros((8, 1), bool),
    )  # fmt: skip
    assert (chances[:, 0, FLOOR] > 0.9).all()


def test_a_pose_that_is_not_seen_tells_nothing_of_what_bears_it():
    """A box that was pushed behind another and went on unseen, as if it rose and sank, was lifted and placed."""
    heights = 0.05 + 1e-3 * np.array([0, 0, 0, 13, 1, -11, -20, 0, 0, 0])
    poses = np.array([[translation(0, 0, height)] for height in heights])
    spread = np.tile(np.eye(6) * 1e-6, (10, 1, 1, 1))
    spread[3:7] = np.eye(6) * 0.05**2
    chances = parent_probabilities(
        poses,
        spread,
        np.full((10, 1, 3), 0.1),
        np.array([BOX]),
        np.tile(np.eye(4), (10, 1, 1)),
        np.zeros((10, 1), bool),
    )
    assert (chances[:, 0, FLOOR] > 0.5).all()
