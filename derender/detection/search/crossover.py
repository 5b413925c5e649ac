"""Crossover of two searches: of each part of the scene the explanation of that search which explains it better."""

import numpy as np

from derender.detection.search.greedy import Settings, settle, total_energy
from derender.detection.solids.image import Image
from derender.detection.solids.state import State, held_out, subset

SHARED = 0.1  # of the pixels of one of two solids that both show from which on they belong to one part


def crossed(rng: np.random.Generator, image: Image, state: State, other: State, settings: Settings) -> State:
    """Return a State with parts of another in place of its own wherever that lowers the energy.

    Searches end in optima that are better here in one and there in the other.
    """
    best, tried = total_energy(image, state, settings), set[tuple[int, ...]]()
    while untried := [part for part in parts(image, state, other) if part[1] and part[1] not in tried]:
        mine, theirs = untried[0]
        tried.add(theirs)
        trial = subset(state, set(range(len(state))) - set(mine))
        count = len(trial)
        for k in theirs:
            trial = trial.add(other.rows[k], other.forms[k], other.cubes[k])
        trial = settle(rng, image, trial, settings, only=set(range(count, len(trial))))
        if (value := total_energy(image, trial, settings)) < best:
            state, best = trial, value
    return state


def parts(image: Image, state: State, other: State) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Return the solids of one state and of another, by index, of each part of the scene: what shows in the same pixels
    hangs together."""
    from scipy.sparse.csgraph import connected_components

    one, two = (held_out(image, each, -1)[1] for each in (state, other))
    count, more = len(state), len(other)
    both = (one >= 0) & (two >= 0)
    shared = np.zeros((count, more), int)
    np.add.at(shared, (one[both], two[both]), 1)
    least = np.minimum(np.bincount(one[one >= 0], minlength=count)[:, None], np.bincount(two[two >= 0], minlength=more))
    tied = np.zeros((count + more, count + more), bool)
    tied[:count, count:] = shared > SHARED * least
    number, part = connected_components(tied, directed=False)
    return [
        (tuple(np.flatnonzero(part[:count] == k).tolist()), tuple(np.flatnonzero(part[count:] == k).tolist()))
        for k in range(number)
    ]
