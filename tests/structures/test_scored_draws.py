"""Draws by the search's own score: a cube's walk leaves its density as it is, and chains go on until they agree."""

import math
import time

import numpy as np
import pytest
from scipy.stats import kstest

from derender.detection.search.greedy import Settings
from derender.detection.solids.image import CENTRE, ROTATION, make_image, make_row
from derender.detection.solids.polish import SIZE_SPREAD, TANGENT, TYPICAL_SIZE, UPRIGHT, WALK_MOVES, joint_step, walk
from derender.detection.solids.state import FLOOR, State
from derender.scene.pose import rotation_x, translation
from derender.scene.solids import BOX
from derender.structures import scored_posterior

CAMERA = {"fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5, "width": 32, "height": 24}
FLOOR_POSE = translation(0.0, 0.05, 0.8) @ rotation_x(np.deg2rad(135))


JOINT = np.zeros((TANGENT, 2))
JOINT[[2, 6, 7, 8], 0] = [0.02, 0.04, 0.04, 0.04]  # a cube grows about its bottom
JOINT[5, :] = 0.3, 0.3  # and turns


@pytest.mark.parametrize("factor", [np.empty((TANGENT, 0)), JOINT])
def test_a_cube_of_which_nothing_is_seen_has_sizes_from_its_prior(factor):
    """The density of a side s is exp(-z^2 / 2) with z = log(s / typical) / spread, so that log s has its mean moved."""
    image = make_image(np.zeros((24, 32)), 1.0, CAMERA, FLOOR_POSE)  # no pixel has a weight
    start = make_row(BOX, np.eye(3), np.array([0.0, 0.0, 0.05]), np.full(3, 0.1))
    rng, sides = np.random.default_rng(5), []
    scale, nothing = np.full(WALK_MOVES, 0.03), np.zeros((24, 32))
    scale[:12] = 1e-3  # the side changes by the steps at a corner alone
    row = start
    for _ in range(1500):
        row = walk(rng, image, row, UPRIGHT, True, row[None], 0, nothing, nothing, 0.0, np.zeros(0), 0.02, 0.0, scale,
                   150, 1.0, False, factor)  # fmt: skip
        sides.append(row[13])
        assert row[13] == row[14] == row[15]
    z = np.log(np.array(sides[::3]) / TYPICAL_SIZE) / SIZE_SPREAD - SIZE_SPREAD
    assert kstest(z, "norm").pvalue > 1e-3
    assert kstest(z + SIZE_SPREAD, "norm").pvalue < 1e-6  # the broken twin: without the Jacobian of the logarithm


def test_a_joint_step_and_the_same_backwards_lead_back():
    rng = np.random.default_rng(3)
    start = make_row(BOX, rotation_x(0.7)[:3, :3], np.array([0.1, 0.0, 0.3]), np.array([0.1, 0.2, 0.3]))
    there, back = np.empty_like(start), np.empty_like(start)
    factor = 0.01 * rng.standard_normal((TANGENT, 1))
    drawn = np.random.default_rng(1).standard_normal(), np.random.default_rng(2).standard_normal()
    assert joint_step(np.random.default_rng(1), start, there, factor)
    turn = there[ROTATION:CENTRE].reshape(3, 3)
    assert np.allclose(turn @ turn.T, np.eye(3)) and not np.allclose(there, start)
    assert joint_step(np.random.default_rng(2), there, back, -factor * drawn[0] / drawn[1])
    assert np.allclose(back, start)


def test_joint_steps_scatter_as_the_draws_do():
    """Of draws whose centre and height move together along one line there is one joint step, along that line."""
    amount = np.random.default_rng(4).standard_normal(500)
    rows = np.tile(make_row(BOX, np.eye(3), np.array([0.0, 0.0, 0.05]), np.full(3, 0.1)), (500, 1))
    rows[:, 12] += 0.005 * amount
    rows[:, 15] += 0.01 * amount
    factor = scored_posterior.joint_factor(rows)
    assert factor.shape == (TANGENT, 1)
    assert np.allclose(np.abs(factor[[2, 8], 0]), 2.38 * amount.std(ddof=1) * np.array([0.005, 0.01]))


@pytest.mark.parametrize("until, rounds", [(None, 4), (math.inf, 6), (0.0, 1)])
def test_chains_go_on_with_twice_as_many_steps_until_they_agree(monkeypatch, until, rounds):
    """Without a budget for so long as is worth it, with one until it is spent."""
    state = State().add(
        make_row(BOX, np.eye(3), np.array([0.0, 0.0, 0.05]), np.full(3, 0.1)), UPRIGHT, True, FLOOR, 0.0
    )
    made = []

    def rows_of(rng, image, walkers, settings, draws, steps):
        made.append(steps)
        return np.tile(walkers[0].state.rows, (len(walkers), draws, 1, 1)), np.zeros((len(walkers), draws))

    monkeypatch.setattr(scored_posterior, "draw_rows", rows_of)
    monkeypatch.setattr(scored_posterior, "agree", lambda values: len(made) == 6)
    monkeypatch.setattr(scored_posterior, "MOST_STEPS", 20 * scored_posterior.STEPS * 10)
    monkeypatch.setattr(scored_posterior, "total_energy", lambda *_: 0.0)
    image = make_image(np.zeros((24, 32)), 1.0, CAMERA, FLOOR_POSE)
    seen = type("Seen", (), {"image": image, "floor": type("Floor", (), {"pose": FLOOR_POSE})})
    settings = Settings()._replace(until=None if until is None else time.monotonic() + until)
    scored_posterior.part_of(np.random.default_rng(0), seen, None, state, settings, ["cube_1"], 1.0, 2, 10)
    assert made == [scored_posterior.STEPS * 2**k for k in range(rounds)]
