"""Steps that a walk through a structure's coordinates may take: which move together, in which direction, how far.

One column for the steps in which a depth image is informative (`directions.py`), and for those that move a side
which the camera is behind; Cholesky factors of a covariance for one solid, for a support with all that it carries,
and for the floor, each given the coordinates that stay.
"""

from typing import NamedTuple

import numpy as np

from derender.inference.structure.draws.chart import (
    FLOOR_WAYS,
    KIND,
    PARENT,
    SIZE,
    X,
    Z,
)
from derender.inference.structure.draws.directions import directions
from derender.model.solids import SPHERE

FIRST, FACTOR, RANK = range(3)  # rows of Proposals.table
LATTICE = 1e-3  # metres of the first steps
UNSEEN = 3e-3  # metres of the first steps of a side that the camera does not face
UNSEEN_WEIGHT, UNSEEN_SHARE = 0.15, 0.75  # weight of each such side, and of all of them at most


class Proposals(NamedTuple):
    """Steps to choose from. M of them.

    Attributes
    ----------
    table : (3, M + 1) int64: begin of its coordinates, begin of its matrix, number of columns.
    members : flat int64, coordinates. factors : flat float64, matrices row by row.
    touched : (M, 1 + N) bool, whether the floor and each solid move in the camera.
    cumulative : (M,) float64, running sum of the weights.
    scale : (M,) float64; wanted : (M,) float64, the acceptance rate that the warm-up aims at.
    """

    table: np.ndarray
    members: np.ndarray
    factors: np.ndarray
    touched: np.ndarray
    cumulative: np.ndarray
    scale: np.ndarray
    wanted: np.ndarray


def size_of(chart):
    """Return how many coordinates a chart has."""
    return 1 + int(chart.slots.max(initial=-1)) + FLOOR_WAYS


def touched_by(chart, members):
    """Return (1 + N,) bool: which of the floor and the solids move when these coordinates do."""
    size, touched = size_of(chart), np.zeros(len(chart.flags) + 1, bool)
    members = set(int(m) for m in members)
    if any(m >= size - FLOOR_WAYS for m in members):
        touched[:] = True
        return touched
    for k in chart.order:
        parent = chart.flags[k, 2]
        carried = parent >= 0 and touched[parent + 1] and chart.flags[k, 3]
        touched[k + 1] = carried or bool(members & {int(s) for s in chart.slots[k]})
    return touched


def own_members(chart, k):
    """Return the sorted coordinates of a solid."""
    return sorted({int(s) for s in chart.slots[k] if s >= 0})


def blocks_of(chart):
    """Return lists of coordinates that move together: each solid, each support with what stands on it, the floor."""
    own = [own_members(chart, k) for k in range(len(chart.flags))]
    blocks = list(own)
    for k in range(len(own)):
        carried = np.flatnonzero(chart.flags[:, PARENT] == k)
        if len(carried):
            blocks.append(sorted(own[k] + [m for j in carried for m in own[j]]))
    size = size_of(chart)
    return [*blocks, list(range(size - FLOOR_WAYS, size))]


class Step(NamedTuple):
    """One of the Proposals: members (D_p,) and matrix (D_p, R_p); touched, weight, scale and wanted as there."""

    members: np.ndarray
    matrix: np.ndarray
    touched: np.ndarray
    weight: float
    scale: float
    wanted: float


def single_steps(chart, only=None):
    """Return the Steps along one direction each, of LATTICE metres; only : coordinates that may move, None for all."""
    size = size_of(chart)
    free = np.isin(np.arange(size), list(range(size) if only is None else only))
    solids = [k for k, slot in enumerate(chart.slots) if free[slot[slot >= 0]].any()]
    ways = list({v.tobytes(): v for v in directions(chart, size, solids) * free if np.any(v)}.values())
    steps = []
    for vector in ways:
        members = np.flatnonzero(vector)
        steps.append(Step(members, vector[members][:, None], touched_by(chart, members), 1.0 / len(ways), LATTICE,
                          0.4))  # fmt: skip
    return steps


def unseen_steps(chart, only=None):
    """Return the Steps that move one side of a box or cylinder which the camera is behind, the opposite one held."""
    size, eye = size_of(chart), -chart.floor[:3, :3].T @ chart.floor[:3, 3]
    found = []
    for slot, flag, base in zip(chart.slots, chart.flags, chart.base, strict=True):
        rotation = base[1:10].reshape(3, 3)
        for axis in range(3):
            extent = slot[SIZE + axis]
            if flag[KIND] == SPHERE or np.count_nonzero(slot[SIZE:] == extent) > 1:
                continue
            for outward in (rotation[:, axis], -rotation[:, axis]):
                # a side that has no coordinate to move it by is held to what it stands on
                if outward @ (eye - base[10:13]) > 0.5 * base[13 + axis] or (slot[Z] < 0 and abs(outward[2]) > 0.1):
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


def block_steps(chart, covariance, only=None, shrink=1e-6):
    """Return the Steps of coordinates that move together as a covariance (D, D) says, given those that stay.

    only : the coordinates that may move at all: then the covariance is theirs alone, (len(only), len(only)).
    shrink : metres added to every spread, so that few draws do not make a factor singular.
    """
    size = size_of(chart)
    members = list(range(size) if only is None else only)
    place = {member: index for index, member in enumerate(members)}
    precision = np.linalg.inv(covariance + shrink**2 * np.eye(len(members)))
    blocks = {tuple(m for m in block if m in place): None for block in blocks_of(chart)}
    steps = []
    for block in filter(None, blocks):
        index = [place[m] for m in block]
        factor = np.linalg.cholesky(np.linalg.inv(precision[np.ix_(index, index)]))
        steps.append(Step(np.array(block), factor, touched_by(chart, block), 1.0, 1.5 / np.sqrt(len(block)), 0.25))
    return [step._replace(weight=2.0 / len(steps)) for step in steps]


def make_proposals(steps):
    """Return the Proposals that choose among Steps."""
    table = np.zeros((3, len(steps) + 1), np.int64)
    for p, step in enumerate(steps):
        table[FIRST, p + 1] = table[FIRST, p] + len(step.members)
        table[FACTOR, p + 1] = table[FACTOR, p] + step.matrix.size
        table[RANK, p] = step.matrix.shape[1]
    return Proposals(
        table=table,
        members=np.concatenate([step.members for step in steps]).astype(np.int64),
        factors=np.concatenate([np.ravel(step.matrix) for step in steps]),
        touched=np.array([step.touched for step in steps]),
        cumulative=np.cumsum([step.weight for step in steps]),
        scale=np.array([step.scale for step in steps]),
        wanted=np.array([step.wanted for step in steps]),
    )


