"""Moves that change one solid where it is, or add one: stretched to what it leaves out, shaken, tilted, new.

Called as moves.py says.
"""

import numpy as np

from derender.detection.search.bodies import body_hypotheses
from derender.detection.search.greedy import complexity
from derender.detection.search.places import pick
from derender.detection.solids.image import rotation_of
from derender.detection.solids.interpenetration import highest
from derender.detection.solids.polish import FREE, UPRIGHT, turn
from derender.detection.solids.state import FLOOR, held_out, run_polish
from derender.scene.solids import BOX, SPHERE

BESIDE = 0.01  # metres outside a box's other faces within which a point may belong to it


def stretch(rng, image, state, hypotheses, settings, places):
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
    return polished(rng, image, state, i, row, state.forms[i], False, settings)


def polished(rng, image, state, i, row, form, cube, settings, step=0.003, heat=2.0):
    """Return (state with another solid i, polished on its own, {i})."""
    new = state.copy()
    new.rows[i], new.forms[i], new.cubes[i] = row, form, cube
    bottom = state.bottoms[i] if form == state.forms[i] else np.nan
    view = held_out(image, new, i)
    new.rows[i], _, _ = run_polish(rng, image, new, i, row, form, cube, view, bottom, settings, 300, step, heat)
    return new, {i}


def shake(rng, image, state, hypotheses, settings, places):
    """Turn a solid to any angle about the vertical, make it a little larger or smaller, and polish it from hotter."""
    if len(state) == 0:
        return None
    i = pick(rng, places.blame[:-1])
    row = state.rows[i].copy()
    if int(row[0]) == BOX and state.forms[i] == UPRIGHT:
        turn(row, 2, rng.uniform(-np.pi / 4, np.pi / 4), row[10], row[11], row[12])
    row[13:16] *= np.exp(0.15 * rng.normal())
    return polished(rng, image, state, i, row, state.forms[i], state.cubes[i], settings, 0.006, 6.0)


def tilt(rng, image, state, hypotheses, settings, places):
    """Let an upright solid lean, or put one that leans upright."""
    able = [i for i in range(len(state)) if int(state.rows[i][0]) != SPHERE]
    if not able:
        return None
    i = able[pick(rng, places.blame[able])]
    row = state.rows[i].copy()
    if state.forms[i] == UPRIGHT:
        for axis in (0, 1):
            turn(row, axis, np.radians(5.0) * rng.normal(), row[10], row[11], row[12])
        return polished(rng, image, state, i, row, FREE, state.cubes[i], settings)
    rotation = rotation_of(row)
    if abs(rotation[2, 2]) < np.cos(np.radians(15.0)):
        return None
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    row[1:10] = [np.cos(yaw), -np.sin(yaw), 0, np.sin(yaw), np.cos(yaw), 0, 0, 0, 1]
    return polished(rng, image, state, i, row, UPRIGHT, state.cubes[i], settings)


def appear(rng, image, state, hypotheses, settings, places):
    """Put a new solid where a body of pixels shows that nothing explains, on the floor or on what is below it."""
    if not places.bodies or len(state) >= settings.max_objects:
        return None
    body = places.bodies[pick(rng, [len(each) for each in places.bodies])]
    tops = [0.0] + [highest(r) for r in state.rows]
    below = [h for h in tops if h < body[:, 2].max() - 0.004]
    if not below:
        return None
    bottom = below[int(rng.integers(len(below)))]
    view = held_out(image, state, -1)
    best = None
    for each in body_hypotheses(body, image.origin, settings.shapes, bottom):
        held = bottom if each.form == UPRIGHT else np.nan
        row, energy, _ = run_polish(rng, image, state, -1, each.row, each.form, False, view, held, settings, 200, 0.006)
        energy += complexity(int(row[0]), each.form, False, settings)
        if best is None or energy < best[0]:
            best = energy, row, each.form, held
    _, row, form, held = best
    return state.add(row, form, False, FLOOR, held), {len(state)}
