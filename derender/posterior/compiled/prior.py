"""Prior, moves and differences on the flat values: `space.py` compiled, number for number.

So are the prior's constraints, on a chain's own poses: what sums them (scene/priors/terms.py) is called by its address,
and only compiled for models with constraints.
"""

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from derender.compilation.cache import Kernel, call_for_number, interpreted, njit
from derender.posterior import space as readable
from derender.posterior.space import Block, Space
from derender.scene.distributions import Distribution, distributions

ROTATION = 1  # code of the uniform distribution over rotations; that of others is 0
CONTACT, SHAPE, ROOT, LIKELIHOOD, HELD = range(5)  # tables that a value can go into; HELD: none, the caller sets it
CODE, OFFSET, DIRECTION, DENSITY_AT, DRAW_AT = range(5)  # rows of Model.unknowns
PERIOD, FOLD_CENTRE, FOLD_PERIOD = 4, 5, 6  # columns of Model.laws, after the distribution's row
TABLE, VERTEX, SLOT, OWNER = range(4)  # rows of Model.places
PARENT, CONTACT_CODE, KIND, PARENT_FACE, CHILD_FACE, SOLID, POSE_AT, INVERSE_AT = range(8)  # rows of Model.vertices
FORM, FIRST, FACTOR_FIRST, KEEP, PROPOSE_AT, KEEP_AT, PLACE_AT = range(7)  # rows of Kernels.table
NOW, NEXT = np.int64(0), np.int64(1)  # halves of the chain's arrays; no literals: each would be compiled for itself
SIZES, SHAPES = 7, 10  # columns of Chain.numbers where the extents and the shape's numbers begin, after the contact's
DIRTY, KEPT, MOVED = range(3)  # rows of Chain.marks
PENDING = 0  # entry of Chain.flags


class Model(NamedTuple):
    """The prior and where each value goes. U unknowns, P values, D directions, N vertices.

    unknowns : (5, U + 1) int64: whether it is a rotation, first value, first direction (the last column ends these
        two), and the addresses of the prior's kernels (prior.py).
    laws : (U, 7) float64: the row of the prior's numbers, the period (0 on a line), and how a theta is folded.
    places : (4, P) int64, where a value goes: which table, which vertex, which slot; and the unknown that it is of.
    vertices : (8, N + 1) int64: parent (the root is N), contact, kind, faces as in contacts.compiled, the place among
        the solids or -1, and the addresses of the contact's kernels (relative_pose, invert). The last column is the
        root's; its contact code says how its numbers give its pose (evaluate.py).
    extents : (N, 4, 3) float64: extents of a shape whose numbers are 0, and what each of three numbers adds.
    """

    unknowns: np.ndarray
    laws: np.ndarray
    places: np.ndarray
    vertices: np.ndarray
    extents: np.ndarray
    terms: np.ndarray  # (T, COLUMNS) float64, the constraints, see scene/priors/terms.py
    terms_at: int  # address of `sum_of_terms`; 0 where T is 0


class Kernels(NamedTuple):
    """The mixture. K kernels; the unknowns and factors of kernel k are slices of flat arrays.

    table : (7, K + 1) int64: form, begin of its unknowns, begin of its factor (the last column ends these two), the
        vertex whose children it keeps where they are in the world, or -1, and the addresses of what proposes, of what
        keeps them and of what puts objects down.
    members : flat int64, unknowns; of what puts an object down: see `object_below`.
    factors : flat float64, each (D_k, D_k), lower triangle in full rows; of what puts objects down: see
        relocate.fitted.
    """

    table: np.ndarray
    reach: np.ndarray  # (K,) float64, what scales of steps are multiplied by
    members: np.ndarray
    factors: np.ndarray


class Chain(NamedTuple):
    """The state of one chain and its scratch space. Where the first axis is 2: NOW, NEXT (proposed).

    numbers : (2, N + 1, 13) float64: seven of the contact, three extents, three of the shape; the root's come last.
    marks : (3, N + 1) int64: vertices that move; vertices that only get other numbers; solids handed to the engine.
    moved_pose : (S, 4, 4), moved_size : (S, 3) float64: theirs.
    """

    values: np.ndarray  # (2, P + 2) float64: the values, then the log prior and the log likelihood
    numbers: np.ndarray
    pose: np.ndarray  # (2, N + 1, 4, 4) float64, object to camera; the root's comes last
    marks: np.ndarray
    moved_pose: np.ndarray
    moved_size: np.ndarray
    tangents: np.ndarray  # (2, D) float64, scratch
    relative: np.ndarray  # (4, 4), scratch
    flags: np.ndarray  # (1,) int64: whether a proposal is pending in the engine


