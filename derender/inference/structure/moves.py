"""Moves between structures: take out and explain anew, split, merge, put a support under what floats.

Each move takes (rng, image, state, hypotheses, settings, places) and returns (new state, set of changed indices) or
None where it does not apply. `places` tells where the image is badly explained. The search accepts what lowers the
energy.
"""

from typing import NamedTuple

import numpy as np

from derender.inference.structure.image import rotation_of
from derender.inference.structure.polish import FREE, UPRIGHT
from derender.inference.structure.state import FLOOR, held_out
from derender.inference.structure.touch import highest, lowest, penetration
from derender.model.solids import BOX


class Places(NamedTuple):
    """Where the image is badly explained.

    Attributes
    ----------
    blame : (N + 1,) bad pixels about each solid (last: about none).
    pairs : (N + 1, N + 1) how many bad pixels two solids share.
    points : (B, 3) float64, the observed points of the bad pixels, floor frame.
    """

    blame: np.ndarray
    pairs: np.ndarray
    points: np.ndarray


def find_places(image, state, limit=4.5):
    """Return the Places of a state; lone pixels count for nothing: they are noise or the rounding of a silhouette."""
    depth, label, misfit, _ = held_out(image, state, -1)
    bad = misfit > limit
    crowd = np.zeros(bad.shape, int)
    crowd[1:] += bad[:-1]
    crowd[:-1] += bad[1:]
    crowd[:, 1:] += bad[:, :-1]
    crowd[:, :-1] += bad[:, 1:]
    rows, columns = np.nonzero(bad & (crowd > 0))
    count = len(state)
    blame, pairs = np.zeros(count + 1), np.zeros((count + 1, count + 1))
    for j, i in zip(rows, columns, strict=True):
        near = np.unique(label[max(j - 2, 0) : j + 3, max(i - 2, 0) : i + 3])
        near = near[near >= 0]
        if len(near) == 0:
            near = np.array([count])
        blame[near] += 1.0 / len(near)
        pairs[np.ix_(near, near)] += 1
    np.fill_diagonal(pairs, 0)
    points = image.origin + image.depth[rows, columns, None] * image.direction[rows, columns]
    return Places(blame, pairs, points)


def pick(rng, weight):
    """Return an index drawn with probability proportional to weight (a little for those with none)."""
    weight = np.asarray(weight, float) + 1e-2
    return int(rng.choice(len(weight), p=weight / weight.sum()))


def explain_anew(rng, image, state, hypotheses, settings, places):
    """Take out one solid with some of those that share its badly explained pixels, and explain what they showed."""
    from derender.inference.structure.search import greedy

    seed = pick(rng, places.blame)
    out = {seed} if seed < len(state) else set()
    out |= {j for j in range(len(state)) if places.pairs[seed, j] > 0 and rng.random() < 0.5}
    new = state.copy()
    for k in sorted(out, reverse=True):
        new = new.without(k)
    kept = len(new)
    new = greedy(rng, image, hypotheses, settings, new, tried=2, shake=0.7)
    return new, set(range(kept, len(new)))


def split(rng, image, state, hypotheses, settings, places):
    """Cut a box in two across one of its axes, at a badly explained point or anywhere, and polish both pieces."""
    from derender.inference.structure.search import run_polish

    boxes = [i for i in range(len(state)) if int(state.rows[i][0]) == BOX]
    if not boxes or len(state) >= settings.max_objects:
        return None
    i = boxes[pick(rng, places.blame[boxes])]
    row = state.rows[i]
    axis = int(rng.integers(3))
    half = 0.5 * row[13 + axis]
    cut = rng.uniform(-0.8, 0.8) * half
    if len(places.points) and rng.random() < 0.7:
        along = (places.points[rng.integers(len(places.points))] - row[10:13]) @ rotation_of(row)[:, axis]
        if abs(along) < 0.95 * half:
            cut = along
    pieces = []
    for low, high in ((-half, cut), (cut, half)):
        piece = row.copy()
        piece[13 + axis] = max(high - low, 0.006)
        piece[10:13] += 0.5 * (low + high) * rotation_of(row)[:, axis]
        pieces.append(piece)
    new = state.copy()
    new.cubes[i] = False
    new.rows[i] = pieces[0]
    new = new.add(pieces[1], state.forms[i], False)
    last = len(new) - 1
    for k in (i, last) if rng.random() < 0.5 else (last, i):
        view = held_out(image, new, k)
        row, form = new.rows[k], new.forms[k]
        new.rows[k], _, _ = run_polish(rng, image, new, k, row, form, False, view, np.nan, settings, 250)
    return new, {i, last}


