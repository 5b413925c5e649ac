"""Refine one solid against the image by an annealed random walk, the other solids held still: compiled.

The walk's steps are those in which a depth image is informative: moving one face while the opposite one stays,
shifting along the solid's own axes, turning about its centre or a corner, scaling about a corner.  Each kind of step
keeps its own scale, widened on success and narrowed on failure.  A point-sampled silhouette has no derivative, so
steps are tried, not computed; one try costs the pixels of the solid's rectangle (10 to 30 microseconds).
"""

import numpy as np

from derender.compilation.cache import njit
from derender.detection.solids.interpenetration import highest, lowest, penetration_beyond
from derender.detection.solids.misfit import added_misfit_by, new_canvas
from derender.scene.solids import BOX, CYLINDER, SPHERE

TYPICAL_SIZE, SIZE_SPREAD = 0.09, 0.6
SLACK = 0.0015
UPRIGHT, FREE = 0, 1
# Rounds in which a solid is polished, each a step of one of 14 kinds: with others of a proposed structure, which most
# often is dropped (TRIED), from where a move has put it, millimetres off (MOVED), and in the structure found (SETTLED).
TRIED, MOVED, SETTLED = 150, 250, 300
# Metres of the first steps: from a guess at what is hidden, from elsewhere, after a first polish, of what is settled.
GUESSED, STEP, FINE, FINEST = 0.006, 0.003, 0.002, 0.001
# Kinds of steps, see try_step: of a search, and of a walk, which must also let a cube's side change under a top that
# the image holds still.
MOVES = 14


@njit(cache=True, nogil=True, borrows=True)
def size_energy(row, cube):
    """Return minus the log prior density of the sizes, log-normal in each free extent, up to a constant."""
    kind = int(row[0])
    numbers = 1 if (cube or kind == SPHERE) else 3 if kind == BOX else 2
    total = 0.0
    for k in range(numbers):
        s = row[13 + k] if not (kind == CYLINDER and k == 1) else row[15]
        total += 0.5 * (np.log(max(s, 1e-6) / TYPICAL_SIZE) / SIZE_SPREAD) ** 2
    return total


@njit(cache=True, nogil=True, borrows=True)
def contact_energy(row, others, skip, bottom, carried, slack):
    """Return the energy of standing off its support, of sinking into the floor or others, of those it carries.

    bottom : height of what it stands on, NaN for none.
    carried : (K,) heights of the lowest points of what stands on it.
    """
    total = resting_energy(row, lowest(row), others, skip, bottom, slack)
    for k in range(carried.shape[0]):
        total += 0.5 * min(((highest(row) - carried[k]) / slack) ** 2, 100.0)
    return total


@njit(cache=True, nogil=True, borrows=True)
def resting_energy(row, low, others, skip, bottom, slack):
    """Return the energy of a solid whose lowest point is at height `low`: off its support, or inside what is there."""
    total = 0.0
    if not np.isnan(bottom):
        total += 0.5 * ((low - bottom) / slack) ** 2
    if low < -slack:
        total += 0.5 * ((low + slack) / slack) ** 2
    for k in range(others.shape[0]):
        if k != skip:
            depth = penetration_beyond(row, others[k], slack)
            if depth > slack:
                total += 0.5 * ((depth - slack) / slack) ** 2
    return total


@njit(cache=True, nogil=True, borrows=True)
def tilt_energy(row, form, tilt):
    """Return minus the log prior density of an upright solid's tilt off the vertical (normal, scale `tilt`)."""
    if form == FREE or int(row[0]) == SPHERE or tilt <= 0.0:
        return 0.0
    return max(1.0 - abs(row[9]), 0.0) / tilt**2


@njit(cache=True, nogil=True, borrows=True)
def turn(row, axis, angle, px, py, pz):
    """Turn the solid about its own axis (0, 1, 2) through the point (px, py, pz), in place."""
    ux, uy, uz = row[1 + axis], row[4 + axis], row[7 + axis]
    c, s = np.cos(angle), np.sin(angle)
    for column in range(4):
        if column < 3:
            x, y, z = row[1 + column], row[4 + column], row[7 + column]
        else:
            x, y, z = row[10] - px, row[11] - py, row[12] - pz
        dot = ux * x + uy * y + uz * z
        nx = x * c + (uy * z - uz * y) * s + ux * dot * (1 - c)
        ny = y * c + (uz * x - ux * z) * s + uy * dot * (1 - c)
        nz = z * c + (ux * y - uy * x) * s + uz * dot * (1 - c)
        if column < 3:
            row[1 + column], row[4 + column], row[7 + column] = nx, ny, nz
        else:
            row[10], row[11], row[12] = nx + px, ny + py, nz + pz


@njit(cache=True, nogil=True, borrows=True)
def shift(row, axis, distance):
    """Shift the solid along its own axis, in place."""
    row[10] += distance * row[1 + axis]
    row[11] += distance * row[4 + axis]
    row[12] += distance * row[7 + axis]


