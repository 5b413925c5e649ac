"""Moves between structures: take out and explain anew, split, merge, cut anew; and those that change one solid.

It is stretched to what it leaves out, shaken, tilted, new, or what carries it changes: a box is put under it, its
bottom lifted, another's top raised, all of it.

Each move takes (rng, task, state, places) and returns (new state, set of changed indices) or None where it does not
apply. `places` tells where the image is badly explained. The search accepts what lowers the energy.
"""

import numpy as np

from derender.detection.search.bodies import FEWEST, body_hypotheses
from derender.detection.search.greedy import Changed, Task, complexity, cube_of, greedy
from derender.detection.search.places import MISFIT, Places, pick
from derender.detection.search.proposals import THINNEST
from derender.detection.solids.image import Image, make_row, rotation_of
from derender.detection.solids.interpenetration import highest, lowest, penetration, reach
from derender.detection.solids.polish import FREE, GUESSED, MOVED, UPRIGHT, turn
from derender.detection.solids.state import Solid, State, held_out, polish_solid, run_polish
from derender.detection.solids.support import LEAST_GAP, shadows_overlap, with_bottom
from derender.scene.shapes.kinds import CORNERS
from derender.scene.solids import BOX, CYLINDER, SPHERE

NEIGHBOURS = 0.06  # metres between boxes that may be one: the gap may be hidden behind another
HIDDEN = 0.4  # metres between pieces of one cross-section that may be one: as wide as what hides the gap
ALIGNED = 0.98  # cosine
TOUCH = 0.004  # metres between boxes whose union may be cut in another way
NEARLY = 0.1  # of the mean side, by which those of what may be a cube differ from it
LEVEL = 0.004  # metres between tops that may be of one solid
FLUSH = 0.02  # metres by which the sides of such pieces may differ
NOTHING = -2  # what no depth or nothing known explains, among numbers of solids


def explain_anew(rng: np.random.Generator, task: Task, state: State, places: Places) -> Changed:
    """Take out one solid with some of those that share its badly explained pixels, or that show beside it, or with all
    that are as high (another may hide what joins them), and explain what they showed: by the hypotheses, or all of it,
    or what shows beside the first, as one solid."""
    (image, settings, hypotheses), seed = task, pick(rng, places.blame)
    out = {seed} if seed < len(state) else set()
    shared = places.pairs if places.pairs[seed].any() and rng.random() < 0.5 else places.beside
    if seed < len(state) and rng.random() < 0.2:
        out |= as_high(state, seed)
    else:
        out |= {j for j in range(len(state)) if shared[seed, j] > 0 and rng.random() < 0.5}
    new = state.without(*out)
    kept = len(new)
    for one in (frozenset(out), frozenset(out - {seed})):
        points = places.seen[np.isin(places.shown, list(one)) & (image.depth > 0)]
        if len(points) >= FEWEST:
            bottom = max(min(lowest(state.rows[k]) for k in one), 0.0)
            if one not in places.alone:
                places.alone[one] = list(body_hypotheses(points, image.origin, settings.shapes, bottom))
            hypotheses = [*hypotheses, *places.alone[one]]
    if rng.random() < 0.5:
        hypotheses = [as_cube(each, image.origin) for each in hypotheses]
    new = greedy(rng, image, hypotheses, settings, new, tried=2, shake=0.7)
    return new, set(range(kept, len(new)))


def as_cube(solid: Solid, origin: np.ndarray) -> Solid:
    """Return a solid that is nearly a cube as one: it keeps to its place where others show beside it."""
    sides = solid.row[13:16].tolist()
    side = sum(sides) / 3.0
    if solid.kind != BOX or max(abs(each - side) for each in sides) > NEARLY * side:
        return solid
    return cube_of(solid, side, origin)


def as_high(state: State, i: int) -> set[int]:
    """Return the solids near another whose tops are as high."""
    row = state.rows[i]
    near = [j for j in range(len(state)) if np.hypot(*(state.rows[j][10:12] - row[10:12])) < HIDDEN]
    return {j for j in near if j != i and abs(highest(state.rows[j]) - highest(row)) < LEVEL}


