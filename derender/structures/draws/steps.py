"""Steps that a walk through a structure's coordinates may take: which move together, in which direction, how far.

One column for the steps in which a depth image is informative (`directions`), and for those that move a side which the
camera is behind; Cholesky factors of a covariance for one solid, a support with all that it carries, and the floor,
each given the coordinates that stay. What moves one top of a stack leaves those above where they are (`tops_of`).
"""

import math
from typing import Any, NamedTuple

import numpy as np

from derender.compilation.cache import njit
from derender.scene.solids import SPHERE
from derender.structures.draws.chart import FLOOR_WAYS, HELD, KIND, PARENT, SIZE, TURN, VERTICAL, Chart, X, Z
from derender.structures.draws.sensor import Sensor

PIVOTS = np.array([(0, 0, 0), (1, 1, 0), (1, -1, 0), (-1, 1, 0), (-1, -1, 0)])  # half sides from the centre
# Where a centre goes as up to three sides grow by one, each held at one end or the other: (2^n, n) for n sides.
HELD_CORNERS = [np.array(list(np.ndindex(*[2] * count))) - 0.5 for count in range(4)]


def directions(chart: Chart, count: int, solids: list[int] | None = None) -> np.ndarray:
    """Return (M, D) steps in which a depth image is informative, of some solids or all, of `count` coordinates, in
    metres.

    Each face moved while the opposite one stays, shifts, turns about the centre and about the four corners of the
    ground plan, edges of a cube scaled about a corner.
    """
    found = []
    for k in range(len(chart.flags)) if solids is None else solids:
        slot, base = chart.slots[k], chart.base[k]
        rotation, free = base[1:10].reshape(3, 3), slot[:3] >= 0
        along = np.stack([np.eye(3), rotation.T], axis=1).reshape(6, 3)[np.stack([free, [True] * 3], axis=1).ravel()]
        ways = [(along, 0, 0.0)]  # shifts (n, 3) of the centre, and by how much which coordinate changes besides
        for index in sorted({int(s) for s in slot[SIZE:]}):
            axes = np.flatnonzero(slot[SIZE:] == index)
            ways.append((HELD_CORNERS[len(axes)] @ rotation[:, axes].T, index, 1.0))
        radius = 0.5 * math.sqrt(base[13:16] @ base[13:16])
        for axis in np.flatnonzero(slot[TURN:SIZE] >= 0):
            x, y, z = (0.0, 0.0, 1.0) if chart.flags[k, VERTICAL] else rotation[:, axis]
            corners = (0.5 * base[13:16] * PIVOTS) @ rotation.T
            about = corners @ [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
            ways.append((about / radius, slot[TURN + axis], 1.0 / radius))
        for shifts, index, change in ways:
            moves = np.zeros((len(shifts), count))
            moves[:, slot[:3][free]] = shifts[:, free]
            moves[:, index] += change
            found.append(moves)
    floor = np.zeros((FLOOR_WAYS, count))
    floor[:, -FLOOR_WAYS:] = 0.1 * np.eye(FLOOR_WAYS)
    moves = np.concatenate([*found, floor])
    return moves[np.abs(moves).max(axis=1) > 1e-9]


FIRST, FACTOR, RANK, PULL = range(4)  # rows of Proposals.table
ROUNDING = 1e-9  # share of a step's longest part that is none
LATTICE = 1e-3  # metres of the first steps
WIDER = 1.2  # times as wide as the covariance is the normal that steps are made from: few draws make one too narrow
LOOSE, LOOSE_TURN = 5e-3, 0.1  # metres and radians of standard deviation of what the image does not hold
FLOOR_SHARE = 0.2  # of another step's weight: moving the floor draws the whole image
UNSEEN = 3e-3  # metres of the first steps of a side that the camera does not face
UNSEEN_WEIGHT, UNSEEN_SHARE = 0.15, 0.75  # weight of each such side, and of all of them at most


class Proposals(NamedTuple):
    """Steps to choose from. M of them. table : (4, M + 1) int64: begin of its coordinates, begin of its matrix, number
    of columns, begin of its pull or -1."""

    table: np.ndarray
    members: np.ndarray  # flat int64, coordinates
    factors: np.ndarray  # flat float64, matrices row by row
    pulls: np.ndarray  # (K, D) float64, one below the other
    center: np.ndarray  # (D,) float64
    touched: np.ndarray  # (M, 1 + N) bool, whether the floor and each solid move in the camera
    cumulative: np.ndarray  # (M,) float64, running sum of the weights
    scale: np.ndarray  # (M,) float64
    wanted: np.ndarray  # (M,) float64, the acceptance rate that the warm-up aims at


def size_of(chart: Chart) -> int:
    """Return how many coordinates a chart has."""
    return 1 + int(chart.slots.max(initial=-1)) + FLOOR_WAYS


def touched_by(chart: Chart, members: list[int]) -> Any:
    """Return (1 + N,) bool: which of the floor and the solids move when these coordinates do."""
    moves = np.zeros((size_of(chart), len(members)))
    moves[members] = np.eye(len(members))
    return touched_by_each(chart, moves).any(axis=0)


def touched_by_each(chart: Chart, moves: np.ndarray) -> np.ndarray:
    """Return (V, 1 + N) bool: which of the floor and the solids move with each column of moves (D, V)."""
    touched = np.zeros((moves.shape[1], 1 + len(chart.flags)), bool)
    write_touched(chart.flags, chart.slots, chart.order, np.ascontiguousarray(moves.T, float), touched)
    return touched


@njit(cache=True, nogil=True)
def write_touched(flags, slots, order, moves, touched):
    """As `touched_by_each`, into `touched` (V, 1 + N), of False; moves : (V, D)."""
    tops = np.zeros(len(flags) + 1)  # how far the top of the floor, which stays, and of each solid is lifted
    for n in range(len(moves)):
        move, largest = moves[n], 0.0
        for value in move:
            largest = max(largest, abs(value))
        rounding = ROUNDING * largest
        for k in order:
            total = 0.0
            for slot in slots[k]:
                if slot >= 0 and abs(move[slot]) >= rounding:
                    total += abs(move[slot])
            lifted = tops[flags[k, PARENT] + 1] if flags[k, HELD] else 0.0
            touched[n, k + 1] = total != 0.0 or lifted != 0.0
            if flags[k, HELD]:
                own = move[slots[k, SIZE + 2]]
                total = lifted + (own if abs(own) >= rounding else 0.0)
            tops[k + 1] = total if abs(total) >= rounding else 0.0
        for way in range(len(move) - FLOOR_WAYS, len(move)):
            if move[way] != 0.0 and abs(move[way]) >= rounding:
                touched[n, :] = True


def own_members(chart: Chart, k: int) -> list[int]:
    """Return the sorted coordinates of a solid."""
    return sorted({slot for slot in chart.slots[k].tolist() if slot >= 0})


def blocks_of(chart: Chart) -> list[list[int]]:
    """Return lists of coordinates that move together: each solid, each support with what stands on it, the floor."""
    own = [own_members(chart, k) for k in range(len(chart.flags))]
    blocks, parents = list(own), chart.flags[:, PARENT].tolist()
    for k in range(len(own)):
        carried = [j for j, parent in enumerate(parents) if parent == k]
        if carried:
            blocks.append(sorted(own[k] + [m for j in carried for m in own[j]]))
    size = size_of(chart)
    return [*blocks, list(range(size - FLOOR_WAYS, size))]


def tops_of(chart: Chart) -> np.ndarray:
    """Return the (D, D) matrix that makes of coordinates those with heights of tops in place of heights of solids, for
    solids whose height is a number of its own and that are held to their support."""
    tops = np.eye(size_of(chart))
    for slot, flag in zip(chart.slots, chart.flags, strict=True):
        below = flag[PARENT]
        while flag[HELD] and below >= 0 and chart.flags[below, HELD] and slot[SIZE + 2] != slot[SIZE]:
            tops[slot[SIZE + 2], chart.slots[below, SIZE + 2]] += 1.0
            below = chart.flags[below, PARENT]
    return tops


class Step(NamedTuple):
    """One of the Proposals: members (D_p,) and matrix (D_p, R_p); touched, weight, scale and wanted as there.
    pull : (R_p, D) and center (D,), or None: see `metropolis.py` and Proposals.
    """

    members: np.ndarray
    matrix: np.ndarray
    touched: np.ndarray
    weight: float
    scale: float
    wanted: float
    pull: np.ndarray | None = None
    center: np.ndarray | None = None


def single_steps(chart: Chart, only: list[int] | None = None) -> Proposals:
    """Return the Proposals of steps along one direction each, of LATTICE metres, with weights whose sum is 1.
    only : coordinates that may move, None for all."""
    size = size_of(chart)
    free = np.zeros(size, bool)
    free[slice(None) if only is None else only] = True
    solids = [k for k, slot in enumerate(chart.slots) if free[slot[slot >= 0]].any()]
    ways = directions(chart, size, solids) * free
    ways = ways[ways.any(axis=1)]
    ways = ways[list({way.tobytes(): k for k, way in enumerate(ways)}.values())]
    rows, members = divmod(np.flatnonzero(ways), size)
    table = np.zeros((4, len(ways) + 1), np.int64)
    table[FIRST] = table[FACTOR] = np.searchsorted(rows, np.arange(len(ways) + 1))
    table[RANK, :-1], table[PULL, :-1] = 1, -1
    weights = weight_of(chart, members[table[FIRST, :-1]])
    return Proposals(
        table=table,
        members=members,
        factors=ways[rows, members],
        pulls=np.zeros((0, 0)),
        center=np.zeros(0),
        touched=np.ascontiguousarray(touched_by_each(chart, ways.T)),
        cumulative=np.cumsum(weights / weights.sum()),
        scale=np.full(len(ways), LATTICE),
        wanted=np.full(len(ways), 0.4),
    )


def weight_of(chart: Chart, first: Any) -> np.ndarray:
    """Return the weight of a step beside others of its kind, whose first coordinate this is."""
    return np.where(np.asarray(first) >= size_of(chart) - FLOOR_WAYS, FLOOR_SHARE, 1.0)


def unseen_steps(chart: Chart, sensor: Sensor, only: list[int] | None = None) -> list[Step]:
    """Return the Steps that move one side of a box or cylinder which all cameras are behind, the opposite one held."""
    size, floors = size_of(chart), [view.into @ chart.floor for view in sensor.views]
    eyes = [-floor[:3, :3].T @ floor[:3, 3] for floor in floors]
    found = []
    for slot, flag, base in zip(chart.slots, chart.flags, chart.base, strict=True):
        rotation = base[1:10].reshape(3, 3)
        for axis in range(3):
            extent = slot[SIZE + axis]
            if flag[KIND] == SPHERE or np.count_nonzero(slot[SIZE:] == extent) > 1:
                continue
            for outward in (rotation[:, axis], -rotation[:, axis]):
                faced = any(outward @ (eye - base[10:13]) > 0.5 * base[13 + axis] for eye in eyes)
                # a side that has no coordinate to move it by is held to what it stands on
                if faced or (slot[Z] < 0 and abs(outward[2]) > 0.1):
                    continue
                vector = np.zeros(size)
                vector[extent] = 1.0
                for i in range(X, Z + 1):
                    if slot[i] >= 0:
                        vector[slot[i]] = 0.5 * outward[i]
                members = np.flatnonzero(vector)
                if only is None or set(members) <= set(only):
                    found.append(Step(members, vector[members][:, None], touched_by(chart, [extent]), 0.0, UNSEEN,
                                      0.4))  # fmt: skip
    weight = min(UNSEEN_WEIGHT, UNSEEN_SHARE / max(len(found), 1))
    return [step._replace(weight=weight) for step in found]


SHRINK = 1e-6  # metres added to every spread, so that few draws do not make a factor singular


def block_steps(chart, covariance, only=None, center=None):
    """Return the Steps of coordinates that move together as a covariance (D, D) says, given those that stay.

    only : the coordinates that may move at all: then the covariance is theirs alone, (len(only), len(only)).
    center : (D,) the mean that goes with it: steps are drawn to it, but for those of what the image does not hold.
    """
    size = size_of(chart)
    members = np.arange(size) if only is None else np.asarray(only)
    place = {int(member): index for index, member in enumerate(members)}
    tops = tops_of(chart)[np.ix_(members, members)]
    back = np.linalg.inv(tops)
    loose = np.full(size, LOOSE)
    turns = chart.slots[:, TURN:SIZE]
    loose[turns[turns >= 0]] = loose[size - FLOOR_WAYS :] = LOOSE_TURN
    held = np.sqrt(np.diag(covariance)) < loose[members]
    precision = back.T @ np.linalg.inv(covariance + SHRINK**2 * np.eye(len(members))) @ back
    together = blocks_of(chart)
    blocks = {tuple(m for m in block if m in place): None for block in together}
    indices = [[place[m] for m in block] for block in blocks if block]
    factors = [factor_of_inverse(precision[np.ix_(index, index)]) for index in indices]
    matrices = [back[:, index] @ factor for index, factor in zip(indices, factors, strict=True)]
    moves = np.zeros((size, sum(map(len, indices))))
    moves[members] = np.hstack(matrices)
    by_column, steps = np.split(touched_by_each(chart, moves), np.cumsum([len(index) for index in indices])), []
    for index, factor, matrix, touched in zip(indices, factors, matrices, by_column, strict=False):
        block, moving = members[index], matrix.any(axis=1)
        step = Step(members[moving], matrix[moving], touched.any(axis=0), float(weight_of(chart, block[0])),
                    1.5 / np.sqrt(len(block)), 0.25)  # fmt: skip
        if center is not None and held[moving].all():
            pull = np.zeros((len(block), size))
            pull[:, members] = factor.T @ precision[index] @ tops / WIDER
            step = step._replace(matrix=WIDER * step.matrix, pull=pull, center=center, scale=min(step.scale, 1.0))
        steps.append(step)
    if place.keys() > set(together[-1]):
        steps.append(floor_step(covariance + SHRINK**2 * np.eye(size), len(chart.flags), center))
    weight = 2.0 / sum(step.weight for step in steps)
    return [step._replace(weight=weight * step.weight) for step in steps]


def inverse_of(precision: np.ndarray) -> np.ndarray:
    """Return the covariance P^-1 (n, n) of a precision P (n, n), positive definite however P was rounded."""
    try:
        inverse = np.linalg.inv(precision)
        np.linalg.cholesky(inverse)
        return inverse
    except np.linalg.LinAlgError:
        factor = factor_of_inverse(precision)
        return factor @ factor.T


def factor_of_inverse(precision: np.ndarray) -> np.ndarray:
    """Return a factor F (n, n) of the covariance F F' = P^-1 of a precision P (n, n), rounded as it may be."""
    try:
        return np.linalg.cholesky(np.linalg.inv(precision))
    except np.linalg.LinAlgError:  # rounding has left a direction that is hardly held with nothing, or less
        values, vectors = np.linalg.eigh(0.5 * (precision + precision.T))
        return vectors / np.sqrt(np.maximum(values, values[-1] * len(values) * np.finfo(float).eps))


def floor_step(covariance: np.ndarray, count: int, center: np.ndarray | None) -> Step:
    """Return the Step that moves the floor, and with it all else as a covariance (D, D) lets expect.

    The floor's coordinates f, of covariance L L', move by L z and the others by C(others, f) C(f, f)^-1 L z: what these
    are off what f lets expect stays. Given the others the floor alone hardly moves. count : of solids. center : see
    above.
    """
    size, factor = len(covariance), np.linalg.cholesky(covariance[-FLOOR_WAYS:, -FLOOR_WAYS:])
    matrix = np.linalg.solve(factor, covariance[-FLOOR_WAYS:]).T
    step = Step(np.arange(size), matrix, np.ones(1 + count, bool), FLOOR_SHARE, 1.5 / np.sqrt(FLOOR_WAYS), 0.25)
    if center is None:
        return step
    pull = np.zeros((FLOOR_WAYS, size))
    pull[:, -FLOOR_WAYS:] = np.linalg.inv(factor) / WIDER
    return step._replace(matrix=WIDER * matrix, pull=pull, center=center, scale=min(step.scale, 1.0))


def make_proposals(steps: list[Step]) -> Proposals:
    """Return the Proposals that choose among Steps."""
    members, matrices, touched, weights, scales, wanted, pulls, centers = zip(*steps, strict=True)
    heights = [0 if pull is None else len(pull) for pull in pulls]
    table = np.zeros((4, len(steps) + 1), np.int64)
    np.cumsum([len(each) for each in members], out=table[FIRST, 1:])
    np.cumsum([matrix.size for matrix in matrices], out=table[FACTOR, 1:])
    table[RANK, :-1] = [matrix.shape[1] for matrix in matrices]
    table[PULL, :-1] = np.where(heights, np.cumsum(heights) - heights, -1)
    drawn = [pull for pull in pulls if pull is not None]
    return Proposals(
        table=table,
        members=np.concatenate(members).astype(np.int64),
        factors=np.concatenate([matrix.ravel() for matrix in matrices]),
        pulls=np.concatenate(drawn) if drawn else np.zeros((0, 0)),
        center=next((center for center in reversed(centers) if center is not None), np.zeros(0)),
        touched=np.array(touched),
        cumulative=np.cumsum(weights),
        scale=np.array(scales),
        wanted=np.array(wanted),
    )


def joined(alone: Proposals, drawn: Proposals) -> Proposals:
    """Return the Proposals of two, of which only those of the second may be drawn to a center."""
    table = np.concatenate([alone.table[:, :-1], drawn.table], axis=1)
    count = len(alone.scale)
    table[FIRST, count:] += len(alone.members)
    table[FACTOR, count:] += len(alone.factors)
    both = {name: np.concatenate([getattr(alone, name), getattr(drawn, name)])
            for name in ("members", "factors", "touched", "scale", "wanted")}  # fmt: skip
    cumulative = np.concatenate([alone.cumulative, alone.cumulative[-1] + drawn.cumulative])
    return drawn._replace(table=table, cumulative=cumulative, **both)


def adapted(steps: Proposals, walked: Proposals) -> Proposals:
    """Return the Proposals with the scales of others that begin with them."""
    return steps._replace(scale=walked.scale[: len(steps.scale)])
