"""What each solid stands on: candidates from geometry, choice by the image and by who bears the weight.

The weight is borne by forces at the points where a solid touches, in equilibrium with gravity. Each contact point may
push along its normal and, by friction, across it, up to RESTING times as much: a pyramid of four forces. Of all forces
that hold the solid, the shortest vector is taken (non-negative least squares with a small ridge), as a stiff but
slightly soft contact would share the load.
"""

from typing import TYPE_CHECKING

import numpy as np

from derender.detection.solids.image import Image, prepared_row, rotation_of
from derender.detection.solids.interpenetration import clamp_direction, highest, lowest, overlap_along, penetration
from derender.detection.solids.misfit import added_misfit
from derender.detection.solids.polish import UPRIGHT, contact_energy, size_energy
from derender.detection.solids.state import FLOOR, NOTHING, State, held_out, in_the_way
from derender.scene.friction import RESTING
from derender.scene.separation import surface_distance
from derender.scene.solids import BOX, CYLINDER, SPHERE

if TYPE_CHECKING:
    from derender.detection.search.greedy import Settings

MOST_POINTS = 24  # of each pair
ALONG, AROUND = 17, 48  # points along an edge of a box and around a rim of a cylinder
RIDGE = 1e-2
EVEN = 1e-10  # of the weight: forces and slopes up to it are rounding
UNBALANCED = 0.2  # of the weight that no force holds: then the contacts that were seen do not explain why it rests


def edge_points(row: np.ndarray) -> np.ndarray:
    """Return (K, 3) points on the edges of a solid: where it can touch another one there is one of either's near."""
    if int(row[0]) == SPHERE:
        return np.empty((0, 3))
    half, steps = 0.5 * row[13:16], np.linspace(-1.0, 1.0, ALONG)
    if int(row[0]) == CYLINDER:
        angle = np.linspace(0.0, 2.0 * np.pi, AROUND, endpoint=False)
        rim = np.column_stack([half[0] * np.cos(angle), half[0] * np.sin(angle)])
        heights = np.concatenate([[1.0, -1.0], steps[1:-1:2]]) * half[2]
        local = np.array([[*place, height] for height in heights for place in rim])
    else:
        signs = np.array([[a, b] for a in (-1.0, 1.0) for b in (-1.0, 1.0)])
        local = np.concatenate([
            np.insert(np.repeat(signs, ALONG, axis=0), axis, np.tile(steps, 4), axis=1) * half for axis in range(3)
        ])  # fmt: skip
    return row[10:13] + local @ rotation_of(row).T


def push_on(row: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the unit vector (3,) along which a solid that touches another is pushed by it: their shadows on it
    overlap least (the separating axis)."""
    first, second, between = rotation_of(row).T, rotation_of(other).T, row[10:13] - other[10:13]
    axes = [*first, *second, *(np.cross(a, b) for a in first for b in second), between]
    for solid, centre in ((row, other[10:13]), (other, row[10:13])):
        beyond = np.array(clamp_direction(solid, *centre))
        axes += [beyond, beyond - (beyond @ first[2]) * first[2], beyond - (beyond @ second[2]) * second[2]]
    axes = [axis / np.linalg.norm(axis) for axis in axes if np.linalg.norm(axis) > 1e-6]
    best = min(axes, key=lambda axis: overlap_along(row, other, *axis))
    return best if best @ between > 0 else -best


def touching_points(row: np.ndarray, other: np.ndarray | None, reach: float) -> np.ndarray:
    """Return the points (K, 3) where a solid touches another (None: the floor)."""
    if other is None:
        own = edge_points(row) if int(row[0]) != SPHERE else row[None, 10:13] - [0.0, 0.0, 0.5 * row[13]]
        points = own[own[:, 2] < reach]
    elif penetration(row, other) < -reach:
        return np.empty((0, 3))
    elif SPHERE in (int(row[0]), int(other[0])):
        ball = row if int(row[0]) == SPHERE else other
        towards = push_on(row, other) * (-0.5 if ball is row else 0.5) * ball[13]
        points = ball[None, 10:13] + towards
    else:
        found = []
        for first, second in ((row, other), (other, row)):
            edges = edge_points(first)
            away = surface_distance(int(second[0]), second[13:16], (edges - second[10:13]) @ rotation_of(second))
            found.append(edges[np.abs(away) < reach])
        points = np.concatenate(found)
    if len(points) > MOST_POINTS:
        points = points[np.linspace(0, len(points) - 1, MOST_POINTS).round().astype(int)]
    return points


def shares_of_load(
    rows: list[np.ndarray] | np.ndarray, k: int, reach: float, friction: np.ndarray | None = None
) -> dict[int, float]:
    """Return who bears how much of solid k's weight: {index or FLOOR: share}; empty where its contacts cannot hold it.

    rows : (N, ROW) of all solids. reach : metres between surfaces that count as touching.
    friction : (N + 1,) coefficients of its contacts with each of the others, that with the floor last; None: RESTING.
    """
    row = rows[k]
    friction = np.full(len(rows) + 1, RESTING) if friction is None else friction
    columns, carriers = [], []
    for other in (FLOOR, *(j for j in range(len(rows)) if j != k)):
        points = touching_points(row, None if other == FLOOR else rows[other], reach)
        if len(points) == 0:
            continue
        normal = np.array([0.0, 0.0, 1.0]) if other == FLOOR else push_on(row, rows[other])
        if normal[2] < -0.5:  # it is what stands on the solid
            continue
        across = np.cross(normal, [1.0, 0.0, 0.0] if abs(normal[0]) < 0.7 else [0.0, 1.0, 0.0])
        across /= np.linalg.norm(across)
        other_way = np.cross(normal, across)
        pyramid = normal + friction[other] * np.array([across, -across, other_way, -other_way])
        force = np.tile(pyramid, (len(points), 1))
        turning = np.cross(np.repeat(points - row[10:13], len(pyramid), axis=0), force) / row[13:16].max()
        columns.append(np.hstack([force, turning]))
        carriers += [other] * len(force)
    if not columns:
        return {}
    matrix, weight = np.concatenate(columns).T, np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    forces = least_forces(matrix, weight, RIDGE)
    # the ridge alone lets a share of the weight go
    held = matrix @ forces
    if np.linalg.norm(held / max(held[2], 1e-9) - weight) > UNBALANCED:
        return {}
    shares: dict[int, float] = {}
    for carrier, force, lift in zip(carriers, forces, matrix[2], strict=True):
        shares[carrier] = shares.get(carrier, 0.0) + float(force * lift / held[2])
    return shares


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
