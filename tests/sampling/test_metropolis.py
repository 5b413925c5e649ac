"""The one decision, the one adaptation and the one walk, as Python and compiled."""

import math
from typing import NamedTuple

import numpy as np
import pytest

from derender.compilation.cache import address_of, interpreted, njit
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


class Line(NamedTuple):
    """A number whose log likelihood is -x^2 / 2. now, trial : (3,), the number, log prior and log likelihood."""

    now: np.ndarray
    trial: np.ndarray


@njit(nogil=True)
def attempt(rng, line, k, scale, temperature):
    """Kernel 0 steps, kernel 1 leaves its steps to the caller."""
    if k == 1:
        return math.nan
    line.trial[0] = line.now[0] + scale * rng.standard_normal()
    line.trial[2] = -0.5 * line.trial[0] ** 2
    return temperature * (line.trial[2] - line.now[2])


@njit(nogil=True)
def settle(line, accepted):
    if accepted:
        line.now[:] = line.trial


def taken(compiled, weights=(1.0,), scale=2.4, wanted=0.0, most=np.inf, temperature=1.0, gain=0.0, draws=4000):
    """Return (kept, counts, scale, done, kernel) of a walk on the line, compiled or interpreted."""
    rng, line, count = np.random.default_rng(3), Line(np.zeros(3), np.zeros(3)), len(weights)
    steps = metropolis.Steps(np.cumsum(weights), *(np.full(count, each) for each in (scale, wanted, most)))
    kept, counts = np.zeros((draws, 3)), np.zeros((count, 2), np.int64)
    if compiled:
        calls = [address_of(attempt, rng, line, np.int64(0), 1.0, 1.0), address_of(settle, line, True)]
        walk = metropolis.walk
    else:
        calls, kernels = [0, 1], (interpreted(attempt), interpreted(settle))
        call = lambda number, *arguments: kernels[number](*arguments)  # noqa: E731
        walk = interpreted(metropolis.walk, call_for_number=call, call_for_nothing=call)
    done, k = walk(rng, np.array(calls), line, steps, line.now, temperature, gain, 0, 5, kept, counts)
    return kept, counts, steps.scale, done, k


@pytest.mark.parametrize("compiled", [False, True])
def test_a_walk_keeps_its_target_at_each_temperature(compiled):
    """The square's mean is 1 / temperature: 4,000 draws five steps apart are worth over 2,000, so within 4 errors of
    sqrt(2 / 2000)."""
    for temperature in (1.0, 0.25):
        kept, counts, scale, done, k = taken(compiled, scale=2.4 / math.sqrt(temperature), temperature=temperature)
        assert (done, k, counts[0, 0], scale[0]) == (20_000, -1, 20_000, 2.4 / math.sqrt(temperature))
        assert temperature * np.mean(kept[:, 0] ** 2) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / 2000.0))
        np.testing.assert_allclose(kept[:, 2], -0.5 * kept[:, 0] ** 2, rtol=1e-12)


@pytest.mark.parametrize("compiled", [False, True])
def test_a_walk_adapts_its_scales_to_the_rates_that_are_wanted(compiled):
    """From steps a hundred times too long; at its end it accepts one in three, to within a tenth."""
    kept, counts, scale, _, _ = taken(compiled, scale=200.0, wanted=0.33, gain=0.05, draws=1000)
    later = np.mean(np.diff(kept[500:, 0]) != 0.0)  # of five steps each
    assert 1.0 - (1.0 - 0.23) ** 5 < later < 1.0 - (1.0 - 0.43) ** 5
    assert taken(compiled, scale=200.0, wanted=0.33, gain=0.05, most=1.0, draws=1000)[2][0] <= 1.0
    assert taken(compiled, scale=200.0, wanted=0.0, gain=0.05, draws=10)[2][0] == 200.0


@pytest.mark.parametrize("compiled", [False, True])
def test_a_walk_leaves_a_step_to_its_caller(compiled):
    """Of kernels of equal weights the second is picked before ten steps are done, but for one time in a thousand."""
    _, counts, _, done, k = taken(compiled, weights=(1.0, 1.0))
    assert k == 1 and done == counts[0, 0] < 10 and counts[1, 0] == 0


def test_kernels_are_picked_by_weight():
    """4 standard errors of 20,000 picks."""
    rng, weights = np.random.default_rng(5), np.array([0.1, 0.0, 0.6, 0.3])
    for pick in (metropolis.pick, interpreted(metropolis.pick)):
        shares = np.bincount([pick(rng, np.cumsum(weights)) for _ in range(20_000)], minlength=4) / 20_000
        assert np.all(np.abs(shares - weights) <= 4.0 * np.sqrt(weights * (1.0 - weights) / 20_000))
