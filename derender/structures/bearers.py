"""Which of several supports is a solid's parent: the one that bears most, which may hang on friction, and is open then.

How a board that leans on a box shares its weight between the floor and the box is told by where it lies and by the
friction of both contacts, of which the prior's file has a distribution. With draws of both, the parent is one in as
many of them as it bears most of those that hold the solid at all: it is at rest.
"""

from collections import Counter

import numpy as np

from derender.detection.solids.state import State
from derender.detection.solids.support import TOUCHING, bearers, shares_of_load
from derender.scene.distributions import Distribution
from derender.structures.draws.chart import Chart, rows_at

DRAWN = 100  # scenes, and frictions of each contact, in which who bears most is looked at
SMALLEST_SHARE = 1e-3  # of a parent that is kept


def by_bearer(
    rng: np.random.Generator, state: State, chart: Chart, drawn: np.ndarray, friction: Distribution
) -> list[tuple[State, float]]:
    """Return [(State, probability)]: a state with each parent that each of its solids may have.

    drawn : (n, D) draws of the chart's coordinates. friction : of one contact.
    """
    found = [(state, 1.0)]
    for k in range(len(state)):
        if len(bearers(state.rows, k)) > 1:
            parents = parents_of(rng, chart, drawn, k, friction)
            if parents:
                found = [(each.changed(k, parent=j), share * p) for each, share in found for j, p in parents.items()]
    return found


def parents_of(
    rng: np.random.Generator, chart: Chart, drawn: np.ndarray, k: int, friction: Distribution
) -> dict[int, float]:
    """Return how probably each of its supports bears most of solid k; empty where it is held in no draw."""
    most: Counter[int] = Counter()
    for values in drawn[rng.integers(len(drawn), size=DRAWN)]:
        rough = np.array([friction.quantile(p) for p in rng.random(len(chart.flags) + 1)])
        shares = shares_of_load(rows_at(chart, values), k, TOUCHING, rough)
        if shares:
            most[max(shares, key=lambda j: shares[j])] += 1
    return {j: number / most.total() for j, number in most.items() if number > SMALLEST_SHARE * most.total()}
