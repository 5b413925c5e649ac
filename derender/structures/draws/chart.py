"""Coordinates of a structure: the free numbers of the solids on a floor, and the floor's own three, as one vector.

A solid held to its support has no height of its own: its bottom is the top of what carries it. Places and turns are
the world's (the floor's axes), not the contact's: when a support grows or slides, what stands on it stays where it is
over the floor, so coordinates of different solids are nearly independent given the image. The prior below is a density
in these coordinates; a contact's own density (uniform over the touching area, Figure 2) is divided by that area.
"""

from typing import NamedTuple

import numpy as np

from derender.compilation.cache import njit
from derender.detection.solids.beliefs import (
    CUBE,
    IMPOSSIBLE,
    MOST,
    Beliefs,
    Rules,
    bare_image,
    box_log_density,
    log_density_at,
)
from derender.detection.solids.image import ROW, pose_in
from derender.detection.solids.interpenetration import gap_between, highest, lowest, penetration_beyond, reach
from derender.detection.solids.polish import FREE
from derender.detection.solids.state import FLOOR, State
from derender.detection.solids.support import TOUCHING, flat_top, shadows_overlap
from derender.scene.pose import upright_frame
from derender.scene.solids import BOX, CYLINDER, SPHERE

KIND, VERTICAL, PARENT, HELD, EQUAL, ALONE = range(6)  # columns of Chart.flags
X, Y, Z, TURN, SIZE, SLOTS = 0, 1, 2, 3, 6, 9  # columns of Chart.slots
FLOOR_WAYS = 3  # two tilts and a height, the last coordinates of all

MOST_TILT = np.radians(3.0)  # of what stands upright: a search lets it tilt as real floors do, twice their deviation
LEVEL_WITHIN = 0.012  # metres between a bottom and the top that it is made level with
BENEATH = 0.001  # metres under a solid's middle where what bears it is looked for: its face may lie a hair askew
LEAST_EXTENT = 0.004  # metres: thinner solids are noise, whatever a prior says
EIGHTH = np.sqrt(0.5) - 1e-9  # cosine of an eighth of a turn, to rounding
ROOT_OF_3 = np.sqrt(3.0)
EIGHT_PI_SQUARED = 8.0 * np.pi**2


class Chart(NamedTuple):
    """Which numbers of a structure are free.

    flags : (N, 6) int64, see KIND ... ; the parent is FLOOR or an index; EQUAL: whether it is a cube; ALONE: whether
        nothing but its parent, a solid, bears it.
    hanging, tipping : nats that touching nothing costs, and tipping off what bears it.
    """

    flags: np.ndarray
    slots: np.ndarray  # (N, 9) int64, which coordinate gives x, y, z, three turns, three extents of a solid; -1: none
    base: np.ndarray  # (N, ROW) float64, the solids at the start: rotations are turns from there
    order: np.ndarray  # (N,) int64, supports before what they carry
    floor: np.ndarray  # (4, 4) float64, floor frame to camera at the start
    slack: float  # as in Rules
    overlap: float  # as in Rules
    faces: float  # as in Rules
    resting: float  # as in Loose
    floating: bool  # as in Rules
    sunk: float  # metres by which solids may sink into the floor
    hanging: float
    tipping: float
    sizes: np.ndarray  # as in Beliefs
    structural: float  # log prior of the structure itself: how many solids stand where, of which kinds, upright or not


