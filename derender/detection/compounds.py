"""What moves as one: solids and free-form things that are parts of one object become one free-form thing.

A mallet's handle, a bottle's neck, a mug's handle, a carton's gable: each shows as a solid or a thing of its own, which
could not be where it is, or hardly ever is, unless it were a part of what it touches.
"""

from collections.abc import Sequence
from itertools import permutations
from typing import Any

import numpy as np

from derender.detection.background import sides_show
from derender.detection.freestanding import NEARER, outline_shares
from derender.detection.openings import walls
from derender.detection.outline import ends_of
from derender.detection.patches import SeenSurface
from derender.detection.search.bodies import TIGHT, label_bodies
from derender.detection.search.moves import alignment, extents_along
from derender.detection.search.observation import Observation
from derender.detection.search.proposals import smallest_rectangle
from derender.detection.solids.image import Image, rotation_of
from derender.detection.solids.interpenetration import gap_between, highest, lowest, penetration
from derender.detection.solids.misfit import AS_SEEN, LIMIT
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import FLOOR, State, held_out
from derender.detection.solids.support import flat_top, share_over, shares_of_load
from derender.detection.things import BAD, BENEATH, ENDS, FEWEST, LEAST_HEIGHT, support_of
from derender.scene.polygon import beyond_edges, convex_outline
from derender.scene.pose import rotation_z
from derender.scene.solids import BOX, CYLINDER, SPHERE

# Of its height, and in metres: a box so thin, with nothing to lean on, falls at a tilt of eleven degrees, and there are
# few such things in a household.
SHEET, THIN = 0.2, 0.015
SUNK = 0.15  # of a ball's diameter, or a tilted box's least side, that lies in others, from which on it is none
HELD = 0.01  # metres between solids that are parts of one
# Of the lower one's diameter, and of its radius: a cylinder on another that is so narrow and so near its axis is the
# neck of a bottle.
NECK, COAXIAL = 0.6, 0.5
PART = 0.05  # of a solid's pixels, in how many a part of it shows at least: sensors leave less along a silhouette
# Share of a solid's pixels that show its inside, from which on it is hollow. (Of 213 solids on real frames twelve had
# .13 and more, all but one of cups, mugs and rolls; the others .11 at most.)
HOLLOW = 0.12
HANGS = 0.15  # of its height, how far over what it could stand on the lowest point of a part is seen
# Twice the sine of half the angle by which a surface turns at a convex edge at least: less is the noise of normals,
# or a silhouette that a smoothed image lets go over into the flat behind it.
TURN = 0.1
NEXT, GOES_ON = 3, 0.2  # pixels across an edge; share of a piece's outline across which it goes on
HIDDEN = 0.1  # share of a thing's outline beyond which something nearer may hide its foot, a quarter of a cube's
HANDLE = 0.25  # share of something's pixels that its handle or its head shows in at most
SLENDER = 0.25  # of its height, how wide at most a thing is that could hardly stand on its end
JOINT = 0.04  # share of a thing's outline along which a solid goes on that it is a part of
# Share of what a thing bears that lies over it, at least; metres between the two that are not seen.
OVER, PARTED = 0.75, 0.1
# Of a free-form thing's pixels, and of its own outline: what shows so little beside it and meets it along so much is an
# arm or a foot of it. What stands before something so much larger and touches it all along is rare.
LITTLE, ALONG = 0.1, 1.0 / 3.0
# Upward part of a surface's normal: less is a side, more a top, and on what lies between nothing stays that hangs over
# all else; share of where it is met that is such a slope, as of a body below its head.
STEEP, LEVEL, MOSTLY = 0.26, 0.87, 0.4
# Metres by which sides that lie in one plane are seen apart: real sensors' faces are off by some 3 mm.
FLUSH = 0.004
# Times as far apart a third one may be, which may be hidden; cosine between sides that are parallel.
UNSEEN, PARALLEL = 2.0, np.cos(np.radians(3.0))


