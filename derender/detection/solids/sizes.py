"""Densities of solids' extents as a prior file states them, tabulated so that compiled code needs to know no types."""

from typing import Any

import numpy as np

from derender.compilation.cache import njit
from derender.scene.distributions import Distribution
from derender.scene.shapes import shapes
from derender.scene.solids import BOX, CYLINDER, PLANE, SPHERE

CUBE = PLANE  # row of a table of sizes, besides BOX, CYLINDER and SPHERE: a plane has none
NODES = 129
LOW, HIGH, FIRST = 0, 1, 2  # columns: where the table begins and ends, log metres; log densities at equal steps
# Beyond the ends densities fall off as a normal one's tails of this width: chains find back from a first guess.
EDGE = 3e-4  # metres
ENDS = 1e-4, 1e3  # metres: of a table of what a prior does not have; none begins nearer to nothing
REST = 1e-9  # probability in each tail that is cut off where a density has no end
AXES = {"cube": ("side",) * 3, "box": ("length", "width", "height"), "sphere": ("radius",) * 3,
        "cylinder": ("radius", "radius", "height")}  # fmt: skip
ROWS = {"cube": CUBE, "box": BOX, "sphere": SPHERE, "cylinder": CYLINDER}


def sizes_of(prior: Any) -> np.ndarray:
    """Return the table (4, 3, FIRST + NODES) of a prior over structures.

    Several shapes of one type are mixed axis by axis. A type that the prior does not have is left without sizes: the
    search does not look for it.
    """
    table = np.zeros((4, 3, FIRST + NODES))
    table[:, :, LOW], table[:, :, HIGH] = np.log(ENDS)
    for kind, names in AXES.items():
        entries = [entry for entry in prior.shapes.values() if entry.type == kind]
        defaults = {parameter.name: parameter.default for parameter in shapes[kind].parameters}
        for axis, name in enumerate(names):
            values = [(entry.weight, entry.values.get(name, defaults[name])) for entry in entries]
            if values:
                table[ROWS[kind], axis] = tabulated(values, 2.0 if name == "radius" else 1.0)
    return table


def tabulated(values: list[tuple[float, Distribution | float]], factor: float) -> np.ndarray:
    """Return (FIRST + NODES,) the row of `factor` times a mixture of (weight, number or Distribution)."""
    ends = factor * np.array([ends_of(value) for _, value in values])
    low, high = max(ends[:, 0].min(), ENDS[0]), ends[:, 1].max()
    grid = np.geomspace(low, high, NODES)
    density = np.zeros(NODES)
    for weight, value in values:
        density += weight * np.exp([log_density_of(value, x / factor) for x in grid])
    density = np.maximum(density, 1e-12 * density.max())
    inside = 0.5 * ((density[1:] + density[:-1]) * np.diff(grid)).sum()
    tails = EDGE * np.sqrt(0.5 * np.pi) * (density[0] + density[-1])
    return np.concatenate([np.log([low, high]), np.log(density / (inside + tails))])


def ends_of(value: Distribution | float) -> tuple[float, float]:
    """Return (low, high) between which a value lies."""
    if not isinstance(value, Distribution):
        return value - EDGE, value + EDGE
    low, high = value.support
    return (value.quantile(REST) if not np.isfinite(low) or low <= 0.0 else low,
            value.quantile(1.0 - REST) if not np.isfinite(high) else high)  # fmt: skip


def log_density_of(value: Any, x: float) -> float:
    """Return the log density of a number or Distribution at x: a number's is even between its ends."""
    if isinstance(value, Distribution):
        return value.log_density(x)
    return 0.0 if abs(x - value) <= 1.01 * EDGE else -np.inf


@njit(cache=True, nogil=True, borrows=True)
def log_density_at(row, extent):
    """Return the log density of an extent by a row of the table."""
    inside = min(max(np.log(extent), row[LOW]), row[HIGH])
    place = (inside - row[LOW]) / (row[HIGH] - row[LOW]) * (NODES - 1)
    node = min(int(place), NODES - 2)
    share = place - node
    beyond = (extent - np.exp(inside)) / EDGE
    return (1.0 - share) * row[FIRST + node] + share * row[FIRST + node + 1] - 0.5 * beyond * beyond


@njit(cache=True, nogil=True, borrows=True)
def box_log_density(table, extents, upright):
    """Return the log density of a box's three extents, whichever of its names each has.

    upright : the third is the height; otherwise any may be.
    """
    best, total = -np.inf, 0.0
    for turn in range(1 if upright else 3):  # which extent is the height; none but the last of an upright box
        c = (2 + turn) % 3
        for flip in range(2):
            a, b = ((c + 1) % 3, (c + 2) % 3) if flip == 0 else ((c + 2) % 3, (c + 1) % 3)
            value = log_density_at(table[0], extents[a]) + log_density_at(table[1], extents[b])
            value += log_density_at(table[2], extents[c])
            if value > best:
                total = total * np.exp(best - value) + 1.0 if best > -np.inf else 1.0
                best = value
            else:
                total += np.exp(value - best)
    return best + np.log(total / (2.0 if upright else 6.0))
