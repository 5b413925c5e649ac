"""Moves that change one solid: stretched to what it leaves out, shaken, tilted, new; and what carries it.

A box is put under it, its bottom lifted, another's top raised, all of it. Called as moves.py says.
"""

import numpy as np

from derender.detection.search.bodies import body_hypotheses
from derender.detection.search.greedy import Changed, Task, complexity
from derender.detection.search.places import Places, pick
from derender.detection.solids.image import make_row, rotation_of
from derender.detection.solids.interpenetration import highest, lowest, reach
from derender.detection.solids.polish import FREE, GUESSED, MOVED, UPRIGHT, turn
from derender.detection.solids.state import FLOOR, State, held_out, polish_solid, run_polish
from derender.detection.solids.support import LEAST_GAP, shadows_overlap, with_bottom
from derender.scene.solids import BOX, CYLINDER, SPHERE

LOWER = 0.004  # metres by which what may bear a body is lower than its top


def put_under(rng: np.random.Generator, task: Task, state: State, places: Places) -> Changed | None:
    """Put a box under a solid that floats, from the floor or the next solid below up to its lowest point."""
    floating = [i for i in range(len(state)) if np.isnan(state.bottoms[i]) and lowest(state.rows[i]) > 0.015]
    if not floating or len(state) >= task.settings.max_objects:
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
    new = with_box_under(rng, task, new, i, below[int(rng.integers(len(below)))])
    return new, {i, len(new) - 1}


def with_box_under(rng: np.random.Generator, task: Task, state: State, i: int, bottom: float) -> State:
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
    view = held_out(task.image, state, -1)
    box, _, _ = run_polish(rng, task.image, state, -1, box, UPRIGHT, False, view, bottom, task.settings, step=GUESSED)
    return state.add(box, UPRIGHT, False, FLOOR, bottom)


def stand(rng: np.random.Generator, task: Task, state: State, places: Places) -> Changed | None:
    """Put an upright box or cylinder, from the floor or a top below it up, in the place of a solid that floats."""
    floating = [i for i in range(len(state)) if np.isnan(state.bottoms[i]) and lowest(state.rows[i]) > 0.015]
    if not floating:
        return None
    i = floating[int(rng.integers(len(floating)))]
    row, top = state.rows[i], highest(state.rows[i])
    new = state.without(i)
    below = [0.0] + [highest(r) for r in new.rows if highest(r) < lowest(row)]
    bottom = below[int(rng.integers(len(below)))]
    kind = CYLINDER if "cylinder" in task.settings.shapes and rng.random() < 0.3 else BOX
    c, s = np.cos(angle := rng.uniform(0, np.pi / 2)), np.sin(angle)
    wide = 2.0 * reach(row, c, s, 0.0) * rng.uniform(0.6, 1.0)
    deep = wide if kind == CYLINDER else 2.0 * reach(row, -s, c, 0.0) * rng.uniform(0.4, 1.0)
    whole = make_row(kind, [[c, -s, 0], [s, c, 0], [0, 0, 1]], [row[10], row[11], 0.5 * (bottom + top)],
                     [wide, deep, top - bottom])  # fmt: skip
    view = held_out(task.image, new, -1)
    whole, _, _ = run_polish(rng, task.image, new, -1, whole, UPRIGHT, False, view, bottom, task.settings,
                             2 * MOVED, 0.005, 2.0 * task.settings.temper)  # fmt: skip
    return new.add(whole, UPRIGHT, False, FLOOR, bottom), {len(new)}


def lift(rng: np.random.Generator, task: Task, state: State, places: Places) -> Changed | None:
    """Let the bottom of a standing box or cylinder go up, and put a box under it where that leaves room."""
    standing = [
        i for i in range(len(state))
        if state.forms[i] == UPRIGHT and int(state.rows[i][0]) != SPHERE and not np.isnan(state.bottoms[i])
    ]  # fmt: skip
    if not standing or len(state) >= task.settings.max_objects:
        return None
    i = standing[pick(rng, places.blame[standing])]
    old = state.bottoms[i]
    new = state.copy()
    new.cubes[i], new.bottoms[i] = False, np.nan
    new.rows[i] = with_bottom(state.rows[i], old + rng.uniform(0.1, 0.7) * state.rows[i][15])
    polish_solid(rng, task.image, new, i, task.settings)
    if lowest(new.rows[i]) < old + LEAST_GAP:
        return None
    new = with_box_under(rng, task, new, i, old)
    return new, {i, len(new) - 1}


def raise_support(rng: np.random.Generator, task: Task, state: State, places: Places) -> Changed | None:
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
    polish_solid(rng, task.image, new, j, task.settings, bottom)
    return new, {i, j}


