"""Structures in which two boxes are one, or their union is cut in another way; see alternatives.py."""

from functools import partial
from typing import Any

import numpy as np

from derender.compilation.threads import in_threads
from derender.detection.search.moves import corners_of, cut_anew, grown, touching_pairs
from derender.detection.solids.beliefs import Rules
from derender.detection.solids.image import rotation_of
from derender.detection.solids.interpenetration import highest, lowest, penetration
from derender.detection.solids.misfit import LIMIT
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.detection.solids.support import final_parents, with_bottom
from derender.render.likelihoods.pixelwise import noise_at
from derender.scene.solids import BOX, SPHERE
from derender.structures.alternatives import DOUBTFUL, QUICK, climbed, tried, unclimbed, weighed_whole
from derender.structures.changes import LEAST_TALL, carried_upright, reached_down
from derender.structures.draws.chart import Chart, make_chart
from derender.structures.draws.refined import Refined, floor_pose_of, height
from derender.structures.weighing import Block, Weighed, of_block

NEIGHBOURS = 0.004  # metres between boxes that may be one
HIDDEN_GAP = 0.06  # metres between what may be one box whose middle is hidden
BESIDE = 0.02  # metres between a low box and what stands behind it that may stand on it
UNDER = 0.5  # share of the extents of what is put on a box that the box reaches under
THOROUGH = 600  # for each solid where two are cut anew: all edges about them may be a little off
FLUSH_ENOUGH = 150.0  # nats by which the image of a pair of boxes may change when it is cut anew, before any climb


