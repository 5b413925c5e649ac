"""Probabilities are said no finer than their error, and never as certain."""

import pytest

from derender.results.table import probability_text


@pytest.mark.parametrize(
    "probability, error, interval, text",
    [
        (0.93, 0.02, (0.88, 0.96), ".93 (.88-.96)"),
        (0.93, 0.001, None, ".93"),
        (1.0, 0.0, None, ">.99"),
        (0.9912, 0.0, None, ">.99"),
        (0.0004, 0.0, None, "<.01"),
        (0.0, 0.02, (0.0, 0.06), "<.01 (<.01-.06)"),
        (0.62, 0.15, (0.37, 0.83), ".6 (.37-.83)"),
        (0.97, 0.12, (0.7, 1.0), ">.9 (.70->.99)"),
        (0.5, 0.1, None, ".5 (.34-.66)"),
    ],
)
def test_probabilities_are_said_as_finely_as_they_are_known(probability, error, interval, text):
    assert probability_text(probability, error, interval) == text


def test_nothing_is_certain():
    assert not any("1.0" in probability_text(1.0 - 10.0**-k, error) for k in range(1, 9) for error in (0.0, 0.05, 0.2))
