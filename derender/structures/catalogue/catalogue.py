"""The structures that chains may visit, fixed before they start: those that the search and its one-step changes found
thinkable, and what two changes of different solids make together."""

from functools import partial
from itertools import combinations

import numpy as np

from derender.compilation.threads import in_threads
from derender.detection.solids.naming import structure_key
from derender.detection.solids.state import State
from derender.structures.catalogue.entry import in_order, make_entry, rebased
from derender.structures.draws.chart import make_chart
from derender.structures.draws.refined import Refined, at_mode, floor_pose_of
from derender.structures.graph_posterior import weighed_structures

MOST = 10  # entries
THINKABLE = 25.0  # nats below the best: the chains are to tell
TOGETHER = 6.0  # nats below the best up to which two changes are thought of together
LEAST_SHARE = 0.02  # of the leaps that go to an entry that seems hopeless, relative to the best


def catalogue_of(rng, first: Refined, energy, pool, settings):
    """Return the entries about the search's best state, the likeliest of them first, and the Sensor that all have.

    first, energy, pool : as of `weighed_structures`.
    """
    kept = weighed_structures(rng, first, energy, pool, settings.rules)
    kept = [each for each in kept if each[1] > -THINKABLE and 0 < len(each[0].state) <= settings.max_objects]
    kept += together(rng, kept, settings.rules)
    kept = sorted(kept, key=lambda each: -each[1])[:MOST]
    best, names = kept[0][0], list(kept[0][2])
    rank = {name: k for k, name in enumerate(names)}
    floor, bases, tasks = floor_pose_of(best), {}, []
    for trial, _, own in kept:
        trial, own = in_order(in_frame(trial, floor, best, settings.rules), own, lambda n: rank.get(n, len(rank)))
        trial = trial._replace(values=rebased(trial.chart, trial.values, own, bases))
        tasks.append(partial(make_entry, refined=trial, names=own))
    entries = [entry for entry in in_threads(rng, tasks) if entry is not None]
    return sorted(entries, key=lambda entry: -entry.log_evidence), best.sensor


def in_frame(trial, floor, best, rules) -> Refined:
    """Return a Refined in the coordinates of a floor's pose (4, 4), under the best one's sensor."""
    chart, values = make_chart(trial.state, floor, rules)
    return trial._replace(chart=chart, values=values, sensor=best.sensor)


def together(rng, kept, rules):
    """Return (Refined, log odds, names) of the best structure with two changes of different solids."""
    best, _, names = kept[0]
    single = []
    for trial, odds, own in kept[1:]:
        if odds > -TOGETHER and sorted(own) == sorted(names):
            state = sorted_as(trial.state, own, names)
            changed = {k for k in range(len(names)) if differs(state, best.state, k)}
            single.append((state, odds, changed))
    known = {structure_key(trial.state, own) for trial, _, own in kept}
    pairs = []
    for (one, odds, here), (other, more, there) in combinations(single, 2):
        if here & there or odds + more < -TOGETHER:
            continue
        state = one.copy()
        for k in there:
            put(state, other, k)
        if structure_key(state, names) not in known:
            pairs.append((state, odds + more))
    floor = floor_pose_of(best)
    tasks = [partial(at_mode, state=state, floor_pose=floor, sensor=best.sensor, rules=rules, steps=100)
             for state, _ in pairs]  # fmt: skip
    return [(trial, odds, names) for trial, (_, odds) in zip(in_threads(rng, tasks), pairs, strict=True)]


def sorted_as(state, own, names) -> State:
    """Return a state with its solids, called `own`, in the order of `names`."""
    order = [own.index(name) for name in names]
    place = {old: new for new, old in enumerate(order)} | {-1: -1}
    return State(state.rows[order].copy(), [state.forms[k] for k in order], [state.cubes[k] for k in order],
                 [place[state.parents[k]] for k in order], [state.bottoms[k] for k in order])  # fmt: skip


def differs(state, other, k) -> bool:
    """Return whether solid k is of another kind, or stands on something else."""
    here, there = ((s.rows[k][0], s.forms[k], s.cubes[k], s.parents[k]) for s in (state, other))
    return here != there


def put(state, other, k) -> None:
    """Make solid k of a state what it is in another, in place."""
    state.rows[k], state.forms[k], state.cubes[k] = other.rows[k], other.forms[k], other.cubes[k]
    state.parents[k], state.bottoms[k] = other.parents[k], other.bottoms[k]


def pull_of(entries) -> np.ndarray:
    """Return (E,) how much each entry is worth a visit: the root of its evidence, and a little if that is hopeless."""
    logs = np.array([entry.log_evidence for entry in entries])
    return np.maximum(np.exp(0.5 * (logs - logs.max())), LEAST_SHARE)


def shares_of(entries) -> np.ndarray:
    """Return (E, E): with what probability a leap from each entry (row) goes to each other one."""
    shares = np.tile(pull_of(entries), (len(entries), 1))
    np.fill_diagonal(shares, 0.0)
    return shares / np.maximum(shares.sum(axis=1, keepdims=True), 1e-300)