def merged_row(row: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the row of the upright box about two upright boxes, along the axes of the first."""
    rotation = rotation_of(row)
    along = np.concatenate([corners_of(row), corners_of(other)]) @ rotation
    low, high = along.min(axis=0), along.max(axis=0)
    new = row.copy()
    new[10:13] = rotation @ (0.5 * (low + high))
    new[13:16] = high - low
    return new


def merges(rng: np.random.Generator, best: Refined, rules: Rules) -> list[Any]:
    """Return the Weighed of an upright box being one with a smaller one beside it, or, but where neighbouring pixels
    share noise, with what is there of any other kind, however large: a can may be what shows of a corner; or with what
    a gap parts from it of which the image shows as good as nothing; and of a tilted box going on to the floor through
    a smaller one, which shows of its foot."""
    state, tasks = best.state, []
    boxes = [k for k in range(len(state)) if int(state.rows[k][0]) == BOX]
    upright = [k for k in boxes if state.forms[k] == UPRIGHT]
    for i in boxes:
        for j in range(len(state)) if best.sensor.worth >= 1.0 else upright:
            if i == j or j in boxes and np.prod(state.rows[i][13:]) < np.prod(state.rows[j][13:]):
                continue
            if i not in upright:
                ones = [longer.without(j) for longer in reached_down(best, i) if touching(longer, i, j)]
            elif touching(state, i, j):
                ones = [likeliest_of(best, ways_as_one(state, i, j), rules)]
            elif parted_unseen(best, i, j, rules):
                ones = [as_one(state, i, j)]
            else:
                ones = []
            tasks += [partial(merged, best=best, state=one, i=i, j=j, rules=rules) for one in ones]
    return [found for found in in_threads(rng, tasks) if found is not None]


def likeliest_of(best: Refined, states: list[State], rules: Rules) -> State:
    """Return the one of some states that is likeliest as it is, on the floor and under the sensor of a Refined."""
    floor = floor_pose_of(best)
    return max(states, key=lambda state: height(unclimbed(state, floor, best.sensor, rules)))


def touching(state: State, i: int, j: int, gap: float = NEIGHBOURS) -> bool:
    """Whether solids i and j are within a gap (metres) of each other."""
    return penetration(grown(state.rows[i], gap), state.rows[j]) > 0.0


def parted_unseen(best: Refined, i: int, j: int, rules: Rules) -> bool:
    """Whether solids i and j are apart, and the image is about as well explained were they one box."""
    if not touching(best.state, i, j, HIDDEN_GAP):
        return False
    return change_of_image(best, *make_chart(as_one(best.state, i, j), floor_pose_of(best), rules)) < FLUSH_ENOUGH


def as_one(state: State, i: int, j: int, row: np.ndarray | None = None) -> State:
    """Return the state with an upright box in place of solids i and j, what stands on them on it.
    row : the box's; None: the one about both along the axes of i."""
    lower = i if lowest(state.rows[i]) <= lowest(state.rows[j]) else j
    row = merged_row(state.rows[i], state.rows[j]) if row is None else row
    new = state.changed(i, row=row, cube=False, parent=state.parents[lower], bottom=state.bottoms[lower])
    new.parents = [i if p == j and k != i else p for k, p in enumerate(new.parents)]
    for k in carried_upright(new, i):
        if k != j:
            new.bottoms[k] = highest(row)
    return new.without(j)


def ways_as_one(state: State, i: int, j: int) -> list[State]:
    """Return the states in which an upright box and another solid are one box: about both, along either's axes, or as
    one of them was, for what was cut in two may have been turned and sized to fit its half."""
    bottom = min(lowest(state.rows[i]), lowest(state.rows[j]))
    pairs = [(state.rows[k], state.rows[other]) for k, other in ((i, j), (j, i))
             if int(state.rows[k][0]) == BOX and state.forms[k] == UPRIGHT]  # fmt: skip
    rows = [merged_row(*pair) for pair in pairs] + [with_bottom(row, bottom) for row, _ in pairs]
    return [as_one(state, i, j, row) for row in rows]


def merged(rng: np.random.Generator, best: Refined, state: State, i: int, j: int, rules: Rules) -> Weighed | None:
    """Return the Weighed of a state in which solid `j` is part of `i`; None where that is pruned."""
    place = i - (j < i)
    places = [place, *carried_upright(state, place)]
    trial = tried(rng, best, state, places, rules)
    own = [i, j, *(k + (k >= j) for k in places[1:])]
    return None if trial is None else of_block(rng, Block(trial, places), Block(best, own))


def recuts(rng, best, rules):
    """Return the Weighed of two boxes that touch being cut in another way, or one and all that it runs on through:
    which of the cuts it is the image does not tell, but which solids their contacts can hold."""
    state, floor = best.state, floor_pose_of(best)
    pairs = [(i, j) for i, j in touching_pairs(state) if FREE not in (state.forms[i], state.forms[j])]
    ways = [((i,), j) for i, j in pairs]
    ways += [(all_of, j) for j in range(len(state)) if len(all_of := tuple(i for i, k in pairs if k == j)) > 1]
    states = [grown_into(state, cut, j) for cut, j in ways]
    flush = [
        on_supports(new) for new in states
        if new is not None and change_of_image(best, *make_chart(new, floor, rules)) < FLUSH_ENOUGH
    ]  # fmt: skip
    rough = climbed(rng, best, flush, rules, QUICK, DOUBTFUL)
    return weighed_whole(rng, best, [each.state for each in rough] * 2, rules, THOROUGH)


def grown_into(state: State, cut: tuple[int, ...], j: int) -> State | None:
    """Return the state with box j grown into others, which are cut back (moves.cut_anew), held to nothing yet; None:
    nothing of one is left."""
    for i in cut:
        pieces = cut_anew(state.rows[i], state.rows[j])
        if pieces is None:
            return None
        for k, piece in zip((i, j), pieces, strict=True):
            state = state.changed(k, row=piece, cube=False, bottom=np.nan)
    return state


def put_on(rng: np.random.Generator, best: Refined, rules: Rules) -> list[Weighed]:
    """Return the Weighed of a tall solid standing on a lower box beside it, which reaches under its middle, not there:
    of few noisy pixels that is one step farther or nearer below the edge between the two, which no walk takes."""
    state = best.state
    upright = [k for k in range(len(state)) if state.forms[k] == UPRIGHT and int(state.rows[k][0]) != SPHERE]
    tasks = [partial(put_one_on, best=best, i=i, j=j, rules=rules) for i in upright for j in upright
             if i != j and may_stand_on(state, i, j)]  # fmt: skip
    return [found for found in in_threads(rng, tasks) if found is not None]


def may_stand_on(state: State, i: int, j: int) -> bool:
    """Whether upright solid i begins below the top of box j, beside it, and ends above it."""
    row, other = state.rows[i], state.rows[j]
    if int(other[0]) != BOX or not lowest(row) + LEAST_TALL < highest(other) < highest(row) - LEAST_TALL:
        return False
    return penetration(grown(row, BESIDE), other) > 0.0


def put_one_on(rng: np.random.Generator, best: Refined, i: int, j: int, rules: Rules) -> Weighed | None:
    """Return the Weighed of solid i standing on box j; None where that is pruned."""
    state = best.state
    under, top, inner = state.rows[j], highest(state.rows[j]), state.rows[i].copy()
    inner[13:15] *= UNDER
    inner[[12, 15]] = under[[12, 15]]
    under = merged_row(under, inner)
    higher = with_bottom(state.rows[i], top)
    new = state.changed(j, row=under, cube=False).changed(i, row=higher, cube=False, parent=j, bottom=top)
    trial = tried(rng, best, new, [i, j], rules)
    return None if trial is None else of_block(rng, Block(trial, [i, j]), Block(best, [i, j]))


def change_of_image(best: Refined, chart: Chart, values: np.ndarray) -> float:
    """Return how much worse another chart's images explain those of the best in nats, no pixel more than LIMIT."""
    total = 0.0
    for view in best.sensor.views:
        before, after = view.clean(best.chart, best.values), view.clean(chart, values)
        total += float(np.minimum(0.5 * ((after - before) / noise_at(before, view.values)) ** 2, LIMIT).sum())
    return total


def on_supports(state: State) -> State:
    """Return the state with each upright solid on what bears it, and held to its top."""
    state = state.copy()
    state.parents = final_parents(state)
    for k, parent in enumerate(state.parents):
        if state.forms[k] == UPRIGHT:
            state.bottoms[k] = 0.0 if parent == FLOOR else highest(state.rows[parent])
    return state