def split(rng: np.random.Generator, task: Task, state: State, places: Places) -> Changed | None:
    """Cut a box in two across one of its axes, at a badly explained point or anywhere, and polish both pieces."""
    boxes = [i for i in range(len(state)) if int(state.rows[i][0]) == BOX]
    if not boxes or len(state) >= task.settings.max_objects or places.none_left(task.settings):
        return None
    i = boxes[pick(rng, places.blame[boxes])]
    row = state.rows[i]
    axis = int(rng.integers(3))
    half = 0.5 * row[13 + axis]
    cut = rng.uniform(-0.8, 0.8) * half
    if len(places.points) and rng.random() < 0.7:
        along = (places.points[rng.integers(len(places.points))] - row[10:13]) @ rotation_of(row)[:, axis]
        if abs(along) < 0.95 * half:
            cut = along
    pieces = []
    for low, high in ((-half, cut), (cut, half)):
        piece = row.copy()
        piece[13 + axis] = max(high - low, 0.006)
        piece[10:13] += 0.5 * (low + high) * rotation_of(row)[:, axis]
        pieces.append(piece)
    new = state.changed(i, row=pieces[0], cube=False).add(pieces[1], state.forms[i], False)
    last = len(new) - 1
    for k in (i, last) if rng.random() < 0.5 else (last, i):
        polish_solid(rng, task.image, new, k, task.settings)
    return new, {i, last}


def corners_of(row: np.ndarray) -> np.ndarray:
    """Return the eight corners (8, 3) of a solid's oriented box."""
    return row[10:13] + (CORNERS * row[13:16]) @ rotation_of(row).T


def merge(rng: np.random.Generator, task: Task, state: State, places: Places) -> Changed | None:
    """Put one solid in place of two near and aligned ones, spanning both along the axes of one."""
    near = aligned_pairs(state)
    if not near:
        return None
    i, j = near[int(rng.integers(len(near)))]
    return merge_pair(rng, task, state, i, j, rng.random(3) < 0.3)


def aligned_pairs(state: State) -> list[tuple[int, int]]:
    """Return the ordered pairs of boxes, and of cylinders, whose axes agree and that may be pieces of one."""
    pairs = [(i, j) for i in range(len(state)) for j in range(len(state)) if i != j]
    return [(i, j) for i, j in pairs if may_be_one(state.rows[i], state.rows[j])]


def may_be_one(row: np.ndarray, other: np.ndarray) -> bool:
    """Whether two solids of a kind are aligned, and near or in line with each other."""
    kind = int(row[0])
    if kind != int(other[0]) or kind not in (BOX, CYLINDER) or alignment(row, other) < ALIGNED:
        return False
    if kind == BOX and penetration(grown(row, NEIGHBOURS), other) > 0:
        return True
    low, high = extents_along(row, other)
    half = 0.5 * row[13:16]
    flush = np.maximum(np.abs(low + half), np.abs(high - half)) < FLUSH
    gap = np.maximum(low - half, -half - high)
    along = (2,) if kind == CYLINDER else (0, 1, 2)
    return any(flush[k - 1] and flush[k - 2] and gap[k] < HIDDEN for k in along)


def parted_pairs(image: Image, state: State) -> list[tuple[int, int]]:
    """Return the ordered pairs of solids, as low and as high as each other, that may be the ends of one because another
    hides what is between: each end, seen for itself, may be a ball, a can or a box."""
    low, high = (np.array([of(row) for row in state.rows]) for of in (lowest, highest))
    level = np.maximum(abs(low[:, None] - low), abs(high[:, None] - high)) < FLUSH
    pairs = np.argwhere(level & ~np.eye(len(state), dtype=bool)).tolist()
    if not pairs:
        return []
    _, label, misfit, _ = held_out(image, state, -1)
    label = np.where((image.weight > 0) & ((label >= 0) | (misfit < MISFIT)), label, NOTHING)
    return [(i, j) for i, j in pairs if hidden_between(image.depth, label, i, j)]


