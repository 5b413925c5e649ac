"""The one decision and the one adaptation, as Python and compiled; the loop of tempered populations."""

import math

import numpy as np
import pytest

from derender.sampling import metropolis, smc


@pytest.mark.parametrize("threshold", [metropolis.log_threshold, metropolis.compiled_log_threshold])
def test_steps_are_accepted_as_often_as_their_ratio_says(threshold):
    """4 standard errors of 20,000 decisions."""
    rng, count = np.random.default_rng(1), 20_000
    for ratio in (0.05, 0.5, 1.0):
        share = np.mean([threshold(rng) < math.log(ratio) + 1e-12 for _ in range(count)])
        assert abs(share - ratio) <= 4.0 * math.sqrt(ratio * (1.0 - ratio) / count)


def test_compiled_and_readable_forms_are_one():
    one, other = np.random.default_rng(2), np.random.default_rng(2)
    for rate in (0.0, 0.3, 1.0):
        assert metropolis.log_threshold(one) == metropolis.compiled_log_threshold(other)
        arguments = 0.7, rate, 0.3, 2.0
        assert metropolis.adapted_scale(*arguments) == pytest.approx(metropolis.compiled_adapted_scale(*arguments))
    assert metropolis.adapted_scale(1.0, 1.0, 0.0, 100.0) == math.exp(metropolis.MOST_CHANGE)


@pytest.mark.slow
@pytest.mark.parametrize("impossible", [0.0, 0.8])
@pytest.mark.parametrize("broken", [False, True])
def test_annealing_estimates_the_mean_weight(impossible, broken):
    """Independent particles x ~ N(0, 1), weight exp(-4 (x - 1)^2), most of them without any weight: the mean is
    (1 - impossible) / 3 exp(-4 / 9). A twin that never moves what it resamples keeps too few values."""
    rng, estimates = np.random.default_rng(3), []
    dead = np.zeros(0, bool)

    def gain_of(x, dead):
        return np.where(dead, -np.inf, -4.0 * (x - 1.0) ** 2)

    for _ in range(300):
        x, dead = rng.standard_normal(60), rng.random(60) < impossible
        if dead.all():
            estimates.append(0.0)
            continue

        def advance(chosen, exponent):
            nonlocal dead
            dead = dead[chosen]
            precision = 1.0 + 8.0 * exponent
            fresh = 8.0 * exponent / precision + rng.standard_normal(len(chosen)) / math.sqrt(precision)
            return gain_of(0.0 * fresh if broken else fresh, dead)

        estimates.append(math.exp(smc.anneal(rng, gain_of(x, dead), advance)[0]))
    exact = (1.0 - impossible) / 3.0 * math.exp(-4.0 / 9.0)
    error = np.std(estimates) / math.sqrt(len(estimates))
    assert (abs(np.mean(estimates) - exact) < 4.5 * error + 0.02 * exact) != broken


def test_nothing_of_any_weight_is_a_fault():
    with pytest.raises(ValueError, match="no particle"):
        smc.next_temperature(np.full(3, -np.inf), 0.0)