class Target(NamedTuple):
    """What a walk of scenes is on: the prior, the kernels, where a chain is, and its engine."""

    model: Model
    kernels: Kernels
    chain: Chain
    engine: Any  # EngineState; interpreted: what is asked for densities


wrap = njit(cache=True, nogil=True)(readable.wrap)
turn = njit(cache=True, nogil=True)(readable.turn)
_rotation_density = njit(distributions["uniform-rotation"].density)
_draw_rotation = njit(distributions["uniform-rotation"].draw)


@functools.cache
def density_and_draw(kind: type[Distribution]) -> tuple[Kernel, Kernel]:
    """Return the kernels density(x, row) -> float64 and draw(rng, row) -> float64 of a type that can be compiled.

    They are called by address, so a model compiles those that occur in it.
    """
    return njit(cache=True, nogil=True)(kind.density), njit(cache=True, nogil=True)(kind.draw)


@njit(cache=True, nogil=True)
def log_prior(unknowns, laws, values):
    """Return the log prior density of (P,) values."""
    total = 0.0
    for i in range(len(laws)):
        code, start = unknowns[CODE, i], unknowns[OFFSET, i]
        if code == ROTATION:
            total += _rotation_density(values[start : start + 4], laws[i])
        else:
            total += call_for_number(unknowns[DENSITY_AT, i], values[start], laws[i])
        if not total > -math.inf:
            return -math.inf
    return total


@njit(cache=True, nogil=True)
def resample(rng, unknowns, laws, members, values):
    """Draw some unknowns in place from their priors."""
    for i in members:
        code, start = unknowns[CODE, i], unknowns[OFFSET, i]
        if code == ROTATION:
            w, x, y, z = _draw_rotation(rng, laws[i])
            values[start], values[start + 1], values[start + 2], values[start + 3] = w, x, y, z
        else:
            values[start] = call_for_number(unknowns[DRAW_AT, i], rng, laws[i])


@njit(cache=True, nogil=True)
def move(unknowns, laws, members, values, tangent, scale, moved):
    """Write into `moved` where `values` are after a step of some unknowns by scale * tangent."""
    direction = 0
    step = tangent[:3].copy() if len(tangent) >= 3 else tangent.copy()
    for i in members:
        code, start, period = unknowns[CODE, i], unknowns[OFFSET, i], laws[i, PERIOD]
        if code == ROTATION:
            for k in range(3):
                step[k] = scale * tangent[direction + k]
            w, x, y, z = turn(values[start : start + 4], step)
            moved[start], moved[start + 1], moved[start + 2], moved[start + 3] = w, x, y, z
            direction += 3
        else:
            value = values[start] + scale * tangent[direction]
            moved[start] = value if period == 0.0 else wrap(value, period)
            direction += 1


_move = interpreted(move)


def moved(space: Space, values: np.ndarray, block: Block, tangent: np.ndarray) -> np.ndarray:
    """Return the (P,) values after a step of a block by `tangent`: `move`, interpreted.

    Symmetric: steps with a density that is even in `tangent` need no correction, on circles because wrapping keeps
    lengths, on rotations because q exp(w) is Haar-invariant. A line's values may leave the prior's support.
    """
    result, laws = values.copy(), np.zeros((len(space.unknowns), PERIOD + 1))
    laws[:, PERIOD] = [unknown.period or 0.0 for unknown in space.unknowns]
    turns = [ROTATION if unknown.ways == 3 else 0 for unknown in space.unknowns]
    _move(np.array([[*turns, 0], space.offsets, space.directions]), laws, block.unknowns, values, tangent, 1.0, result)
    return result


@njit(cache=True, nogil=True)
def directions(unknowns, members):
    """Return how many directions some unknowns have."""
    size = 0
    for i in members:
        size += unknowns[DIRECTION, i + 1] - unknowns[DIRECTION, i]
    return size


@njit(cache=True, nogil=True)
def shaped(rng, factor, size, normal, tangent):
    """tangent = factor @ normal for a (size, size) lower triangle stored flat, the normals drawn here."""
    for i in range(size):
        normal[i] = rng.standard_normal()
    for i in range(size):
        total = 0.0
        for j in range(i + 1):
            total += factor[i * size + j] * normal[j]
        tangent[i] = total


@njit(cache=True, nogil=True)
def log_terms(model, chain):
    """Return the terms' log density of the proposed poses and extents."""
    if model.terms_at == 0:
        return 0.0
    sizes = chain.numbers[NEXT, :, SIZES:SHAPES].copy()
    return call_for_number(model.terms_at, model.terms, model.vertices[KIND], chain.pose[NEXT], sizes)
