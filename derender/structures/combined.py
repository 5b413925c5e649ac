"""Structures in which several solids at once are other than in the best: what one by one leaves open is open together.

Where a can may as well be a box and a cube beside it longer than it is wide, one more structure has both changes, as
probable as both make it.
"""

from functools import partial
from itertools import product

import numpy as np

from derender.compilation.threads import in_threads
from derender.detection.solids.beliefs import Rules
from derender.structures.alternatives import PRUNE_THRESHOLD, QUICK, WORTHWHILE, all_seen
from derender.structures.draws.refined import Refined, at_mode, floor_pose_of, height
from derender.structures.weighing import CLOSE, Block, Weighed, of_block, with_own_sensor

# Structures, the likeliest if no change told anything of another, and solids, those most likely other than in the best:
# with twenty that are open there are more combinations than can be counted.
MOST_COMBINED = 6

Changes = tuple[tuple[int, Weighed], ...]  # which solid, and the structure in which it alone is other than in the best


def combinations(rng: np.random.Generator, best: Refined, others: list[Weighed], rules: Rules) -> list[Weighed]:
    """Return the Weighed of structures that make several of the changes of single solids among the Weighed of others.

    Solids that touch or hide each other are not independent: each combination is climbed and weighed as a whole.
    """
    tasks = [partial(combined, best=best, changes=changes, rules=rules) for changes in likeliest_of(others)]
    return [found for found in in_threads(rng, tasks) if found is not None]


def likeliest_of(others: list[Weighed]) -> list[Changes]:
    """Return the combinations of two and more changes, each of another solid, whose odds would be at least -CLOSE."""
    single: dict[int, list[tuple[int, Weighed]]] = {}
    for each in others:
        if each.places is not None and len(each.places[0]) == 1 and each.places[0] == each.places[1]:
            if abs(each.odds) < CLOSE:
                (k,) = each.places[0]
                single.setdefault(k, []).append((k, each))
    open_most = sorted(single.values(), key=lambda changes: max(each.odds for _, each in changes), reverse=True)
    choices = product(*([None, *changes] for changes in open_most[:MOST_COMBINED]))
    found = [tuple(change for change in choice if change is not None) for choice in choices]
    found = [changes for changes in found if len(changes) > 1 and odds_apart(changes) > -CLOSE]
    return sorted(found, key=odds_apart, reverse=True)[:MOST_COMBINED]


def odds_apart(changes: Changes) -> float:
    """Return the log odds of changes that tell nothing of each other."""
    return sum(each.odds for _, each in changes)


def combined(rng: np.random.Generator, best: Refined, changes: Changes, rules: Rules) -> Weighed | None:
    """Return the Weighed of a structure with all these changes of single solids; None: it is far below the best."""
    state = best.state.copy()
    for k, each in changes:
        changed = each.trial.state
        state.rows[k], state.forms[k], state.cubes[k] = changed.rows[k], changed.forms[k], changed.cubes[k]
        state.parents[k], state.bottoms[k] = changed.parents[k], changed.bottoms[k]
    solids = sorted(k for k, _ in changes)
    trial = at_mode(rng, state, floor_pose_of(best), best.sensor, rules, QUICK, solids)
    trial = with_own_sensor(rng, trial, solids, WORTHWHILE)
    if height(trial) <= height(best) - PRUNE_THRESHOLD or not all_seen(trial):
        return None
    return of_block(rng, trial, solids, Block(best, solids))