def hidden_between(depth: np.ndarray, label: np.ndarray, i: int, j: int) -> bool:
    """Return whether an image (H, W) has something nearer between two solids, and nowhere what is farther.

    label : (H, W) int, the solid that each pixel shows; -1: what is behind them all; NOTHING: that is not known.
    """
    ends = [label == k for k in (i, j)]
    if min(end.sum() for end in ends) < FEWEST:
        return False
    middles = [np.argwhere(end).mean(axis=0) for end in ends]
    way = np.linspace(*middles, int(np.ceil(np.ptp(middles, axis=0).max())) + 1)
    at = tuple(np.rint(way).astype(int).T)
    between, there = label[at], depth[at]
    others = (between >= 0) & (between != i) & (between != j)
    farther = there >= min(np.median(depth[end]) for end in ends)
    return bool(others.any() and not (farther & others).any() and (between != -1).all())


def extents_along(row: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (low (3,), high (3,)) between which a solid's oriented box lies along the axes, and from the centre, of
    another."""
    local = (corners_of(other) - row[10:13]) @ rotation_of(row)
    return local.min(axis=0), local.max(axis=0)


def merge_pair(
    rng: np.random.Generator, task: Task, state: State, i: int, j: int, spread: tuple[bool, bool, bool] | np.ndarray
) -> Changed:
    """Return (state, changed) with solid i grown over solid j, which is taken out.

    spread : (3,) bool, along which axes of i it is to span j; along the one where j reaches furthest beyond it always.
        A cylinder grows along its own axis.
    """
    row = state.rows[i]
    half = 0.5 * row[13:16]
    low, high = extents_along(row, state.rows[j])
    low, high = np.minimum(low, -half), np.maximum(high, half)
    spread = np.array(spread)
    spread[np.argmax(np.maximum(high, -low) - half)] = True
    if int(row[0]) == CYLINDER:
        spread = np.array([False, False, True])
    low, high = np.where(spread, low, -half), np.where(spread, high, half)
    whole = row.copy()
    whole[10:13] += rotation_of(row) @ ((low + high) / 2)
    whole[13:16] = np.maximum(high - low, 0.006)
    new = state.changed(i, row=whole, cube=False).without(j)
    i -= j < i
    polish_solid(rng, task.image, new, i, task.settings)
    return new, {i}


def recut(rng: np.random.Generator, task: Task, state: State, places: Places) -> Changed | None:
    """Cut the union of two aligned boxes that touch in another way."""
    near = touching_pairs(state)
    if not near:
        return None
    i, j = near[int(rng.integers(len(near)))]
    return recut_pair(rng, task, state, i, j, 1.0 if rng.random() < 0.5 else rng.random())


def touching_pairs(state: State) -> list[tuple[int, int]]:
    """Return the ordered pairs of aligned boxes that touch."""
    return [
        (i, j) for i, j in aligned_pairs(state)
        if int(state.rows[i][0]) == BOX and penetration(grown(state.rows[i], TOUCH), state.rows[j]) > 0
    ]  # fmt: skip


def recut_pair(rng: np.random.Generator, task: Task, state: State, i: int, j: int, share: float) -> Changed | None:
    """Return (state, changed) with box j grown into box i, which is cut back, and both polished; None: nothing is left.

    share : see cut_anew.
    """
    pieces = cut_anew(state.rows[i], state.rows[j], share)
    if pieces is None:
        return None
    new = state.changed(i, row=pieces[0], cube=False).changed(j, row=pieces[1], cube=False)
    for k in (i, j) if rng.random() < 0.5 else (j, i):
        polish_solid(rng, task.image, new, k, task.settings)
    return new, {i, j}


def cut_anew(row: np.ndarray, other: np.ndarray, share: float = 1.0) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the two rows when `other`, a box, is turned as the box `row` and grown into it, which is cut back; None:
    nothing is left.

    share : of the row's extent across the faces where they touch. By a share below 1 the cut between them moves; of a
        whole one `other` runs on through it to its far side, as an L is two boxes in two ways, and the row keeps what
        is beside it.
    """
    row, other = row.copy(), other.copy()
    half, turned = 0.5 * row[13:16], rotation_of(row)
    other[1:10] = (turned @ np.round(turned.T @ rotation_of(other))).ravel()
    low, high = extents_along(row, other)
    axis = int(np.argmax(np.maximum(low - half, -half - high)))
    sign = 1.0 if low[axis] + high[axis] > 0 else -1.0
    into = 2.0 * share * half[axis]
    begin, end = -half, half.copy()
    if share < 1.0:
        begin[axis], end[axis] = (begin[axis], end[axis] - into) if sign > 0 else (begin[axis] + into, end[axis])
    else:
        into = half[axis] + (low[axis] if sign > 0 else -high[axis])
        left = [(end[k] - high[k], k, True) for k in range(3) if k != axis]
        left += [(low[k] - begin[k], k, False) for k in range(3) if k != axis]
        _, k, above = max(left)
        begin[k], end[k] = (high[k], end[k]) if above else (begin[k], low[k])
    if (end - begin).min() < THINNEST:
        return None
    row[10:13] += turned @ (0.5 * (begin + end))
    row[13:16] = end - begin
    own = int(np.argmax(np.abs(rotation_of(other).T @ turned[:, axis])))
    other[13 + own] += into
    other[10:13] -= 0.5 * sign * into * turned[:, axis]
    return row, other


def alignment(row: np.ndarray, other: np.ndarray) -> float:
    """Return how nearly the axes of two boxes agree up to their order, the least of the best cosines; for cylinders,
    the cosine between their own axes."""
    cosines = np.abs(rotation_of(row).T @ rotation_of(other))
    return float(cosines[2, 2] if int(row[0]) == CYLINDER else cosines.max(axis=0).min())


def grown(row: np.ndarray, by: float = 0.008) -> np.ndarray:
    """Return the solid grown by this much on all sides."""
    new = row.copy()
    new[13:16] += 2 * by
    return new


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
    new = state.without(*out)
    i -= sum(j < i for j in out)
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
    solid, view = Solid(box, UPRIGHT).on(bottom), held_out(task.image, state, -1)
    return state.add(*run_polish(rng, task.image, state, -1, solid, view, task.settings, step=GUESSED)[0])


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
    solid, _ = run_polish(rng, task.image, new, -1, Solid(whole, UPRIGHT).on(bottom), held_out(task.image, new, -1),
                          task.settings, 2 * MOVED, 0.005, 2.0 * task.settings.temper)  # fmt: skip
    return new.add(*solid), {len(new)}


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
    shorter = with_bottom(state.rows[i], old + rng.uniform(0.1, 0.7) * state.rows[i][15])
    new = state.changed(i, row=shorter, cube=False, bottom=np.nan)
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
    return polished(rng, task, state, i, state[i]._replace(row=row, cube=False))


def polished(
    rng: np.random.Generator, task: Task, state: State, i: int, solid: Solid, step: float = 0.003, heat: float = 2.0
) -> Changed:
    """Return (state with another solid i, polished on its own, {i})."""
    new = state.replaced(i, solid)
    polish_solid(rng, task.image, new, i, task.settings, solid.bottom, step=step, heat=heat)
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
    return polished(rng, task, state, i, state[i]._replace(row=row), 0.006, 6.0)


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
        return polished(rng, task, state, i, state[i]._replace(row=row, form=FREE, bottom=np.nan))
    rotation = rotation_of(row)
    if abs(rotation[2, 2]) < np.cos(np.radians(15.0)):
        return None
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    row[1:10] = [np.cos(yaw), -np.sin(yaw), 0, np.sin(yaw), np.cos(yaw), 0, 0, 0, 1]
    return polished(rng, task, state, i, state[i]._replace(row=row, form=UPRIGHT, bottom=np.nan))


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
        solid, energy = run_polish(rng, image, state, -1, each.on(bottom), view, settings, step=GUESSED)
        tries.append((energy + complexity(solid, settings), len(tries), solid))
    *_, solid = min(tries)
    return state.add(*solid), {len(state)}


MOVES = ((explain_anew, 0.2), (split, 0.14), (merge, 0.08), (recut, 0.08), (put_under, 0.06), (raise_support, 0.06),
         (stand, 0.04), (lift, 0.08), (stretch, 0.08), (appear, 0.06), (shake, 0.08), (tilt, 0.04))  # fmt: skip


def propose(rng: np.random.Generator, task: Task, state: State, places: Places) -> Changed | None:
    """Return (new state, changed indices) of a random move, or None where it does not apply."""
    return MOVES[rng.choice(len(MOVES), p=[w for _, w in MOVES])][0](rng, task, state, places)
