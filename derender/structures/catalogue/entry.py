"""One structure of a catalogue: its chart, and the normal distribution that its numbers were found to have."""

from typing import Any, NamedTuple

import numpy as np

from derender.detection.solids.graph import order_of
from derender.detection.solids.state import FLOOR, State
from derender.structures.catalogue.region import Region, folded
from derender.structures.draws.chart import FLOOR_WAYS, HELD, PARENT, SLOTS, TURN, VERTICAL, Chart
from derender.structures.draws.metropolis import engine_of, run, sample
from derender.structures.draws.refined import Refined
from derender.structures.draws.steps import Proposals, block_steps, make_proposals, single_steps

DRAWS = 300  # from which an entry's normal is fitted
ENOUGH = 0.5  # of the draws inside the region: else nothing holds the solids in place
NEAR = 0.2  # radians between bases that may be one


class Entry(NamedTuple):
    """A structure that chains may visit.

    Attributes
    ----------
    state : State, supports before what they carry; names : of its N solids.
    chart : Chart; start : (D,) coordinates at the best draw.
    labels : D (solid, column) or ("floor", number): what each coordinate is, the same in every entry.
    mean, covariance : (D,), (D, D) of the draws that were made of it.
    proposals : steps whose scales were learnt in the warm-up.
    log_evidence : of the integral over all coordinates, were the density normal.
    """

    state: State
    names: tuple[str, ...]
    chart: Chart
    start: np.ndarray
    labels: tuple[tuple[str, int], ...]
    mean: np.ndarray
    covariance: np.ndarray
    proposals: Proposals
    log_evidence: float

    def variant(self, name: str) -> tuple:
        """Return what must agree for a solid of this name to be the same in two entries."""
        k = self.names.index(name)
        kind, vertical, parent, held = (int(x) for x in self.chart.flags[k])
        above = "floor" if parent == FLOOR else self.names[parent]
        return kind, vertical, above, held, self.state.cubes[k], self.chart.base[k, 1:10].tobytes()

    def columns_of(self, names) -> list[int]:
        """Return the coordinates of some solids."""
        return [i for i, (name, _) in enumerate(self.labels) if name in names]

    def carried(self, names) -> set[str]:
        """Return these solids and all that are held to their tops."""
        found = set(names)
        for k, name in enumerate(self.names):  # supports come first
            parent = self.chart.flags[k, PARENT]
            if parent >= 0 and self.chart.flags[k, HELD] and self.names[parent] in found:
                found.add(name)
        return found


def in_order(refined: Refined, names, rank) -> tuple[Refined, tuple[str, ...]]:
    """Return a Refined with its solids sorted, supports first, else by rank (of a name)."""
    state = refined.state
    parents = list(state.parents)
    chosen: list[int] = []
    waiting = sorted(order_of(parents), key=lambda k: rank(names[k]))
    while waiting:
        k = next(k for k in waiting if parents[k] == FLOOR or parents[k] in chosen)
        waiting.remove(k)
        chosen.append(k)
    place = {old: new for new, old in enumerate(chosen)} | {FLOOR: FLOOR}
    state = State(state.rows[chosen].copy(), [state.forms[k] for k in chosen], [state.cubes[k] for k in chosen],
                  [place[parents[k]] for k in chosen], [state.bottoms[k] for k in chosen])  # fmt: skip
    old, size = refined.chart, len(refined.values)
    flags, slots, columns = old.flags[chosen].copy(), old.slots[chosen].copy(), []
    flags[:, PARENT] = [place[int(p)] for p in flags[:, PARENT]]
    for row in slots:
        for column in range(SLOTS):
            if row[column] >= 0:
                if int(row[column]) not in columns:
                    columns.append(int(row[column]))
    new = {column: number for number, column in enumerate(columns)} | {-1: -1}
    slots = np.array([[new[int(x)] for x in row] for row in slots], np.int64).reshape(-1, SLOTS)
    chart = old._replace(flags=flags, slots=slots, base=old.base[chosen].copy(), order=np.arange(len(chosen)))
    values = refined.values[[*columns, *range(size - FLOOR_WAYS, size)]]
    return refined._replace(state=state, chart=chart, values=values), tuple(names[k] for k in chosen)


def rebased(chart, values, names, bases) -> np.ndarray:
    """Turn the bases of upright solids to those that `bases` (by name) holds, in place; add what is not there yet.

    Returns the (D,) coordinates of the same scene.
    """
    values = values.copy()
    for k, name in enumerate(names):
        flags = chart.flags[k]
        key = name, int(flags[0]), int(flags[VERTICAL])
        known = bases.setdefault(key, chart.base[k, 1:10].copy())
        if not flags[VERTICAL]:
            continue
        turn = chart.base[k, 1:10].reshape(3, 3) @ known.reshape(3, 3).T
        angle = np.arctan2(turn[1, 0], turn[0, 0])
        if turn[2, 2] > 1.0 - 1e-9 and abs(angle) < NEAR:
            chart.base[k, 1:10] = known
            if chart.slots[k, TURN + 2] >= 0:
                values[chart.slots[k, TURN + 2]] += angle
    return values


def labels_of(chart, names) -> tuple[tuple[str, int], ...]:
    """Return what each coordinate is."""
    size = 1 + int(chart.slots.max(initial=-1))
    labels: list[Any] = [None] * size
    for k, name in enumerate(names):
        for column in reversed(range(SLOTS)):
            if chart.slots[k, column] >= 0:
                labels[chart.slots[k, column]] = name, column
    return (*labels, *(("floor", i) for i in range(FLOOR_WAYS)))


def make_entry(rng, refined: Refined, names, draws=DRAWS) -> Entry | None:
    """Return the Entry of a Refined (see `in_order`, `rebased`): its normal and the scales of its steps are learnt.

    None where the image does not hold its solids in place.
    """
    chart, sensor = refined.chart, refined.sensor
    engine, region = engine_of(chart, sensor), Region(sensor)
    (found,) = sample(rng, chart, sensor, refined.values, 1, draws, 10 + 5 * len(names))
    values = np.array([folded(chart, draw) for draw in found.values])
    inside = np.array([region.holds(chart, draw) for draw in values])
    if inside.mean() < ENOUGH:
        return None
    values, densities = values[inside], found.densities[inside].sum(axis=1)
    covariance = np.atleast_2d(np.cov(values.T)) + 1e-12 * np.eye(len(refined.values))
    proposals = make_proposals([*single_steps(chart), *block_steps(chart, covariance)])
    run(rng, engine, chart, values[-1].copy(), proposals, 1.0, 0.05, 20 * (1 + len(names)), 10)
    entropy = 0.5 * np.linalg.slogdet(2.0 * np.pi * np.e * covariance)[1]
    return Entry(refined.state, tuple(names), chart, values[int(np.argmax(densities))].copy(),
                 labels_of(chart, names), values.mean(axis=0), covariance, proposals,
                 float(densities.mean() + entropy))  # fmt: skip