BESIDE = 0.01  # metres outside a box's other faces within which a point may belong to it


def stretch(rng: np.random.Generator, task: Task, state: State, places: Places) -> Changed | None:
    """Let a box reach to a badly explained point that lies beyond one of its faces: it may show behind another."""
    if len(places.points) == 0:
        return None
    point = places.points[rng.integers(len(places.points))]
    able = []
    for i in range(len(state)):
        if int(state.rows[i][0]) == BOX:
            local = (point - state.rows[i][10:13]) @ rotation_of(state.rows[i])
            beyond = np.abs(local) - 0.5 * state.rows[i][13:16]
            axis = int(np.argmax(beyond))
            if beyond[axis] > 0 and np.delete(beyond, axis).max() < BESIDE:
                able.append((i, axis, np.sign(local[axis]), beyond[axis]))
    if not able:
        return None
    i, axis, sign, beyond = able[int(rng.integers(len(able)))]
    row = state.rows[i].copy()
    row[13 + axis] += beyond
    row[10:13] += 0.5 * sign * beyond * rotation_of(row)[:, axis]
    return polished(rng, task, state, i, row, state.forms[i], False)


def polished(rng: np.random.Generator, task: Task, state: State, i: int, row: np.ndarray, form: int, cube: bool,
             step: float = 0.003, heat: float = 2.0) -> Changed:  # fmt: skip
    """Return (state with another solid i, polished on its own, {i})."""
    new = state.copy()
    new.rows[i], new.forms[i], new.cubes[i] = row, form, cube
    bottom = state.bottoms[i] if form == state.forms[i] else np.nan
    polish_solid(rng, task.image, new, i, task.settings, bottom, step=step, heat=heat)
    return new, {i}


def shake(rng: np.random.Generator, task: Task, state: State, places: Places) -> Changed | None:
    """Turn a solid to any angle about the vertical, make it a little larger or smaller, and polish it from hotter."""
    if len(state) == 0:
        return None
    i = pick(rng, places.blame[:-1])
    row = state.rows[i].copy()
    if int(row[0]) == BOX and state.forms[i] == UPRIGHT:
        turn(row, 2, rng.uniform(-np.pi / 4, np.pi / 4), row[10], row[11], row[12])
    row[13:16] *= np.exp(0.15 * rng.normal())
    return polished(rng, task, state, i, row, state.forms[i], state.cubes[i], 0.006, 6.0)


def tilt(rng: np.random.Generator, task: Task, state: State, places: Places) -> Changed | None:
    """Let an upright solid lean, or put one that leans upright."""
    able = [i for i in range(len(state)) if int(state.rows[i][0]) != SPHERE]
    if not able:
        return None
    i = able[pick(rng, places.blame[able])]
    row = state.rows[i].copy()
    if state.forms[i] == UPRIGHT:
        for axis in (0, 1):
            turn(row, axis, np.radians(5.0) * rng.normal(), row[10], row[11], row[12])
        return polished(rng, task, state, i, row, FREE, state.cubes[i])
    rotation = rotation_of(row)
    if abs(rotation[2, 2]) < np.cos(np.radians(15.0)):
        return None
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    row[1:10] = [np.cos(yaw), -np.sin(yaw), 0, np.sin(yaw), np.cos(yaw), 0, 0, 0, 1]
    return polished(rng, task, state, i, row, UPRIGHT, state.cubes[i])


def appear(rng: np.random.Generator, task: Task, state: State, places: Places) -> Changed | None:
    """Put a new solid where a body of pixels shows that nothing explains, on the floor or on what is below it."""
    if not places.bodies or len(state) >= task.settings.max_objects:
        return None
    body = places.bodies[pick(rng, [len(each) for each in places.bodies])]
    below = [0.0, *map(highest, state.rows)]
    below = [h for h in below if h < body[:, 2].max() - LOWER]
    return appear_on(rng, task, state, body, below[int(rng.integers(len(below)))]) if below else None


def appear_on(rng: np.random.Generator, task: Task, state: State, body: np.ndarray, bottom: float) -> Changed:
    """Return (new state, changed) with the solid that best explains points (K, 3) and stands on a height."""
    image, settings, _ = task
    view, tries = held_out(image, state, -1), []
    for each in body_hypotheses(body, image.origin, settings.shapes, bottom):
        held = bottom if each.form == UPRIGHT else np.nan
        row, energy, _ = run_polish(
            rng, image, state, -1, each.row, each.form, False, view, held, settings, step=GUESSED
        )
        tries.append((energy + complexity(int(row[0]), each.form, False, settings), len(tries), row, each.form, held))
    _, _, row, form, held = min(tries)
    return state.add(row, form, False, FLOOR, held), {len(state)}
