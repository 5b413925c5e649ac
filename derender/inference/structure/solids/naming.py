"""The same name for the same solid in several structures."""

import numpy as np

from derender.inference.structure.solids.state import FLOOR


def matched_names(state, reference, names):
    """Return names for a state's solids: those of the reference solids that they are, new ones for the others."""
    result, used = [""] * len(state), set()
    for k in range(len(state)):
        best, found = 0.5 * float(np.min(state.rows[k][13:16])), None
        for j, name in enumerate(names):
            distance = float(np.linalg.norm(state.rows[k][10:13] - reference.rows[j][10:13]))
            if name not in used and distance < best:
                best, found = distance, name
        if found is not None:
            result[k] = found
            used.add(found)
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
