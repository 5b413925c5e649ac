"""The one decision and the one adaptation, as Python and compiled."""

import math

import numpy as np
import pytest

from derender.sampling import metropolis


@pytest.mark.parametrize("accepted", [
    lambda rng, log_ratio: metropolis.log_threshold(rng) < log_ratio,
    lambda rng, log_ratio: metropolis.compiled_log_threshold(rng) < log_ratio,
    lambda rng, log_ratio: metropolis.decide(rng, False, True, log_ratio, "step")[0],
])  # fmt: skip
def test_steps_are_accepted_as_often_as_their_ratio_says(accepted):
    """4 standard errors of 20,000 decisions."""
    rng, count = np.random.default_rng(1), 20_000
    for ratio in (0.05, 0.5, 1.0):
        share = np.mean([accepted(rng, math.log(ratio) + 1e-12) for _ in range(count)])
        assert abs(share - ratio) <= 4.0 * math.sqrt(ratio * (1.0 - ratio) / count)


def test_compiled_and_readable_forms_are_one():
    one, other = np.random.default_rng(2), np.random.default_rng(2)
    for rate in (0.0, 0.3, 1.0):
        assert metropolis.log_threshold(one) == metropolis.compiled_log_threshold(other)
        arguments = 0.7, rate, 0.3, 2.0
        assert metropolis.adapted_scale(*arguments) == pytest.approx(metropolis.compiled_adapted_scale(*arguments))
    assert metropolis.adapted_scale(1.0, 1.0, 0.0, 100.0) == math.exp(metropolis.MOST_CHANGE)
