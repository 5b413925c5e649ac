"""Moves that change what carries a solid: a box put under it, its bottom lifted, another's top raised, all of it.

Called as moves.py says.
"""

import numpy as np

from derender.detection.search.places import pick
from derender.detection.solids.image import make_row
from derender.detection.solids.interpenetration import highest, lowest, reach
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import FLOOR, held_out, run_polish
from derender.detection.solids.support import LEAST_GAP, shadows_overlap, with_bottom
from derender.scene.solids import BOX, CYLINDER, SPHERE


def put_under(rng, image, state, hypotheses, settings, places):
    """Put a box under a solid that floats, from the floor or the next solid below up to its lowest point."""
    floating = [i for i in range(len(state)) if np.isnan(state.bottoms[i]) and lowest(state.rows[i]) > 0.015]
    if not floating or len(state) >= settings.max_objects:
        return None
    i = floating[int(rng.integers(len(floating)))]
    ceiling = lowest(state.rows[i])
    # what stands there may be pieces of the box that belongs there
    out = [
        j for j in range(len(state))
        if j != i and places.pairs[i, j] > 0 and highest(state.rows[j]) < ceiling + LEAST_GAP and rng.random() < 0.4
    ]  # fmt: skip
    new = state
    for j in sorted(out, reverse=True):
        new = new.without(j)
        i -= j < i
    below = [0.0] + [highest(r) for r in new.rows if highest(r) < ceiling - LEAST_GAP]
    new = with_box_under(rng, image, new, i, below[int(rng.integers(len(below)))], settings)
    return new, {i, len(new) - 1}


def with_box_under(rng, image, state, i, bottom, settings):
    """Return the state with a polished box, the last, from a height up to the lowest point of solid i."""
    row = state.rows[i]
    ceiling = lowest(row)
    box = row.copy()
    box[0] = BOX
    if state.forms[i] == FREE:
        box[1:10] = np.eye(3).ravel()
    box[13:15] = np.minimum(row[13:15], row[13:16].min()) * rng.uniform(0.5, 1.0, 2)
    box[10:12] += rng.uniform(-0.3, 0.3, 2) * row[13:15]
    box[15] = ceiling - bottom
    box[12] = 0.5 * (ceiling + bottom)
    view = held_out(image, state, -1)
    box, _, _ = run_polish(rng, image, state, -1, box, UPRIGHT, False, view, bottom, settings, 300, 0.006)
    return state.add(box, UPRIGHT, False, FLOOR, bottom)


def stand(rng, image, state, hypotheses, settings, places):
    """Put an upright box or cylinder, from the floor or a top below it up, in the place of a solid that floats."""
    floating = [i for i in range(len(state)) if np.isnan(state.bottoms[i]) and lowest(state.rows[i]) > 0.015]
    if not floating:
        return None
    i = floating[int(rng.integers(len(floating)))]
    row, top = state.rows[i], highest(state.rows[i])
    new = state.without(i)
    below = [0.0] + [highest(r) for r in new.rows if highest(r) < lowest(row)]
    bottom = below[int(rng.integers(len(below)))]
    kind = CYLINDER if "cylinder" in settings.shapes and rng.random() < 0.3 else BOX
    c, s = np.cos(angle := rng.uniform(0, np.pi / 2)), np.sin(angle)
    wide = 2.0 * reach(row, c, s, 0.0) * rng.uniform(0.6, 1.0)
    deep = wide if kind == CYLINDER else 2.0 * reach(row, -s, c, 0.0) * rng.uniform(0.4, 1.0)
    whole = make_row(kind, [[c, -s, 0], [s, c, 0], [0, 0, 1]], [row[10], row[11], 0.5 * (bottom + top)],
                     [wide, deep, top - bottom])  # fmt: skip
    view = held_out(image, new, -1)
    whole, _, _ = run_polish(rng, image, new, -1, whole, UPRIGHT, False, view, bottom, settings, 500, 0.005,
                             2.0 * settings.temper)  # fmt: skip
    return new.add(whole, UPRIGHT, False, FLOOR, bottom), {len(new)}


def lift(rng, image, state, hypotheses, settings, places):
    """Let the bottom of a standing box or cylinder go up, and put a box under it where that leaves room."""
    standing = [
        i for i in range(len(state))
        if state.forms[i] == UPRIGHT and int(state.rows[i][0]) != SPHERE and not np.isnan(state.bottoms[i])
    ]  # fmt: skip
    if not standing or len(state) >= settings.max_objects:
        return None
    i = standing[pick(rng, places.blame[standing])]
    old = state.bottoms[i]
    new = state.copy()
    new.cubes[i], new.bottoms[i] = False, np.nan
    start = with_bottom(state.rows[i], old + rng.uniform(0.1, 0.7) * state.rows[i][15])
    view = held_out(image, new, i)
    new.rows[i], _, _ = run_polish(rng, image, new, i, start, UPRIGHT, False, view, np.nan, settings, 250)
    if lowest(new.rows[i]) < old + LEAST_GAP:
        return None
    new = with_box_under(rng, image, new, i, old, settings)
    return new, {i, len(new) - 1}


def raise_support(rng, image, state, hypotheses, settings, places):
    """Raise the top of a box to the bottom of one that floats above it."""
    pairs = []
    for i in range(len(state)):
        if np.isnan(state.bottoms[i]) or state.bottoms[i] < lowest(state.rows[i]) - 0.008:
            for j in range(len(state)):
                row = state.rows[j]
                if j != i and state.forms[j] == UPRIGHT and row[12] < lowest(state.rows[i]) \
                        and shadows_overlap(state.rows[i], row):  # fmt: skip
                    pairs.append((i, j))
    if not pairs:
        return None
    i, j = pairs[int(rng.integers(len(pairs)))]
    new = state.copy()
    row = new.rows[j]
    bottom = lowest(row)
    row[15] = lowest(state.rows[i]) - bottom
    row[12] = bottom + 0.5 * row[15]
    if int(row[0]) == BOX:
        new.cubes[j] = False
    view = held_out(image, new, j)
    new.rows[j], _, _ = run_polish(rng, image, new, j, row, new.forms[j], False, view, bottom, settings, 250)
    return new, {i, j}