def compounds(seen: Observation, state: State, masks: list[np.ndarray]) -> tuple[State, list[Any]]:
    """Return (State, [mask]) in which solids that are parts of one, or of no such shape, are things.

    A solid that nothing bears, and that touches a round side on which it could not stand, moves with that as one, as
    a mallet does. A tilted box that its contacts cannot hold is the slope of something else, as of a wedge. What shows
    its inside is hollow. What hangs in the air is a handle of what it goes on from, and what is over it beyond a convex
    edge, as a gable is.

    masks : [(H, W) bool] of free-form things.
    """
    masks, surface = list(masks), seen.surface
    while (
        parts := held_by_another(state)
        or falling(state)
        or neck(state, seen.image)
        or hollow(seen, state)
        or arms(state, FLUSH * seen.scale)
    ):
        state, found = joined(seen, state, parts)
        masks += found
    if not masks and not len(state):
        return state, masks
    normal = surface.normals(surface.good)
    for k in range(len(masks)):
        if (part := hangs_on(seen, state, masks[k])) is not None or (
            part := slope_of(seen, state, masks[k], normal)
        ) is not None:
            state, found = joined(seen, state, (part,), masks[k])
            masks[k] = found[0]
    while (pair := part_of_another(seen, state, masks, normal)) is not None:
        parts = tuple(k for k in pair if k < len(state))
        pieces = [masks[k - len(state)] for k in pair if k >= len(state)]
        masks = [each for k, each in enumerate(masks, start=len(state)) if k not in pair]
        state, found = joined(seen, state, parts, np.any(pieces, axis=0) if pieces else None)
        masks += found
    return state, masks


def open_boxes(seen: Observation, state: State, masks: list[np.ndarray]) -> tuple[State, list[np.ndarray]]:
    """Return (State, [mask]) in which walls around an opening are one free-form thing, see `openings.py`."""
    while (found := walls(seen, state, masks)) is not None:
        solids, things, edges = found
        pieces = [edges, *(masks[k] for k in things)]
        masks = [mask for k, mask in enumerate(masks) if k not in things]
        state, whole = joined(seen, state, solids, np.any(pieces, axis=0))
        masks += whole
    return state, masks


def with_borne(seen: Observation, masks: list[np.ndarray]) -> tuple[Observation, list[np.ndarray]]:
    """Return (Observation, [mask]) in which background that lies over a free-form thing, and is borne by it, is its.

    What the image's border cuts may go on as a wall or an arm does, and hides where it is held; but a chair's seat is
    all over its foot.

    masks : [(H, W) bool] of the things.
    """
    behind, points = seen.behind.copy(), seen.points
    body, count = label_bodies(points, behind, seen.surface.jump)
    parted = PARTED * seen.floor_scale
    for k in np.flatnonzero(np.bincount(body[behind], minlength=count) >= FEWEST):
        part = body == k
        low = ends_of(points[part][:, 2:], ENDS)[0]
        for n, mask in enumerate(masks):
            corners = convex_outline(np.ascontiguousarray(points[mask][:, :2]))
            if corners is None or abs(low - ends_of(points[mask][:, 2:], ENDS)[1]) > parted:
                continue
            if np.mean(beyond_edges(points[part][:, :2], corners) < 0.0) > OVER:
                masks, behind = [*masks[:n], mask | part, *masks[n + 1 :]], behind & ~part
                break
    return seen._replace(behind=behind), masks


