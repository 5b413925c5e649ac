"""A chain over the entries of a catalogue: compiled walks within a structure, leaps between structures.

The target is the posterior cut to a region (`region.py`). A walk is a power of a reversible kernel, so it is reversible
itself: to go back to its start where it ends outside leaves the cut posterior invariant, and so does folding.
"""

from typing import NamedTuple

import numpy as np

from derender.structures.catalogue.catalogue import shares_of
from derender.structures.catalogue.leap import leap_values, make_leap
from derender.structures.catalogue.region import Region, folded
from derender.structures.draws.metropolis import engine_of, load, run

LEAPS = 3  # tried after each walk


class Place(NamedTuple):
    """entry : number of it; values : (D,); log_prior, log_likelihood : there."""

    entry: int
    values: np.ndarray
    log_prior: float
    log_likelihood: float


class Walker:
    """Takes steps over a catalogue; one for each thread.

    Parameters
    ----------
    entries : of the catalogue. sensor : Sensor.

    Attributes
    ----------
    tried, taken : (E, E) leaps from one entry (row) to another.
    """

    def __init__(self, entries, sensor) -> None:
        self.entries, self.sensor = entries, sensor
        self.engines = [engine_of(entry.chart, sensor) for entry in entries]
        self.shares = shares_of(entries)
        self.region = Region(sensor)
        self.leaps: dict = {}
        self.tried = np.zeros((len(entries), len(entries)), int)
        self.taken = np.zeros((len(entries), len(entries)), int)

    @staticmethod
    def density(chart, sensor, values) -> tuple[float, float]:
        """Return log prior and log likelihood of a chart's coordinates under a sensor."""
        return load(engine_of(chart, sensor), chart, values)

    def place(self, entry: int, values: np.ndarray) -> Place:
        """Return the place at some coordinates, the entry's engine there."""
        return Place(entry, values, *load(self.engines[entry], self.entries[entry].chart, values))

    def walked(self, rng, place: Place, steps: int) -> Place:
        """Return the place after steps within its structure."""
        entry = self.entries[place.entry]
        values = place.values.copy()
        draws = run(rng, self.engines[place.entry], entry.chart, values, entry.proposals, 1.0, 0.0, 1, steps)
        values = folded(entry.chart, values)
        if not self.region.holds(entry.chart, values):
            return place
        return Place(place.entry, values, *map(float, draws.densities[-1]))

    def leapt(self, rng, place: Place) -> Place:
        """Return the place after one leap is tried: there, or where it was."""
        here = place.entry
        to = int(np.searchsorted(np.cumsum(self.shares[here]), rng.random()))
        to = min(to, len(self.entries) - 1)
        if to == here:
            return place
        if (here, to) not in self.leaps:
            self.leaps[here, to] = make_leap(self.entries[here], self.entries[to])
        values, ratio = leap_values(rng, self.leaps[here, to], place.values, len(self.entries[to].mean))
        threshold = np.log(1.0 - rng.random())
        self.tried[here, to] += 1
        if not self.region.holds(self.entries[to].chart, values):
            return place
        new = self.place(to, values)
        ratio += new.log_prior + new.log_likelihood - place.log_prior - place.log_likelihood
        ratio += np.log(self.shares[to, here] / self.shares[here, to])
        if not threshold < ratio:
            return place
        self.taken[here, to] += 1
        return new

    def stepped(self, rng, place: Place, steps: int) -> Place:
        """Return the place after a walk of some steps and the leaps that follow it."""
        place = self.walked(rng, place, steps)
        if len(self.entries) > 1:
            for _ in range(LEAPS):
                place = self.leapt(rng, place)
        return place