def corners_of(row):
    """Return the eight corners (8, 3) of a solid's oriented box."""
    signs = np.array([[a, b, c] for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (-0.5, 0.5)])
    return row[10:13] + (signs * row[13:16]) @ rotation_of(row).T


def merge(rng, image, state, hypotheses, settings, places):
    """Put one box in place of two near and aligned ones, spanning both along the axes of one."""
    near = aligned_pairs(state, 0.06)
    if not near:
        return None
    i, j = near[int(rng.integers(len(near)))]
    return merge_pair(rng, image, state, settings, i, j, rng.random(3) < 0.3)


def aligned_pairs(state, gap):
    """Return the ordered pairs of boxes whose axes agree and whose distance is at most about 2 * gap metres."""
    boxes = [i for i in range(len(state)) if int(state.rows[i][0]) == BOX]
    pairs = [(i, j) for i in boxes for j in boxes if i != j]
    return [
        (i, j)
        for i, j in pairs
        if alignment(state.rows[i], state.rows[j]) > 0.98 and penetration(grown(state.rows[i], gap), state.rows[j]) > 0
    ]


def merge_pair(rng, image, state, settings, i, j, spread):
    """Return (state, changed) with box i grown over box j, which is taken out.

    spread : (3,) bool, along which axes of i it is to span j; along the one where j reaches furthest beyond it always.
    """
    from derender.inference.structure.search import run_polish

    row = state.rows[i]
    along = (np.vstack([corners_of(row), corners_of(state.rows[j])]) - row[10:13]) @ rotation_of(row)
    low, high = along.min(axis=0), along.max(axis=0)
    spread = np.array(spread)
    spread[np.argmax(np.maximum(high, -low) - 0.5 * row[13:16])] = True
    low = np.where(spread, low, np.maximum(low, -0.5 * row[13:16]))
    high = np.where(spread, high, np.minimum(high, 0.5 * row[13:16]))
    whole = row.copy()
    whole[10:13] += rotation_of(row) @ ((low + high) / 2)
    whole[13:16] = np.maximum(high - low, 0.006)
    new = state.copy()
    new.rows[i], new.cubes[i] = whole, False
    new = new.without(j)
    i -= j < i
    view = held_out(image, new, i)
    new.rows[i], _, _ = run_polish(rng, image, new, i, whole, new.forms[i], False, view, np.nan, settings, 300)
    return new, {i}


def alignment(row, other):
    """Return how nearly the axes of two boxes agree up to their order: the least of the best cosines."""
    return float(np.abs(rotation_of(row).T @ rotation_of(other)).max(axis=0).min())


def grown(row, by=0.008):
    """Return the solid grown by this much on all sides."""
    new = row.copy()
    new[13:16] += 2 * by
    return new


def put_under(rng, image, state, hypotheses, settings, places):
    """Put a box under a solid that floats, from the floor or the next solid below up to its lowest point."""
    from derender.inference.structure.search import run_polish

    floating = [i for i in range(len(state)) if np.isnan(state.bottoms[i]) and lowest(state.rows[i]) > 0.015]
    if not floating or len(state) >= settings.max_objects:
        return None
    i = floating[int(rng.integers(len(floating)))]
    row = state.rows[i]
    ceiling = lowest(row)
    below = [0.0] + [highest(r) for r in state.rows if highest(r) < ceiling - 0.012]
    bottom = below[int(rng.integers(len(below)))]
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
    new = state.add(box, UPRIGHT, False, FLOOR, bottom)
    return new, {i, len(new) - 1}


def raise_support(rng, image, state, hypotheses, settings, places):
    """Raise the top of a box to the bottom of one that floats above it."""
    from derender.inference.structure.search import run_polish
    from derender.inference.structure.support import shadows_overlap

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


MOVES = ((explain_anew, 0.45), (split, 0.2), (merge, 0.15), (put_under, 0.1), (raise_support, 0.1))


def propose(rng, image, state, hypotheses, settings, places):
    """Return (move's name, new state, changed indices) of a random move, or None where it does not apply."""
    move = MOVES[rng.choice(len(MOVES), p=[w for _, w in MOVES])][0]
    result = move(rng, image, state, hypotheses, settings, places)
    return None if result is None else (move.__name__, *result)