def part_of_another(
    seen: Observation, state: State, masks: list[np.ndarray], normal: np.ndarray
) -> tuple[int, int] | None:
    """Return what is a part of something else, and of what; None where nothing is.

    That hangs in the air and goes on without an edge, as a torso does into legs, or is a small free-form thing on a
    larger one, as a head on its neck, or one on another's slope, where nothing stays; or is little beside one along
    which it lies. Solids are told by their index, things by that of their masks after all solids.
    """
    _, label, misfit, _ = held_out(seen.image, state, -1)
    piece = np.where((seen.image.weight > 0) & (misfit < LIMIT), label, -1)
    for k, mask in enumerate(masks, start=len(state)):
        piece[mask] = k
    count = len(state) + len(masks)
    for k in range(count):
        mask = piece == k
        if mask.sum() < FEWEST or k in state.parents:
            continue
        touched, turned, sloping = meets(seen.surface, piece, k, count, normal)
        touched[[j for j in state.parents if j != FLOOR]] = 0.0
        outline = sum((mask & ~np.roll(mask, way, axis)).sum() for axis in (0, 1) for way in (1, -1))
        other = int(np.argmax(touched))
        little = other >= len(state) and mask.sum() < LITTLE * (piece == other).sum()
        if little and touched[other] > ALONG * outline:
            return k, other
        if k < len(state) and shares_of_load(state.rows, k, HELD):
            continue
        much = other >= len(state) or mask.sum() >= PART * (piece == other).sum()
        small = mask.sum() < HANDLE * (piece == other).sum()
        low = np.quantile(seen.points[mask, 2], ENDS)
        domed = sloping[other] > MOSTLY * touched[other] and low > np.median(seen.points[piece == other, 2])
        borne = k >= len(state) <= other and (small or domed)  # a head, by its neck
        onward = much and touched[other] > JOINT * outline and (borne or turned[other] > -TURN * touched[other])
        told = small or sides_show(seen.points[mask] - seen.image.origin)
        if onward and told and hangs(seen, state.without(k) if k < len(state) else state, mask):
            return k, other
    return None