def levelled(rotation: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) nearest to one, to first order, whose z axis is exactly up or down."""
    return upright_frame(np.array([0.0, 0.0, np.copysign(1.0, rotation[2, 2])]), rotation[:, 0])[:3, :3]


def make_chart(state: State, floor_pose: np.ndarray, rules: Rules) -> tuple[Chart, np.ndarray]:
    """Return (Chart, coordinates (D,)) of a State. rules : Rules."""
    from derender.detection.solids.graph import order_of

    count = len(state)
    parents = list(state.parents)
    order = order_of(parents)
    rows = np.array(state.rows, float)
    flags, slots = np.zeros((count, 6), np.int64), np.full((count, SLOTS), -1, np.int64)
    values: list[float] = []

    def free(solid, column, value):
        slots[solid, column] = len(values)
        values.append(float(value))

    for k in range(count):
        row, kind = state.rows[k], int(state.rows[k][0])
        support = support_of(state, k, parents[k])
        vertical = state.forms[k] != FREE and kind != SPHERE and abs(rows[k, 9]) >= np.cos(MOST_TILT)
        held = support is not None and (vertical or kind == SPHERE)
        on = parents[k] if support is None else support
        alone = vertical and held and on != FLOOR and not borne_besides(state.rows, k, on)
        flags[k] = kind, vertical, on, held, state.cubes[k], alone
        if vertical:
            rows[k, 1:10] = levelled(rows[k, 1:10].reshape(3, 3)).ravel()
        if kind == SPHERE:  # a sphere may be turned as one likes: so that its contact needs no turn
            rows[k, 1:10] = np.diag([1.0, -1.0, -1.0]).ravel()
        free(k, X, row[10])
        free(k, Y, row[11])
        if not held:
            free(k, Z, row[12])
        if kind == BOX:
            for axis in (2,) if vertical else (0, 1, 2):
                free(k, TURN + axis, 0.0)
        elif kind == CYLINDER and not vertical:
            for axis in (0, 1):
                free(k, TURN + axis, 0.0)
        free(k, SIZE, row[13])
        if kind == BOX and (rules.faces > 0.0 or not state.cubes[k]):  # a cube's faces appear where they do
            free(k, SIZE + 1, row[14])
            free(k, SIZE + 2, row[15])
        elif kind == CYLINDER:
            slots[k, SIZE + 1] = slots[k, SIZE]
            free(k, SIZE + 2, row[15])
        else:
            slots[k, SIZE + 1 :] = slots[k, SIZE]
    beliefs = bare_image() if rules.beliefs is None else rules.beliefs
    loose = beliefs.loose
    overlap = loose.overlap if rules.overlap is None else rules.overlap
    chart = Chart(flags, slots, rows, np.array(order, np.int64), np.ascontiguousarray(floor_pose, dtype=float),
                  rules.slack, overlap, rules.faces, loose.resting, rules.floating, loose.overlap,
                  -float(np.log(loose.hanging)), 0.0 if rules.floating else -float(np.log(loose.tipping)),
                  beliefs.sizes, structure_log_prior(flags, beliefs))  # fmt: skip
    return chart, np.array([*values, 0.0, 0.0, 0.0])


def structure_log_prior(flags: np.ndarray, beliefs: Beliefs) -> float:
    """Return the log prior of a structure, all but the densities of its numbers: with those it is comparable between
    structures of different numbers of solids.

    Solids on the floor and on each top are a set: p(n) n! times the density of one place each.
    """
    total = beliefs.on_floor[min(int(np.sum(flags[:, PARENT] == FLOOR)), MOST)]
    for k, (kind, vertical, _, _, equal, _) in enumerate(flags):
        row = CUBE if equal else int(kind)
        total += beliefs.kinds[row] + (
            0.0 if kind == SPHERE else (beliefs.upright if vertical else beliefs.tilted)[row]
        )
        carried = int(np.sum(flags[:, PARENT] == k))
        if vertical and kind != SPHERE:
            total += beliefs.on_top[row][min(carried, MOST)]
        else:  # what has no level top carries nothing but what leans on it
            total += carried * (beliefs.on_top[row][1] if kind != SPHERE else IMPOSSIBLE)
    return float(total)


def support_of(state: State, k: int, parent: int) -> int | None:
    """Return what solid k is level with the top of: its parent or the floor; None for neither."""
    low = lowest(state.rows[k])
    if np.isnan(state.bottoms[k]):
        return None
    if parent != FLOOR and abs(low - highest(state.rows[parent])) < LEVEL_WITHIN:
        return parent
    return FLOOR if abs(low) < LEVEL_WITHIN else None


def borne_besides(rows: np.ndarray, k: int, on: int) -> bool:
    """Whether solid k's bottom lies on another one's top besides that of solid `on`, or does so but for rounding."""
    low = lowest(rows[k])
    others = (j for j in range(len(rows)) if j not in (k, on) and abs(highest(rows[j]) - low) < TOUCHING)
    return any(flat_top(rows[j]) and shadows_overlap(rows[k], rows[j]) for j in others)


@njit(cache=True, nogil=True, borrows=True)
def place_rows(chart, values, rows):
    """Write the rows (N, ROW) of the solids at these coordinates (D,)."""
    for k in chart.order:
        slot, flag, row, base = chart.slots[k], chart.flags[k], rows[k], chart.base[k]
        for i in range(ROW):
            row[i] = base[i]
        for i in range(3):
            row[13 + i] = values[slot[SIZE + i]]
        if flag[VERTICAL]:
            if slot[TURN + 2] >= 0:
                c, s = np.cos(values[slot[TURN + 2]]), np.sin(values[slot[TURN + 2]])
                for j in range(3):
                    x, y = base[1 + j], base[4 + j]
                    row[1 + j], row[4 + j] = c * x - s * y, s * x + c * y
        else:
            for axis in range(3):
                if slot[TURN + axis] >= 0:
                    c, s = np.cos(values[slot[TURN + axis]]), np.sin(values[slot[TURN + axis]])
                    p, q = (axis + 1) % 3, (axis + 2) % 3
                    for i in range(3):
                        x, y = row[1 + 3 * i + p], row[1 + 3 * i + q]
                        row[1 + 3 * i + p], row[1 + 3 * i + q] = c * x + s * y, c * y - s * x
        row[10], row[11] = values[slot[X]], values[slot[Y]]
        if flag[HELD]:
            height = 0.0 if flag[PARENT] == FLOOR else highest(rows[flag[PARENT]])
            row[12] = height + reach(row, 0.0, 0.0, 1.0)
        else:
            row[12] = values[slot[Z]]


@njit(cache=True, nogil=True, borrows=True)
def camera_poses(chart, values, rows, poses, sizes):
    """Write the poses (1 + N, 4, 4), object to camera, and extents (1 + N, 3) of the floor and the solids."""
    ways = len(values) - FLOOR_WAYS
    ca, sa = np.cos(values[ways]), np.sin(values[ways])
    cb, sb = np.cos(values[ways + 1]), np.sin(values[ways + 1])
    floor = poses[0]
    for i in range(3):
        x, y, z = chart.floor[i, 0], chart.floor[i, 1], chart.floor[i, 2]
        floor[i, 0] = x * cb + y * sa * sb - z * ca * sb  # turned about x, then y
        floor[i, 1] = y * ca + z * sa
        floor[i, 2] = x * sb - y * sa * cb + z * ca * cb
        floor[i, 3] = chart.floor[i, 3] + z * values[ways + 2]
        sizes[0, i] = 0.0
        floor[3, i] = 0.0
    floor[3, 3] = 1.0
    for k in range(len(rows)):
        pose_in(floor, rows[k], poses[k + 1])
        for i in range(3):
            sizes[k + 1, i] = rows[k, 13 + i]


def rows_at(chart: Chart, values: np.ndarray) -> np.ndarray:
    """Return the rows (N, ROW) of the solids at coordinates (D,)."""
    rows = np.empty((len(chart.flags), ROW))
    place_rows(chart, values, rows)
    return rows


def placed(chart: Chart, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `rows_at` coordinates (D,), and what `camera_poses` writes of them."""
    rows = rows_at(chart, values)
    poses, sizes = np.empty((len(rows) + 1, 4, 4)), np.empty((len(rows) + 1, 3))
    camera_poses(chart, values, rows, poses, sizes)
    return rows, poses, sizes


