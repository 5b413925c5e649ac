"""Perceptual noise keeps solids out of each other, and is otherwise the noise that was asked for."""

import numpy as np
import pytest
from test_simulate import FLOOR, cube, matter

from derender.physics.intervention import intervention, jittered, pairs_entered
from derender.physics.outcome import simulate_scene

SPREAD = (0.02, np.radians(4.0))


def tower(count):
    """Return so many cubes of 10 cm on one another."""
    return matter(FLOOR, *(cube(f"c{k}", 0.0, 0.05 + 0.1 * k) for k in range(count)))


@pytest.mark.parametrize("count", [2, 8])
def test_no_draw_lets_solids_enter_each_other(count):
    """Of towers of eight none in thousands of unconditioned draws is possible: they are drawn body by body."""
    rng = np.random.default_rng(1)
    drawn = [jittered(tower(count), SPREAD, rng) for _ in range(10)]
    assert not any(map(pairs_entered, drawn))
    moved = np.array([[body.pose[:3, 3] for body in each.bodies if body.moves] for each in drawn])
    assert (moved.std(axis=0) > 0.2 * SPREAD[0]).all()  # none stays where it was


def test_bodies_drawn_in_turn_are_as_those_drawn_at_once(monkeypatch):
    seen = tower(2)
    first = np.array([body.pose[:3, 3] for body in seen.bodies])

    def heights(tries, count=250):
        monkeypatch.setattr("derender.physics.intervention.TRIES", tries)
        rng = np.random.default_rng(2)
        drawn = (jittered(seen, SPREAD, rng) for _ in range(count))
        return np.array([[(b.pose[:3, 3] - a) @ seen.up for b, a in zip(each.bodies, first, strict=True)]
                         for each in drawn])  # fmt: skip

    at_once, in_turn = heights(10_000), heights(0)
    error = np.sqrt((at_once.var(axis=0) + in_turn.var(axis=0)) / len(at_once))[1:]
    apart = (at_once.mean(axis=0) - in_turn.mean(axis=0))[1:]
    assert (np.abs(apart) < 4.0 * error).all()
    assert at_once[:, 2].mean() > 5.0 * error[1]  # the upper one is seen higher than it is


def test_solids_that_are_given_inside_each_other_may_stay_so():
    inside = matter(FLOOR, cube("a", 0.0, 0.05), cube("b", 0.02, 0.05))
    assert pairs_entered(inside)
    still = jittered(inside, (1e-4, 0.0), np.random.default_rng(0))
    assert pairs_entered(still) and not np.array_equal(still.bodies[1].pose, inside.bodies[1].pose)


def test_a_draw_that_could_not_be_is_not_said_to_fall():
    """Two cubes side by side, a millimetre apart: unconditioned noise let half of the draws fall at once."""
    beside = matter(FLOOR, cube("a", 0.0, 0.05), cube("b", 0.101, 0.05))
    what = intervention(jitter="20mm")
    runs = [simulate_scene(beside, engine="statics", what=what, rng=np.random.default_rng(k)) for k in range(40)]
    assert not any(run.entered for run in runs)
