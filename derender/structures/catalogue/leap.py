"""Leaps: from one entry of a catalogue to another, what is the same in both kept, the rest drawn from its normal.

Entries s and t share the solids that are alike in both (`shared_of`); their coordinates and the floor's, y, are kept.
What else there is in s, u, makes way for what else there is in t, v. In either entry u (or v) is proposed from the
mixture of two normals about the regression on the y that its fitted normal gives,

    g(u | y) = (1 - WIDE) N(u; m + B (y - m_y), S) + WIDE N(u; the same, WIDER^2 S).

The choices of the leap are (t, v), the way back is (s, u): coordinates only change places, so the Jacobian is one and

    log ratio = log pi_t(y, v) - log pi_s(y, u) + log g_s(u | y) - log g_t(v | y) + log w(s | t) - log w(t | s).

Where pi is normal this is the difference of the log evidences. All that it needs is fixed before the chain starts.
"""

import math
from typing import NamedTuple

import numpy as np

from derender.structures.catalogue.entry import Entry

WIDE, WIDER = 0.2, 2.5
INFLATED = 1.1  # factor of the spread of a normal that was fitted to few draws
APART = 3.0  # sums of the spreads that a shared solid's mean may differ by
CORRELATED, MOST_REGRESSORS = 0.2, 12


class Conditional(NamedTuple):
    """The proposal of some coordinates given others of one entry.

    own, given : (K,), (R,) coordinates. centre : (K,), middle : (R,), slope : (K, R); factor : (K, K) lower Cholesky.
    """

    own: np.ndarray
    given: np.ndarray
    centre: np.ndarray
    middle: np.ndarray
    slope: np.ndarray
    factor: np.ndarray
    log_factor: float

    def sample(self, rng, values: np.ndarray) -> None:
        """Write own coordinates drawn given the others into `values` (D,)."""
        if len(self.own):
            reach = WIDER if rng.random() < WIDE else 1.0
            centre = self.centre + self.slope @ (values[self.given] - self.middle)
            values[self.own] = centre + reach * (self.factor @ rng.standard_normal(len(self.own)))

    def log_density(self, values: np.ndarray) -> float:
        """Return log g of the own coordinates of `values` given the others."""
        size = len(self.own)
        if not size:
            return 0.0
        offset = values[self.own] - self.centre - self.slope @ (values[self.given] - self.middle)
        z = np.linalg.solve(self.factor, offset)
        square = float(z @ z)
        near = math.log(1.0 - WIDE) - 0.5 * square
        far = math.log(WIDE) - 0.5 * square / WIDER**2 - size * math.log(WIDER)
        return float(np.logaddexp(near, far)) - self.log_factor - 0.5 * size * math.log(math.tau)


def conditional(entry: Entry, own) -> Conditional:
    """Return the proposal of coordinates `own` given all others of an entry."""
    own = np.array(sorted(own), np.int64)
    rest = np.setdiff1d(np.arange(len(entry.mean)), own)
    covariance = entry.covariance
    if not len(own):
        return Conditional(own, rest[:0], np.empty(0), np.empty(0), np.empty((0, 0)), np.empty((0, 0)), 0.0)
    spread = np.sqrt(np.diag(covariance))
    tie = np.abs(covariance[np.ix_(own, rest)] / np.outer(spread[own], spread[rest])).max(axis=0, initial=0.0)
    tied = [int(rest[k]) for k in np.argsort(-tie)[:MOST_REGRESSORS] if tie[k] > CORRELATED]
    given = np.array(sorted(tied), np.int64)
    block = covariance[np.ix_(own, own)]
    slope = np.zeros((len(own), len(given)))
    if len(given):
        slope = np.linalg.solve(covariance[np.ix_(given, given)], covariance[np.ix_(given, own)]).T
        block = block - slope @ covariance[np.ix_(given, own)]
    block = INFLATED**2 * 0.5 * (block + block.T) + np.diag((0.02 * spread[own]) ** 2 + 1e-12)
    factor = np.linalg.cholesky(block)
    log_factor = float(np.sum(np.log(np.diag(factor))))
    return Conditional(own, given, entry.mean[own], entry.mean[given], slope, factor, log_factor)


class Leap(NamedTuple):
    """The way between two entries.

    kept : (2, K) coordinates of what is shared, in the one and in the other. back, forth : proposals of the rest.
    """

    kept: np.ndarray
    back: Conditional
    forth: Conditional


def shared_of(one: Entry, other: Entry) -> set[str]:
    """Return the names of the solids that are alike in two entries: same variant, same place, on what is alike."""
    alike = {name for name in one.names if name in other.names and one.variant(name) == other.variant(name)}
    here, there = ({label: i for i, label in enumerate(e.labels)} for e in (one, other))
    for label, i in here.items():
        if label[0] in alike:
            j = there[label]
            apart = abs(one.mean[i] - other.mean[j])
            if apart > APART * (math.sqrt(one.covariance[i, i]) + math.sqrt(other.covariance[j, j])):
                alike.discard(label[0])
    changed = (set(one.names) | set(other.names)) - alike
    return alike - one.carried(changed & set(one.names)) - other.carried(changed & set(other.names))


def make_leap(one: Entry, other: Entry) -> Leap:
    """Return the Leap from one entry to another."""
    shared = shared_of(one, other) | {"floor"}
    there = {label: i for i, label in enumerate(other.labels)}
    pairs = [(i, there[label]) for i, label in enumerate(one.labels) if label[0] in shared]
    kept = np.array(pairs, np.int64).T
    own = [np.setdiff1d(np.arange(len(e.mean)), kept[k]) for k, e in enumerate((one, other))]
    return Leap(kept, conditional(one, own[0]), conditional(other, own[1]))


def leap_values(rng, leap: Leap, values: np.ndarray, size: int) -> tuple[np.ndarray, float]:
    """Return the coordinates (size,) in the other entry, and log g_s(u | y) - log g_t(v | y)."""
    new = np.empty(size)
    new[leap.kept[1]] = values[leap.kept[0]]
    leap.forth.sample(rng, new)
    return new, leap.back.log_density(values) - leap.forth.log_density(new)
