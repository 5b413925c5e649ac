"""Sequential Monte Carlo over a catalogue: solids enter one at a time, with the pixels that they explain.

Before it starts, each pixel is given to the solid that an entry sees there. A particle is an entry e and the
coordinates x of its first k solids; the targets are

    pi_k(e, x) = c(e, k) * prior of the first k solids * likelihood of the pixels of the floor and of the first k,

those near a solid that is still missing left out, k = 1, ..., K; pi_K is the posterior over the whole catalogue. The
constant c is what the missing solids and pixels are expected to be worth, by the entry's normal; c(e, K) = 1. The
solid that enters is drawn from the entry's normal, given the coordinates that are there, with density g (`leap.py`):
weights grow by pi_k(x) / (pi_{k-1}(x without it) g(it)); of TRIALS draws for each particle, and of all particles, as
many as there were are kept by resampling; they walk. At the end they leap too. The product of the mean weights
estimates the integral over all structures (Del Moral, Doucet, Jasra 2006).
"""

from typing import NamedTuple

import numpy as np

from derender.posterior.smc import systematic
from derender.structures.catalogue.catalogue import pull_of
from derender.structures.catalogue.chain import Place, Walker
from derender.structures.catalogue.entry import Entry
from derender.structures.catalogue.leap import conditional
from derender.structures.catalogue.region import folded
from derender.structures.draws.chart import FLOOR_WAYS
from derender.structures.draws.metropolis import engine_of, load, run
from derender.structures.draws.sensor import model_image
from derender.structures.draws.steps import block_steps, make_proposals, single_steps

STEPS = 20  # of each particle for each solid that is there, after each resampling
ROUNDS = 3  # of walks and leaps at the end
TRIALS = 10  # draws of the solid that enters, for each particle
ADAPT = 400  # steps in which the scales of the walks are learnt


class Population(NamedTuple):
    """places : of equal weight; log_evidence; effective : (K,) effective share of the particles at each stage."""

    places: list[Place]
    log_evidence: float
    effective: np.ndarray


def shown_at(entry: Entry, sensor, k: int) -> np.ndarray:
    """Return (H, W) bool: the pixels that count when k solids are there."""
    if k >= len(entry.names):
        return np.ones(sensor.observed.shape, bool)
    _, label = model_image(entry.chart, entry.start, sensor.camera)
    missing = label > k
    for _ in range(1 + int(np.ceil(3.0 * sensor.values.get("blur", 0.0)))):  # the blur mixes neighbours
        grown = missing.copy()
        for axis in (0, 1):
            grown |= np.roll(missing, 1, axis) | np.roll(missing, -1, axis)
        missing = grown
    return ~missing


def first_solids(entry: Entry, k: int) -> Entry:
    """Return the entry of the first k solids alone."""
    k = min(k, len(entry.names))
    slots = entry.chart.slots[:k]
    chart = entry.chart._replace(flags=entry.chart.flags[:k], slots=slots, base=entry.chart.base[:k],
                                 order=entry.chart.order[:k])  # fmt: skip
    size = len(entry.mean)
    columns = [*range(1 + int(slots.max(initial=-1))), *range(size - FLOOR_WAYS, size)]
    covariance = entry.covariance[np.ix_(columns, columns)]
    steps = [*single_steps(chart), *block_steps(chart, covariance)]
    return entry._replace(names=entry.names[:k], chart=chart, start=entry.start[columns], mean=entry.mean[columns],
                          labels=tuple(entry.labels[i] for i in columns), covariance=covariance,
                          proposals=make_proposals(steps))  # fmt: skip


