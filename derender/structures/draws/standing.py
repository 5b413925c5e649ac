"""Draws of a walk, which does not know what would tip, drawn again by how much less probable the prior has that."""

import numpy as np

from derender.detection.solids.beliefs import Rules
from derender.detection.solids.image import ROW
from derender.detection.solids.state import State
from derender.detection.solids.support import log_standing
from derender.structures.draws.chart import Chart, place_rows
from derender.structures.draws.metropolis import Draws


def drawn_by_standing(rng: np.random.Generator, state: State, chart: Chart, drawn: Draws, rules: Rules) -> Draws:
    """Return as many Draws, in the same order, each as often as the prior has it stand (stratified resampling)."""
    logs = log_standings(state, chart, drawn.values, rules)
    if np.ptp(logs) == 0.0:
        return drawn
    share = np.exp(logs - np.logaddexp.reduce(logs))
    ends = (np.arange(len(logs)) + rng.random(len(logs))) / len(logs)
    kept = np.minimum(np.searchsorted(np.cumsum(share), ends), len(logs) - 1)
    return drawn._replace(values=drawn.values[kept], densities=drawn.densities[kept])


def log_standings(state: State, chart: Chart, values: np.ndarray, rules: Rules) -> np.ndarray:
    """Return (n,) `log_standing` of a structure at coordinates (n, D)."""
    found = np.empty(len(values))
    state = state.copy()
    state.rows = np.empty((len(state), ROW))
    for k, each in enumerate(values):
        place_rows(chart, each, state.rows)
        found[k] = log_standing(state, rules)
    return found
