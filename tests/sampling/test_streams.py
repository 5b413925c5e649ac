"""No two uses of a seed, and no two seeds, share random numbers."""

import itertools

import numpy as np

from derender.sampling.chains import POPULATIONS, SCENES, child_seed, stream


def test_uses_and_numbers_share_nothing():
    seeds = range(4)
    firsts = [np.random.default_rng(seed).random() for seed in seeds]
    firsts += [stream(seed, number).random() for seed, number in itertools.product(seeds, range(4))]
    for use, seed, number in itertools.product((SCENES, POPULATIONS), seeds, range(4)):
        firsts.append(stream(seed, use, number).random())
        firsts.append(np.random.default_rng(child_seed(seed, use, number)).random())
    firsts += [stream(seed, POPULATIONS, 0, 0).random() for seed in seeds]
    assert len(set(firsts)) == len(firsts)


def test_lists_with_a_zero_do_share():
    """What this module is for: the broken twin."""
    assert np.random.default_rng([5, 0]).random() == np.random.default_rng(5).random()