@njit(cache=True, nogil=True, borrows=True)
def touching_area(row, on):
    """Return the area in which an upright solid's centre may lie so that it touches the top of `on`, square metres.
    That of the Minkowski sum of the two outlines: both areas and twice their mixed area."""
    a, b, c, d = row[13], row[14], on[13], on[14]
    round_one, round_other = int(row[0]) != BOX, int(on[0]) != BOX
    if int(row[0]) == SPHERE:  # it touches in a point
        a, b = 0.0, 0.0
    if round_one and round_other:
        return 0.25 * np.pi * (a + c) ** 2
    if round_one:
        return c * d + 0.25 * np.pi * a * a + a * (c + d)
    if round_other:
        return a * b + 0.25 * np.pi * c * c + c * (a + b)
    cosine = abs(row[1] * on[1] + row[4] * on[4])
    sine = abs(row[1] * on[2] + row[4] * on[5])
    return a * b + c * d + sine * (a * c + b * d) + cosine * (a * d + b * c)


@njit(cache=True, nogil=True, borrows=True)
def beyond(row, on):
    """Whether a solid's middle lies beyond what bears it: then it tips, did no friction hold it."""
    height = highest(on) - BENEATH - on[12]
    x, y = row[10] - on[10], row[11] - on[11]
    a = abs(x * on[1] + y * on[4] + height * on[7])
    b = abs(x * on[2] + y * on[5] + height * on[8])
    c = abs(x * on[3] + y * on[6] + height * on[9])
    if int(on[0]) == SPHERE:
        return a * a + b * b + c * c > 0.25 * on[13] ** 2
    across = a > 0.5 * on[13] or b > 0.5 * on[14] if int(on[0]) == BOX else a * a + b * b > 0.25 * on[13] ** 2
    return across or c > 0.5 * on[15]


def tipping(chart: Chart, rows: np.ndarray) -> list[int]:
    """Return which solids would tip off what bears them, did no friction hold them."""
    alone = np.flatnonzero(chart.flags[:, ALONE])
    return [int(k) for k in alone if beyond(rows[k], rows[chart.flags[k, PARENT]])]


