"""Random streams: each use of a seed has its own, so that no two seeds and no two uses share numbers.

numpy takes a list such as [seed, 0] for the seed alone, and seed + 1 for the next seed: neither tells uses apart.
Children of a SeedSequence do, whatever their seed. A chain has the child of its own number, without a use before it.
"""

import numpy as np

SCENES, STRUCTURES, POPULATIONS = range(1, 4)  # uses: drawn scenes, structures of one prior, tempered populations


def sequence(seed: int, *key: int) -> np.random.SeedSequence:
    """Return the child of a seed for a use and its number (or numbers)."""
    return np.random.SeedSequence(seed, spawn_key=key)


def stream(seed: int, *key: int) -> np.random.Generator:
    """Return the random generator of a seed for a use and its number (or numbers)."""
    return np.random.Generator(np.random.PCG64(sequence(seed, *key)))


def child_seed(seed: int, *key: int) -> int:
    """Return a seed, below 2^63, for a use and its number."""
    return int(sequence(seed, *key).generate_state(1, np.uint64)[0] >> np.uint64(1))
