"""What each solid stands on: candidates from geometry, choice by the image and by who bears the weight.

The weight is borne by forces at the points where a solid touches, in equilibrium with gravity. Each contact point may
push along its normal and, by friction, across it, up to RESTING times as much: a pyramid of four forces. Of all forces
that hold the solid, the shortest vector is taken (non-negative least squares with a small ridge), as a stiff but
slightly soft contact would share the load.
"""

from typing import TYPE_CHECKING

import numpy as np

from derender.detection.solids.image import Image, prepared_row, rotation_of
from derender.detection.solids.interpenetration import highest, lowest, penetration
from derender.detection.solids.misfit import added_misfit
from derender.detection.solids.polish import UPRIGHT, contact_energy, size_energy
from derender.detection.solids.state import FLOOR, NOTHING, State, held_out, in_the_way
from derender.scene.contact_points import all_contacts
from derender.scene.friction import RESTING
from derender.scene.solids import BOX, CYLINDER, PLANE

if TYPE_CHECKING:
    from derender.detection.search.greedy import Settings

RIDGE = 1e-2
EVEN = 1e-10  # of the weight: forces and slopes up to it are rounding
UNBALANCED = 0.2  # of the weight that no force holds: then the contacts that were seen do not explain why it rests


def contacts_of(rows: np.ndarray, k: int, reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return of each point where solid k touches others: by what (an index or FLOOR), (P, 3) where, and (P, 3) along
    which unit vector it is pushed there."""
    count = len(rows) + 1
    pose, size, none = np.tile(np.eye(4), (count, 1, 1)), np.zeros((count, 3)), np.empty((0, 3))
    pose[1:, :3, :3], pose[1:, :3, 3], size[1:] = rows[:, 1:10].reshape(-1, 3, 3), rows[:, 10:13], rows[:, 13:16]
    kind, starts = np.array([PLANE, *rows[:, 0]], np.int64), np.zeros(count + 1, np.int64)
    numbers, joined = np.arange(count), np.zeros((count, count), bool)
    first, second, points, normals, _ = all_contacts(
        kind, pose, size, none, starts, none, starts, numbers, numbers != k + 1, joined, reach, reach,
        np.array([reach, reach]), reach,
    )  # fmt: skip
    own = first == k + 1
    return np.where(own, second, first) - 1, points, np.where(own[:, None], normals, -normals)


def shares_of_load(
    rows: list[np.ndarray] | np.ndarray, k: int, reach: float, friction: np.ndarray | None = None
) -> dict[int, float]:
    """Return who bears how much of solid k's weight: {index or FLOOR: share}; empty where its contacts cannot hold it.

    rows : (N, ROW) of all solids. reach : metres between surfaces that count as touching.
    friction : (N + 1,) coefficients of its contacts with each of the others, that with the floor last; None: RESTING.
    """
    rows, friction = np.array(rows), np.full(len(rows) + 1, RESTING) if friction is None else friction
    carriers, points, normals = contacts_of(rows, k, reach)
    below = normals[:, 2] > -0.5  # what is above stands on the solid
    carriers, points, normals = carriers[below], points[below], normals[below]
    if len(carriers) == 0:
        return {}
    axis = np.where(np.abs(normals[:, :1]) < 0.7, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    across = np.cross(normals, axis)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    sides = np.stack([across, -across, (other_way := np.cross(normals, across)), -other_way], axis=1)
    force = normals[:, None] + friction[carriers][:, None, None] * sides
    turning = np.cross((points - rows[k, 10:13])[:, None], force) / rows[k, 13:16].max()
    matrix = np.concatenate([force, turning], axis=2).reshape(-1, 6).T
    carriers = np.repeat(carriers, sides.shape[1])
    weight = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    forces = least_forces(matrix, weight, RIDGE)
    # the ridge alone lets a share of the weight go
    held = matrix @ forces
    if np.linalg.norm(held / max(held[2], 1e-9) - weight) > UNBALANCED:
        return {}
    borne = forces * matrix[2] / held[2]
    return {int(carrier): float(borne[carriers == carrier].sum()) for carrier in np.unique(carriers)}


NEAR = 0.006
TOUCHING = 0.003  # metres between surfaces of polished solids that bear a load: twice the slack of contacts
LEAST_GAP = 0.012  # metres under a solid in which another may stand
LEVEL = 0.997  # cosine of the tilt at which a face no longer counts as level
BESIDE = 2  # pixels between the rectangles of solids that may hide parts of each other


WITHIN = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 7)] * 3), axis=-1).reshape(-1, 3)  # places, by a solid's extents
OVERLAP = 0.002  # metres by which flush neighbours may seem to overlap from above


def shadows_overlap(row: np.ndarray, other: np.ndarray) -> bool:
    """Whether two solids overlap when seen from above, by more than OVERLAP."""
    lifted = row.copy()
    lifted[12] = other[12]
    return penetration(lifted, other) > OVERLAP


def share_over(points: np.ndarray, row: np.ndarray) -> float:
    """Return the share of points (K, 3) that lie over or under an upright solid."""
    local = np.abs((points - row[10:13]) @ rotation_of(row))[:, :2]
    return float((local <= 0.5 * row[13:15]).all(axis=1).mean())


def flat_top(row: np.ndarray) -> bool:
    """Whether the solid ends in a level face on which others can stand."""
    kind = int(row[0])
    if kind == BOX:
        return max(abs(row[7]), abs(row[8]), abs(row[9])) >= LEVEL
    return kind == CYLINDER and abs(row[9]) >= LEVEL


def with_bottom(row: np.ndarray, height: float, top: float | None = None) -> np.ndarray:
    """Return the upright solid with its bottom moved to a height, and its top to another; None: held still."""
    new = row.copy()
    top = row[12] + 0.5 * row[15] if top is None else top
    new[15] = max(top - height, 0.004)
    new[12] = top - 0.5 * new[15]
    return new


def touches(row: np.ndarray, other: np.ndarray, reach: float = NEAR) -> bool:
    """Whether `row` stands on or leans against `other`: lowered by `reach` it would sink into it."""
    lowered = row.copy()
    lowered[12] -= reach
    return penetration(lowered, other) > 0.5 * reach * 0.2


def concerned(image: Image, state: State, changed: set[int]) -> set[int]:
    """Return the solids to which it may matter that some have changed: those, what stands on them or on what is gone,
    and what shows beside them."""
    rectangles = np.array([prepared_row(image, row)[1] for row in state.rows])
    rectangles = rectangles.reshape(len(state), 4) + [-BESIDE, BESIDE, -BESIDE, BESIDE]
    found = set(changed)
    for i, (left, right, top, bottom) in enumerate(rectangles):
        parent = state.parents[i]
        height = 0.0 if parent == FLOOR else highest(state.rows[parent])
        others = rectangles[list(changed)]
        beside = (others[:, 0] < right) & (left < others[:, 1]) & (others[:, 2] < bottom) & (top < others[:, 3])
        if parent in changed or abs(height - state.bottoms[i]) > 1e-6 or beside.any():
            found.add(i)
    return found


def assign_supports(image: Image, state: State, settings: "Settings", only: set[int] | None = None) -> State:
    """Choose each solid's support (or that of those in `only`), and for upright boxes and cylinders move the bottom
    onto it. Returns a new state.

    Its bottom where it is, over nothing, competes with the supports: what carries it may be hidden, or it may float.
    """
    state = state.copy()
    others = in_the_way(state.rows, settings)
    order = np.argsort([lowest(r) for r in state.rows])
    for i in order:
        if only is not None and i not in only:
            continue
        row = state.rows[i]
        if state.forms[i] == UPRIGHT and int(row[0]) in (BOX, CYLINDER) and not state.cubes[i]:
            depth, _, misfit, _ = held_out(image, state, i)
            best, choice, best_row, bottom = np.inf, FLOOR, row, np.nan
            if lowest(row) > (NEAR if settings.may_float else LEAST_GAP):
                best = (
                    added_misfit(image, row, depth, misfit) + settings.temper * size_energy(row, False)
                    + contact_energy(row, others, i, np.nan, NOTHING, settings.slack) + settings.price_of_floating
                )  # fmt: skip
            for j in [FLOOR, *[k for k in range(len(state)) if k != i]]:
                height = 0.0
                if j != FLOOR:
                    if not flat_top(state.rows[j]) or not shadows_overlap(row, state.rows[j]):
                        continue
                    height = highest(state.rows[j])
                    if height > row[12] + 0.5 * row[15] - 0.008:
                        continue
                trial = with_bottom(row, height)
                value = (
                    added_misfit(image, trial, depth, misfit) + settings.temper * size_energy(trial, False)
                    + contact_energy(trial, others, i, height, NOTHING, settings.slack) - 0.5 * (j != FLOOR)
                )  # fmt: skip
                if value < best:
                    best, choice, best_row, bottom = value, j, trial, height
            state.rows[i], state.parents[i], state.bottoms[i] = best_row, choice, bottom
        else:
            state.parents[i], state.bottoms[i] = standing_on(state, i)
    return state


def standing_on(state: State, i: int, reach: float = 0.012) -> tuple[int, float]:
    """Return (parent, height) of what a solid that is not upright stands on; height NaN where it only leans."""
    row = state.rows[i]
    low, within = lowest(row), row[10:13] + WITHIN * row[13:16] @ rotation_of(row).T
    candidates = [(abs(low), FLOOR, 0.0, 1.0)]
    for j in range(len(state)):
        if j != i and flat_top(state.rows[j]) and shadows_overlap(row, state.rows[j]):
            height = highest(state.rows[j])
            candidates.append((abs(low - height), j, height, share_over(within, state.rows[j])))
    gap = min(candidates)[0]
    if gap < reach:  # of tops that are as high, as those of cartons in a grid, the one below most of it
        near = [each for each in candidates if each[0] < gap + TOUCHING]
        _, parent, height, _ = max(near, key=lambda each: each[3])
        return parent, height
    leaning = [
        (-penetration(row, other), j) for j, other in enumerate(state.rows) if j != i and touches(row, other, reach)
    ]
    return (min(leaning)[1] if leaning else FLOOR), np.nan


def least_forces(matrix: np.ndarray, load: np.ndarray, ridge: float) -> np.ndarray:
    """Return the x >= 0 (K,) with the least |matrix x - load|^2 + ridge |x|^2.

    By its dual, which has as many unknowns as the load (M,), not as many as there are forces: what of the load is left,
    u = load - matrix x, is where |u|^2 / 2 + |max(u matrix, 0)|^2 / (2 ridge) - load u is least, and x =
    max(u matrix, 0) / ridge. Newton's steps, halved where they go too far, end there once they know which forces push.
    """

    def height(left: np.ndarray) -> float:
        push = np.maximum(left @ matrix, 0.0)
        return float(0.5 * left @ left + 0.5 * push @ push / ridge - load @ left)

    left, last = np.zeros(len(load)), np.inf
    while True:
        forces = np.maximum(left @ matrix, 0.0) / ridge
        slope = left + matrix @ forces - load
        if np.abs(slope).max() <= EVEN or not height(left) < last:  # the second: nothing but rounding is left
            return forces
        last, pushing = height(left), matrix[:, forces > 0.0]
        step = np.linalg.solve(np.eye(len(load)) + pushing @ pushing.T / ridge, slope)
        while height(left - step) > last and np.abs(step).max() > EVEN:
            step = 0.5 * step
        left = left - step


def bearers(rows: list[np.ndarray] | np.ndarray, i: int) -> list[int]:
    """Return what may bear solid i: FLOOR and the indices of lower solids, as far as it touches them."""
    lower = (j for j in range(len(rows)) if j != i and rows[j][12] < rows[i][12])
    floor = [FLOOR] if lowest(rows[i]) < NEAR else []
    return floor + [j for j in lower if touches(rows[i], rows[j])]


def final_parents(state: State) -> list[int]:
    """Return the parent of each solid by contact: of several supports, the one that bears the most of its weight."""
    parents = []
    for i in range(len(state)):
        row, found = state.rows[i], bearers(state.rows, i)
        shares = shares_of_load(state.rows, i, TOUCHING) if len(found) > 1 else {}
        if shares:
            parents.append(max(shares, key=lambda j: shares[j]))
        elif FLOOR in found or not found:
            parents.append(FLOOR if found or state.parents[i] in (FLOOR, i) else state.parents[i])
        elif state.parents[i] in found:
            parents.append(state.parents[i])
        else:
            parents.append(min(found, key=lambda j: np.hypot(*(state.rows[j][10:12] - row[10:12]))))
    return parents
