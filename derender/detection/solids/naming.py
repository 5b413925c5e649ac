"""The same name for the same solid in several structures."""

import numpy as np

from derender.detection.solids.interpenetration import penetration
from derender.detection.solids.state import FLOOR


def matched_names(state, reference, names):
    """Return names for a state's solids: those of the reference solids that they are, new ones for the others.

    They are the same if they enter each other by half of what is thinnest, however far a hidden side reaches; the
    nearest first.
    """
    pairs = []
    for k, row in enumerate(state.rows):
        for j, other in enumerate(reference.rows):
            if penetration(row, other) > 0.5 * min(row[13:16].min(), other[13:16].min()):
                pairs.append((float(np.linalg.norm(row[10:13] - other[10:13])), k, names[j]))
    result, used = [""] * len(state), set()
    for _, k, name in sorted(pairs):
        if not result[k] and name not in used:
            result[k] = name
            used.add(name)
    fresh = 1
    for k in range(len(state)):
        if not result[k]:
            while f"solid_{fresh}" in names or f"solid_{fresh}" in used:
                fresh += 1
            result[k] = f"solid_{fresh}"
            used.add(result[k])
    return result


def structure_key(state, names):
    """Return what tells two structures apart: each solid's name, kind, cube or not, form, and its support's name."""
    return tuple(sorted(
        (names[k], int(state.rows[k][0]), state.cubes[k], state.forms[k],
         "floor" if state.parents[k] == FLOOR else names[state.parents[k]])
        for k in range(len(state))
    ))  # fmt: skip