@njit(cache=True, nogil=True, borrows=True)
def try_step(rng, row, origin, form, cube, tilt, move, step):
    """Change the row by the step of kind `move` (see module), in place; return False where it is not allowed.

    Moves: 0-5 faces, 6-8 shifts, 9-11 turns about own axes, 12 scale about a corner (an upright cube's at the bottom),
    13 radius.
    """
    kind = int(row[0])
    if move < 6:
        axis, sign = move // 2, 1.0 if move % 2 == 0 else -1.0
        if kind == SPHERE or (kind == BOX and cube) or (kind == CYLINDER and axis < 2):
            return False
        row[13 + axis] += step
        shift(row, axis, 0.5 * sign * step)
        return row[13 + axis] > 0.004
    if move < 9:
        shift(row, move - 6, step)
        return True
    if move < 12:
        axis = move - 9
        if kind == SPHERE or (form == UPRIGHT and axis != 2 and tilt <= 0.0) or (kind == CYLINDER and axis == 2):
            return False
        # corner pivots: a visible corner or edge stays where it is
        px, py, pz = row[10], row[11], row[12]
        if rng.random() < 0.7:
            for k in range(3):
                w = 0.5 * row[13 + k] * (1.0 if rng.random() < 0.5 else -1.0)
                px += w * row[1 + k]
                py += w * row[4 + k]
                pz += w * row[7 + k]
        turn(row, axis, step * 8.0, px, py, pz)
        return True
    if move == 12:
        if kind != BOX or not cube:
            return False
        for k in range(3):
            w = 0.5 * step * (1.0 if rng.random() < 0.5 else -1.0)
            if form == UPRIGHT and k == 2 and row[9] > 0:
                w = abs(w) if step > 0 else -abs(w)
            shift(row, k, w)
            row[13 + k] += step
        return row[13] > 0.004
    if kind == BOX:
        return False
    # radius: about the centre, or with the side towards the camera held still, and with the bottom held still
    ex, ey, ez = row[10] - origin[0], row[11] - origin[1], row[12] - origin[2]
    if kind == CYLINDER:
        along = ex * row[3] + ey * row[6] + ez * row[9]
        ex, ey, ez = ex - along * row[3], ey - along * row[6], ez - along * row[9]
    elif rng.random() < 0.5:
        ex, ey, ez = 0.0, 0.0, 1.0
    length = np.sqrt(ex * ex + ey * ey + ez * ez) + 1e-12
    held = 0.5 * step if rng.random() < 0.7 else 0.0
    row[10] += held * ex / length
    row[11] += held * ey / length
    row[12] += held * ez / length
    row[13] += step
    row[14] += step
    if kind == SPHERE:
        row[15] += step
    return row[13] > 0.004


@njit(cache=True, nogil=True, borrows=True)
def propose(rng, row, trial, origin, form, cube, tilt, scale):
    """Write a solid one random step from `row` into `trial`; return (the kind of step, whether it is possible).

    scale : (M,) metres, of as many kinds of steps.
    """
    move = int(scale.size * rng.random())
    step = scale[move] * rng.standard_normal()
    for n in range(row.size):
        trial[n] = row[n]
    return move, try_step(rng, trial, origin, form, cube, tilt, move, step)


@njit(cache=True, nogil=True)
def polish(rng, image, start, form, cube, others, skip, depth, misfit, bottom, carried, slack, tilt, temper, rounds,
           first_step, heat):  # fmt: skip
    """Return (row, energy, misfit change) of the best solid found in `rounds` tries.

    start : (ROW,) the solid; form : UPRIGHT or FREE; cube : keep its edges equal.
    others : (N, ROW) solids in the scene, `skip` the one among them that is this one (or -1).
    depth, misfit : (H, W) of the scene without this solid.
    bottom : height of what it stands on, NaN for unknown.
    carried : (K,) lowest heights of what stands on it.
    slack : metres; tilt : radians off the vertical that an upright solid may have (0: none).
    temper : how many pixels tell as much as one independent one: what the sizes' prior is multiplied by.
    first_step : metres of the first steps; heat : temperature at the start, falling to zero (0: only downhill).
    """
    row, trial, scale, best = start.copy(), start.copy(), np.full(MOVES, first_step), start.copy()
    energy, change = walk(rng, image, row, trial, scale, best, new_canvas(image), form, cube, others, skip, depth,
                          misfit, bottom, carried, slack, tilt, temper, rounds, heat)  # fmt: skip
    return best, energy, change


@njit(cache=True, nogil=True, borrows=True)
def walk(rng, image, row, trial, scale, best, canvas, form, cube, others, skip, depth, misfit, bottom, carried, slack,
         tilt, temper, rounds, heat):  # fmt: skip
    """Write the best solid that `polish` finds from a row into `best`; return its energy and misfit change.

    row, trial : (ROW,), changed. scale : (MOVES,) metres of the first steps, changed. canvas : see `new_canvas`.
    """
    change = added_misfit_by(image, row, depth, misfit, canvas)
    energy = change + temper * size_energy(row, cube) + contact_energy(row, others, skip, bottom, carried, slack)
    energy += temper * tilt_energy(row, form, tilt)
    best_energy, best_change = energy, change
    for k in range(rounds):
        move, possible = propose(rng, row, trial, image.origin, form, cube, tilt, scale)
        if not possible:
            continue
        rest = temper * size_energy(trial, cube) + contact_energy(trial, others, skip, bottom, carried, slack)
        rest += temper * tilt_energy(trial, form, tilt)
        if rest - (energy - change) > 100.0:
            scale[move] = max(scale[move] * 0.93, 5e-5)
            continue
        new_change = added_misfit_by(image, trial, depth, misfit, canvas)
        new = new_change + rest
        temperature = heat * (1.0 - k / rounds)
        if new < energy or (temperature > 0 and rng.random() < np.exp((energy - new) / temperature)):
            for n in range(row.size):
                row[n] = trial[n]
            energy, change = new, new_change
            scale[move] = min(scale[move] * 1.25, 0.02)
            if energy < best_energy:
                for n in range(row.size):
                    best[n] = row[n]
                best_energy, best_change = energy, change
        else:
            scale[move] = max(scale[move] * 0.93, 5e-5)
    return best_energy, best_change