def meets(
    surface: SeenSurface, piece: np.ndarray, k: int, count: int, normal: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (N,) how many pixels of a piece's outline have each other piece NEXT to them without a jump between, the
    sum of how the surface turns there, positive where convex, see TURN, and how many of those pixels show a slope.

    piece : (H, W) int, -1 for none. k : the piece's number; count : of all. The rest as of `goes_on`.
    """
    touched, turned, sloping = np.zeros((3, count))
    mask, points = piece == k, surface.points
    for axis, way in ((0, 1), (0, -1), (1, 1), (1, -1)):
        apart = np.roll(points, NEXT * way, axis) - points
        distance = np.linalg.norm(apart, axis=2)
        other = np.roll(piece, NEXT * way, axis)
        at = mask & ~np.roll(mask, way, axis) & (distance < NEXT * TIGHT * surface.jump) & (other >= 0) & (other != k)
        turn = ((np.roll(normal, NEXT * way, axis) - normal) * apart).sum(axis=2)[at] / distance[at]
        touched += np.bincount(other[at], minlength=count)
        turned += np.bincount(other[at], turn, count)
        rises = np.roll(normal, NEXT * way, axis)[at][:, 2]
        sloping += np.bincount(other[at], (rises > STEEP) & (rises < LEVEL), count)
    return touched, turned, sloping


def joined(seen: Observation, state: State, parts: Any, piece: np.ndarray | None = None) -> Any:
    """Return (State without some solids, [mask]) with what they show as one free-form thing, if it is seen.

    What is seen within a solid is the inside of a hollow one, as of a mug, and what goes on from it before it is its
    handle; so is what little goes on beyond a ball, as the rim of a bowl does that is as round.

    parts : indices of the solids. piece : (H, W) bool, pixels that are the thing's already.
    """
    image = seen.image
    depth, label, misfit, _ = held_out(image, state, -1)
    inside = np.any([seen_within(seen, state.rows[k]) for k in parts], axis=0)
    own = np.isin(label, parts) & (image.weight > 0)
    whole = own & ((misfit < LIMIT) | inside)
    body, _ = label_bodies(seen.points, whole | (own & seen.mask), seen.surface.jump)
    whole = np.isin(body, body[whole])
    balls = any(int(state.rows[k][0]) == SPHERE for k in parts)
    beyond = seen.mask & ~whole & (misfit > BAD) & (image.depth < depth) & balls
    body, _ = label_bodies(seen.points, whole | beyond, seen.surface.jump)
    beyond &= np.isin(body, body[whole])
    body, count = label_bodies(seen.points, beyond, seen.surface.jump)
    pixels = np.bincount(body[beyond], minlength=count)
    whole |= beyond & np.isin(body, np.flatnonzero(pixels < HANDLE * whole.sum()))
    if piece is not None:
        whole |= piece
    state = state.without(*parts)
    if whole.sum() < FEWEST:
        return state, []
    image.floor[whole] = image.depth[whole] + 0.5 * AS_SEEN
    return state, [whole]


def seen_within(seen: Observation, row: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: the pixels over the floor that show what lies within a solid's oriented box."""
    return seen.mask & (np.abs((seen.points - row[10:13]) @ rotation_of(row)) < 0.5 * row[13:16]).all(axis=-1)


def hollow(seen: Observation, state: State) -> tuple[int, ...] | None:
    """Return (i,), a solid of which the inside is seen, as of a cup; else None."""
    depth, label, misfit, _ = held_out(seen.image, state, -1)
    deep = (misfit > BAD) & (seen.image.depth - depth > HELD)  # beyond noise, and what its faces are off
    for i in set(range(len(state))) - set(state.parents):
        shown = (label == i) & (seen.image.weight > 0)
        if (shown & deep & seen_within(seen, state.rows[i])).sum() > HOLLOW * shown.sum():
            return (i,)
    return None


def arms(state: State, flush: float) -> tuple[int, int] | None:
    """Return (i, j), two upright boxes that bear nothing else and are the arms of an L, see `an_l`; else None."""
    boxes = [k for k, row in enumerate(state.rows) if int(row[0]) == BOX and state.forms[k] == UPRIGHT]
    for i, j in permutations(boxes, 2):
        upon, beside = state.parents[i] == j, i < j and state.parents[i] == state.parents[j]
        borne = any(k != i and parent in (i, j) for k, parent in enumerate(state.parents))
        if (upon or beside) and not borne and an_l(state.rows[j], state.rows[i], upon, flush):
            return i, j
    return None


def an_l(row: np.ndarray, other: np.ndarray, upon: bool, flush: float) -> bool:
    """Return whether two upright boxes, of which one stands `upon` the first or beside it, rather are an L: they touch,
    and meet on three sides, or on both of one level axis, to within `flush`, which it would be a chance if two did. Two
    of one kind are put so on purpose."""
    if alignment(row, other) < PARALLEL or abs(gap_between(row, other)) > HELD:
        return False
    low, high = extents_along(row, other)
    off = np.abs([low + 0.5 * row[13:16], high - 0.5 * row[13:16]])[:, :2]
    even = np.sort(off, axis=None)[1:3] if upon else off.max(axis=0).min()
    alike = np.ptp([np.sort(each[13:16]) for each in (row, other)], axis=0).max() < flush
    return bool((even < np.multiply(flush, (1.0, UNSEEN) if upon else 1.0)).all()) and not alike


def alone_on(state: State, i: int) -> tuple[int, ...]:
    """Return (j,), the solid on which a solid stands alone, that bears nothing itself; () where there is none."""
    j = state.parents[i]
    return () if j == FLOOR or i in state.parents or state.parents.count(j) > 1 else (j,)


def falling(state: State) -> tuple[int, ...] | None:
    """Return (i,), a solid with nothing on it that could not be as it is; else None.

    A box on an edge or as a thin sheet: whatever shows so much of one face alone ends in another shape behind it. A
    ball or a tilted box that is sunk in what it stands on: it is a dome, or a slope.
    """
    for i, row in enumerate(state.rows):
        others = [k for k in range(len(state)) if k != i]
        if i in state.parents:
            continue
        if int(row[0]) == SPHERE or (int(row[0]) == BOX and state.forms[i] == FREE):
            depths = [-lowest(row), *(penetration(row, state.rows[k]) for k in others)]
            if max(depths) > max(SUNK * row[13:16].min(), HELD):
                return (i,)
        if int(row[0]) != BOX:
            continue
        if state.forms[i] == FREE:
            if not shares_of_load(state.rows, i, HELD):
                return (i,)
        elif row[13:15].min() < min(SHEET * row[15], THIN) and all(
            gap_between(row, state.rows[k]) > HELD for k in others
        ):
            return (i,)
    return None


def held_by_another(state: State) -> tuple[int, int] | None:
    """Return (i, j), a solid over nothing and the one on whose round side it is held, neither with others on it: of
    several that which bears most of it, for what stands beside a mallet's handle is touched by it, too."""
    for i, row in enumerate(state.rows):
        if not np.isnan(state.bottoms[i]) or lowest(row) < LEAST_HEIGHT:
            continue
        others = {*state.parents[:i], *state.parents[i + 1 :]}
        by = [j for j, other in enumerate(state.rows) if j != i and not {i, j} & others and not flat_top(other)
              and (state.parents[i] == j or gap_between(row, other) < HELD)]  # fmt: skip
        if by:
            shares = shares_of_load(state.rows, i, HELD)
            return i, max(by, key=lambda j: shares.get(j, 0.0))
    return None


def neck(state: State, image: Image | None = None) -> tuple[int, int] | None:
    """Return (i, j), a solid, nothing on it, and the upright one on which alone it stands, whose part it is: a narrow
    cylinder about the axis of a wide one, and lower than it, or what would fall off, as a cabinet from one of its feet.

    image : where it is given, what the other may reach under unseen does not fall off it, see `reaches_under`.
    """
    for i, row in enumerate(state.rows):
        for j in alone_on(state, i):
            other = state.rows[j]
            falls = not shares_of_load(state.rows, i, HELD)
            if (falls and (image is None or not reaches_under(image, state, j, i))) or (
                int(row[0]) == int(other[0]) == CYLINDER
                and flat_top(other)
                and row[13] < NECK * other[13]
                and row[15] < other[15]
                and np.hypot(*(row[10:12] - other[10:12])) < 0.5 * COAXIAL * other[13]
            ):
                return i, j
    return None


def reaches_under(image: Image, state: State, j: int, i: int) -> bool:
    """Return whether upright box `j` may reach under the middle of solid `i`, as far as can be seen.

    A box is as deep as it shows, and the one on it hides how deep it is: 2 cm more made a stack of what fell. But a
    sheet below something round is the front of that: a box of which no more shows would be flush with it by chance.
    """
    row, other = state.rows[j], state.rows[i]
    sheet = row[13:15].min() < SHEET * row[15] and int(other[0]) != BOX
    if int(row[0]) != BOX or state.forms[j] != UPRIGHT or sheet:
        return False
    axes = rotation_of(row)[:, :2]
    middle, half = (other[10:13] - row[10:13]) @ axes, 0.5 * row[13:15]
    low, high = np.minimum(-half, middle - HELD), np.maximum(half, middle + HELD)
    longer = row.copy()
    longer[10:13] += axes @ (0.5 * (low + high))
    longer[13:15] = high - low
    before, after = (held_out(image, each, -1)[1] == j for each in (state, state.changed(j, row=longer)))
    return int((after & ~before & (image.weight > 0)).sum()) < PART * before.sum()


def slope_of(seen: Observation, state: State, mask: np.ndarray, normal: np.ndarray) -> int | None:
    """Return the solid, nothing on it, over which a thing goes on as a gable or a bottle's shoulder; else None.

    mask : (H, W) bool, the thing's pixels. normal : (H, W, 3) of the surface.
    """
    shows = (held_out(seen.image, state, -1)[1] >= 0) & (seen.image.weight > 0) & ~mask
    if not goes_on(seen.surface, mask, shows, normal, flush=True):
        return None
    part = goes_on_from(seen, state, mask)
    return part if part is not None and share_over(seen.points[mask], state.rows[part]) > BENEATH else None


def hangs_on(seen: Observation, state: State, mask: np.ndarray) -> int | None:
    """Return the solid, nothing on it, of which a thing, smaller or a rod on it, is a part that hangs in the air.

    mask : (H, W) bool, the thing's pixels.
    """
    if not hangs(seen, state, mask):
        return None
    points = seen.points[mask]
    ends = ends_of(points @ rotation_z(smallest_rectangle(points[:, :2]))[:3, :3], ENDS)
    low, size = ends[0, 2], np.ptp(ends, axis=0)
    slack, rod = HANGS * size[2], size[:2].min() < SLENDER * size[2]
    below = [k for k, row in enumerate(state.rows) if rod and abs(highest(row) - low) < slack]
    part = goes_on_from(seen, state, mask, below)
    if part is None or part in below:
        return part
    return part if mask.sum() < HANDLE * (held_out(seen.image, state, -1)[1] == part).sum() else None


def hangs(seen: Observation, state: State, mask: np.ndarray) -> bool:
    """Return whether what a mask (H, W) shows is seen to end over what it could stand on, with nothing before it."""
    points = seen.points[mask]
    low, high = ends_of(points[:, 2:], ENDS)[:, 0]
    beyond = outline_shares(seen.surface, np.where(mask, 0, -1).astype(np.int32), 1)[0]
    return low - support_of(points, state)[1] >= HANGS * (high - low) and beyond[NEARER] <= HIDDEN


def goes_on(surface: SeenSurface, mask: np.ndarray, shows: np.ndarray, normal: np.ndarray, flush: bool = False) -> bool:
    """Return whether a piece is a part of a solid, from which it goes on across a convex edge as a gable does.

    mask, shows : (H, W) bool, pixels of the piece, and those that solids explain. normal : (H, W, 3) of the surface.
    flush : whether it may go on straight, too, as a bottle's shoulder does, but where half as much of its outline has a
        concave edge: where what stands there has its foot.
    """
    outline, onward, foot, points = 0, 0, 0, surface.points
    for axis, way in ((0, 1), (0, -1), (1, 1), (1, -1)):
        edge = mask & ~np.roll(mask, way, axis)
        apart = np.roll(points, NEXT * way, axis) - points
        there, here = ((n * apart).sum(axis=2) for n in (np.roll(normal, NEXT * way, axis), normal))
        distance = np.linalg.norm(apart, axis=2)
        onto = edge & np.roll(shows, NEXT * way, axis) & (distance < NEXT * surface.jump)
        least = TURN * distance
        goes = there - here > least
        if flush:
            goes |= (here < least) & (there > -least) & normal.any(axis=2)
            foot += (onto & (there - here < -least)).sum()
        outline += edge.sum()
        onward += (onto & goes).sum()
    return onward > max(GOES_ON * outline, 2 * foot)


def goes_on_from(seen: Observation, state: State, mask: np.ndarray, first: Sequence[int] = ()) -> int | None:
    """Return the solid, nothing on it, that goes on along most of a thing's outline, of some first; None: none does, or
    the thing shows too little beside it to be more than a fault of the image. An L's foot, a handle.
    """
    label = held_out(seen.image, state, -1)[1]
    jump = TIGHT * seen.surface.jump
    outline, touched = 0, np.zeros(max(len(state), 1), int)
    for axis, way in ((0, 1), (0, -1), (1, 1), (1, -1)):
        edge = mask & ~np.roll(mask, way, axis)
        near = np.linalg.norm(np.roll(seen.points, way, axis) - seen.points, axis=2) < jump
        outline += int(edge.sum())
        solid = np.where(near, np.roll(label, way, axis), -1)[edge]
        touched += np.bincount(solid[solid >= 0], minlength=len(touched))
    below = [k for k in first if touched[k]]
    if below:
        touched = np.where(np.isin(np.arange(len(touched)), below), touched, 0)
    k = int(np.argmax(touched))
    much = mask.sum() >= PART * (label == k).sum()
    return k if much and touched[k] > JOINT * outline and k not in state.parents else None
