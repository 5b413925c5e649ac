"""The damped step against numpy's."""

import math

import numpy as np
import pytest

from derender.sampling.descent import FLAT, NO_LIMITS, SINGULAR, damped_step


def problem(size=7, seed=1):
    """Return a precision (n, n), a gradient (n,), nothing held, and room for a step."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((size, size)) * 10.0 ** rng.uniform(-2, 2, size)
    return root.T @ root, rng.standard_normal(size), np.zeros(size, bool), np.empty(size)


@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
def test_the_step_solves_the_damped_equations(damping):
    precision, gradient, held, step = problem()
    foreseen = damped_step(precision, gradient, damping, held, NO_LIMITS, step)
    diagonal = np.diag(precision)
    grown = damping * np.maximum(diagonal, FLAT * diagonal.max()) + SINGULAR * diagonal.max()
    np.testing.assert_allclose((precision + np.diag(grown)) @ step, -gradient, atol=1e-9 * np.abs(gradient).max())
    assert foreseen == pytest.approx(-gradient @ step - 0.5 * step @ precision @ step, rel=1e-9) and foreseen > 0.0


def test_what_is_held_stays_and_the_others_step_as_if_it_were_not_there():
    precision, gradient, held, step = problem()
    held[[1, 4]] = True
    damped_step(precision, gradient, 0.1, held, NO_LIMITS, step)
    assert step[1] == step[4] == 0.0
    free, alone = np.flatnonzero(~held), np.empty(5)
    part = precision[np.ix_(free, free)]
    damped_step(np.ascontiguousarray(part), gradient[free], 0.1, np.zeros(5, bool), NO_LIMITS, alone)
    np.testing.assert_allclose(step[free], alone, rtol=1e-6)  # but for shares of the largest element


def test_a_step_is_shortened_to_its_limits():
    precision, gradient, held, step = problem()
    damped_step(precision, gradient, 0.0, held, NO_LIMITS, step)
    whole, short = step.copy(), 0.25 * np.linalg.norm(step[3:6])
    limits = np.array([10.0 * np.linalg.norm(step[:3]), short])
    foreseen = damped_step(precision, gradient, 0.0, held, limits, step)
    np.testing.assert_allclose(step, 0.25 * whole)
    assert foreseen == pytest.approx(-gradient @ step - 0.5 * step @ precision @ step, rel=1e-9)


def test_what_is_not_positive_has_no_step():
    precision, gradient, held, step = problem()
    assert math.isnan(damped_step(precision - 2.0 * np.diag(np.diag(precision)), gradient, 0.1, held, NO_LIMITS, step))