@njit(cache=True, nogil=True, borrows=True)
def solid_log_prior(chart, rows, k):
    """Return the log prior density of one solid's own coordinates: size, place, turn; -inf where it leaves its support.

    Sizes are as chart.sizes has them. Places on the floor are even (how many there are to a square metre is in
    chart.structural), those on another's top even over the places where the two touch. Turns are uniform: a box in
    (length, width, theta) has two names in each half turn, a cube one in each quarter; one that stands upright is
    within an eighth of a turn of where it began, so that it has one name. What would tip is as rare as the file says.
    """
    row, flag, slot = rows[k], chart.flags[k], chart.slots[k]
    kind = flag[KIND]
    cube = flag[EQUAL] == 1
    total = 0.0
    if min(row[13], row[14], row[15]) < LEAST_EXTENT:
        return -np.inf
    if kind == BOX and flag[VERTICAL]:  # turned by more it is the same box under another name, which counts once
        base = chart.base[k]
        if base[1] * row[1] + base[4] * row[4] < EIGHTH:
            return -np.inf
    if cube and slot[SIZE] != slot[SIZE + 1]:
        total += apparent_cube_log_density(chart, row[13:16])
    elif kind == BOX and not cube:
        total += box_log_density(chart.sizes[BOX], row[13:16], flag[VERTICAL])
    else:
        for i in range(3):
            if i > 0 and slot[SIZE + i] == slot[SIZE + i - 1]:
                continue
            total += log_density_at(chart.sizes[CUBE if cube else kind, i], row[13 + i])
    parent = flag[PARENT]
    if parent != FLOOR:
        on = rows[parent]
        if min(on[13], on[14], on[15]) < LEAST_EXTENT:  # before the area that it offers is taken the logarithm of
            return -np.inf
        if flag[HELD]:
            height, row[12] = row[12], on[12]  # beside each other they overlap where one lies over the other
            apart = penetration_beyond(row, on, 0.0) <= 0.0
            row[12] = height
            if apart:
                return -np.inf
        total -= np.log(touching_area(row, on))
        if flag[ALONE] and beyond(row, on):
            total -= chart.tipping
    if kind == SPHERE or (kind == CYLINDER and flag[VERTICAL]):
        turns = 1.0
    elif flag[VERTICAL]:
        turns = 0.5 * np.pi
    else:
        turns = EIGHT_PI_SQUARED / 24.0 if kind == BOX else 2.0 * np.pi
    total -= np.log(turns)
    if not flag[HELD] and not (chart.floating and parent == FLOOR):
        # it touches what bears it somewhere; the tails are those of Cauchy's density as far as one can say that it does
        gap = lowest(row) if parent == FLOOR else gap_between(row, rows[parent])
        total -= np.log(np.pi * chart.slack * (1.0 + (gap / chart.slack) ** 2))
        if not chart.floating:
            apart = (gap / LEVEL_WITHIN) ** 4
            total -= chart.hanging * apart / (1.0 + apart)
    return total


@njit(cache=True, nogil=True, borrows=True)
def apparent_cube_log_density(chart, extents):
    """Return the log density of the extents (3,) at which the faces of a cube appear to be, its side unknown.

    Each extent is the side s and two faces' offsets, together normal with variance v = 2 faces^2, so that the density
    is the integral over s of p(s) N(a; s, v) N(b; s, v) N(c; s, v): with p even over a few millimetres

        p(m) exp(-((a - m)^2 + (b - m)^2 + (c - m)^2) / 2v) / (sqrt(3) 2 pi v),    m = (a + b + c) / 3.
    """
    mean, variance = (extents[0] + extents[1] + extents[2]) / 3.0, 2.0 * chart.faces**2
    square = (extents[0] - mean) ** 2 + (extents[1] - mean) ** 2 + (extents[2] - mean) ** 2
    return (
        log_density_at(chart.sizes[CUBE, 0], mean)
        - 0.5 * square / variance
        - np.log(ROOT_OF_3 * 2.0 * np.pi * variance)
    )


@njit(cache=True, nogil=True)
def log_prior(chart, rows):
    """Return the log prior density of all solids: the structure's, each one's own, that they do not interpenetrate."""
    return chart.structural + log_prior_about(chart, rows, np.ones(len(rows) + 1, np.bool_))


@njit(cache=True, nogil=True, borrows=True)
def log_prior_about(chart, rows, touched):
    """Return those terms of the log prior density that change when solids do.
    touched : (1 + N,) bool, whether the floor (which does not count) and each solid move."""
    total = 0.0
    for k in range(len(rows)):
        parent = chart.flags[k, PARENT]
        if touched[k + 1] or (parent >= 0 and touched[parent + 1]):
            total += solid_log_prior(chart, rows, k)
            if total == -np.inf:
                return total
            low = lowest(rows[k])
            if low < -chart.sunk:
                total -= 0.5 * (low / chart.sunk + 1.0) ** 2
        for j in range(k):
            if touched[k + 1] or touched[j + 1]:
                depth = penetration_beyond(rows[k], rows[j], chart.overlap)
                if depth > chart.overlap:
                    total -= 0.5 * (depth / chart.overlap - 1.0) ** 2
    return total