class Stage:
    """Entries cut to their first k solids, and engines for the pixels that count then."""

    def __init__(self, rng, walker: Walker, k: int) -> None:
        self.rng, self.entries, self.region, self.sensor, self.k = rng, walker.entries, walker.region, walker.sensor, k
        self._made: dict = {}

    def of(self, number: int):
        """Return (entry, engine, conditional of what is new, log of the factor c) of one entry."""
        if number not in self._made:
            whole = self.entries[number]
            entry = first_solids(whole, self.k)
            observed = np.where(shown_at(whole, self.sensor, self.k), self.sensor.observed, np.nan)
            engine = engine_of(entry.chart, self.sensor._replace(observed=observed))
            ahead = 0.0
            if self.k < len(whole.names):
                present = sum(load(engine, entry.chart, entry.start))
                present += 0.5 * np.linalg.slogdet(2.0 * np.pi * entry.covariance)[1]
                ahead = whole.log_evidence - present
            new = whole.names[self.k - 1 : self.k]
            own = entry.columns_of((*new, "floor") if self.k == 1 else new)
            run(self.rng, engine, entry.chart, entry.start.copy(), entry.proposals, 1.0, 0.1, ADAPT // 10, 10)
            self._made[number] = entry, engine, conditional(entry, own), ahead
        return self._made[number]


def population(rng, walker: Walker, particles: int, tell=lambda fraction: None) -> Population:
    """Return particles of equal weight from the posterior over a walker's catalogue."""
    pull = pull_of(walker.entries)
    pull /= pull.sum()
    places = [Place(int(e), np.empty(0), 0.0, 0.0) for e in rng.choice(len(pull), particles, p=pull)]
    logs = -np.log(pull[[place.entry for place in places]])
    most = max(len(entry.names) for entry in walker.entries)
    log_evidence, effective = 0.0, []
    for k in range(1, most + 1):
        stage = Stage(rng, walker, k)
        trials = []
        for place, log in zip(places, logs, strict=True):
            count = TRIALS if k <= len(walker.entries[place.entry].names) else 1
            for _ in range(count):
                trial, gain = entered(rng, stage, place)
                trials.append((trial, log + gain - np.log(count)))
        grown = np.array([log for _, log in trials])
        top = grown.max()
        weights = np.exp(grown - top)
        log_evidence += float(top + np.log(weights.sum() / particles))
        effective.append(float(weights.sum() ** 2 / np.sum(weights**2) / particles))
        places = [walked(rng, stage, trials[i][0]) for i in systematic(rng, weights, particles)]
        logs = np.zeros(particles)
        tell(k / (most + 1))
    for i, place in enumerate(places):
        place = walker.place(place.entry, place.values)
        for _ in range(ROUNDS):
            place = walker.stepped(rng, place, STEPS * most)
        places[i] = place
    tell(1.0)
    return Population(places, log_evidence, np.array(effective))


def entered(rng, stage: Stage, place: Place) -> tuple[Place, float]:
    """Return a particle with one solid more, and the log of the growth of its weight."""
    entry, engine, new, ahead = stage.of(place.entry)
    values = np.empty(len(entry.mean))
    values[np.setdiff1d(np.arange(len(values)), new.own)] = place.values
    new.sample(rng, values)
    if not stage.region.holds(entry.chart, values):
        return Place(place.entry, values, 0.0, 0.0), -np.inf
    log_prior, log_likelihood = load(engine, entry.chart, values)
    log_likelihood += ahead
    gain = log_prior + log_likelihood - place.log_prior - place.log_likelihood - new.log_density(values)
    return Place(place.entry, values, log_prior, log_likelihood), float(gain)


def walked(rng, stage: Stage, place: Place) -> Place:
    """Return a particle after a walk that leaves the stage's target invariant."""
    entry, engine, _, ahead = stage.of(place.entry)
    values = place.values.copy()
    steps = STEPS * max(len(entry.names), 1)
    draws = run(rng, engine, entry.chart, values, entry.proposals, 1.0, 0.0, 1, steps)
    values = folded(entry.chart, values)
    if not stage.region.holds(entry.chart, values):
        return place
    log_prior, log_likelihood = map(float, draws.densities[-1])
    return Place(place.entry, values, log_prior, log_likelihood + ahead)
