"""Walls around an opening: trays, totes, bins and open cartons show as a board for each wall, which are one object.

Their upper edges lie in one level plane and run around a place through which one sees what is lower. Boards that stand
on edge so are nobody's stack.
"""

import numpy as np

from derender.detection.outline import ends_of
from derender.detection.patches import components
from derender.detection.search.bodies import label_bodies
from derender.detection.search.observation import Observation
from derender.detection.solids.misfit import LIMIT
from derender.detection.solids.state import State, held_out
from derender.results.fit import median
from derender.scene.polygon import beyond_edges, convex_outline

ENDS = 0.02  # share of a piece's points over its upper edge: flying pixels
FEWEST = 12  # pixels of a piece, and of an opening
# Metres by which upper edges may lie apart (real sensors' faces are off by some 3 mm, either one of them); pixels by
# which the uppermost that is seen of one may lie below it.
EVEN, PIXELS = 0.008, 1.5
NEXT = 3  # pixels between pieces that meet
# Of the lines of sight that cross the upper edges' plane between them, how many go on to what is lower; of the
# directions from its middle, in how many there is an edge.
OPEN, AROUND = 0.7, 0.8
# Share of a piece's pixels that are seen through an opening and no higher than the lowest there, from which on it is
# its bottom; standard deviations of its noise by which a bottom that no piece shows is over the floor.
LIES, LOW = 0.5, 2.0
DIRECTIONS = 36


def walls(seen: Observation, state: State, masks: list[np.ndarray]) -> tuple[list[int], list[int], np.ndarray] | None:
    """Return (indices of solids, of masks) that are the walls of one open box and its bottom, and the pixels (H, W)
    bool of its edges and its bottom that nothing explains, as of walls seen from above; else None.

    masks : [(H, W) bool] of free-form things.
    """
    _, label, misfit, _ = held_out(seen.image, state, -1)
    height = seen.points[..., 2]
    piece = np.where((seen.image.weight > 0) & (misfit < LIMIT), label, -1)
    for k, mask in enumerate(masks, start=len(state)):
        piece[mask] = k
    count = len(state) + len(masks)
    pixels = np.bincount(piece[piece >= 0], minlength=count)
    tops = np.full(count, -np.inf)
    for k in np.flatnonzero(pixels >= FEWEST).tolist():
        tops[k] = ends_of(height[piece == k], ENDS)[1]
    if not np.isfinite(tops).any():
        return None
    even = np.maximum(EVEN * seen.scale, PIXELS * median(seen.footprint[piece >= 0]))
    level = np.abs(tops[:, None] - np.where(np.isfinite(tops), tops, np.inf)) < even
    for group in components(level & touching(seen, piece, count)):
        bears = any(parent in group and k not in group for k, parent in enumerate(state.parents))
        if bears or not np.isfinite(tops[group]).all():
            continue
        mask, top = np.isin(piece, group), float(np.median(tops[group]))
        edges = seen.mask & (piece < 0) & (np.abs(height - top) < even)
        body, _ = label_bodies(seen.points, mask | edges, seen.surface.jump)
        edges &= np.isin(body, body[mask])
        beyond = opening(seen, mask | edges, top, even)
        if beyond is None:
            continue
        within = beyond < -even
        bottom = within & (height < ends_of(seen.points[within], ENDS)[0, 2] + even)
        lies = np.bincount(piece[bottom & (piece >= 0)], minlength=count) > LIES * pixels
        parts = np.union1d(group, np.flatnonzero(lies))
        bottom &= piece < 0
        if bottom.any() and np.median(height[bottom]) < LOW * np.median(seen.sigma[bottom]):
            bottom[:] = False  # it is the floor
        bottom |= (beyond < 0.0) & (piece < 0) & seen.mask  # of its walls, too
        if len(parts) > 1 or bottom.any():
            solids, things = parts[parts < len(state)], parts[parts >= len(state)] - len(state)
            return solids.tolist(), things.tolist(), edges | bottom
    return None


def touching(seen: Observation, piece: np.ndarray, count: int) -> np.ndarray:
    """Return (N, N) bool: which pieces have pixels NEXT to each other with no jump in depth between, in which what both
    show in a corner may lie twice as far apart as on one surface. piece : (H, W) int, -1: none. count : of all."""
    meet = np.zeros((count, count), bool)
    for axis in (0, 1):
        other, apart = np.roll(piece, NEXT, axis), np.roll(seen.points, NEXT, axis) - seen.points
        near = np.linalg.norm(apart, axis=2) < 2.0 * NEXT * seen.surface.jump
        at = near & (piece >= 0) & (other >= 0) & (piece != other)
        meet[piece[at], other[at]] = meet[other[at], piece[at]] = True
    return meet


def opening(seen: Observation, mask: np.ndarray, top: float, even: float) -> np.ndarray | None:
    """Return (H, W) metres by which lines of sight pass beyond the outline of the opening that what a mask (H, W) shows
    goes around at a height, to within `even` metres: less than 0 through it; None where it has none."""
    origin, height = seen.image.origin, seen.points[..., 2]
    edge = seen.points[mask & (height > top - even)][:, :2]
    corners = convex_outline(np.ascontiguousarray(edge))
    if corners is None or origin[2] <= top:
        return None
    good = (seen.image.weight > 0) & (height < origin[2])
    share = (origin[2] - top) / np.maximum(origin[2] - height[good], 1e-9)  # of the way to what is seen, to the plane
    crossing = origin[:2] + share[:, None] * (seen.points[good][:, :2] - origin[:2])
    beyond = np.full(height.shape, np.inf)
    beyond[good] = beyond_edges(crossing, corners)
    within = beyond < -even
    if within.sum() < FEWEST or np.mean(height[within] < top - even) < OPEN:
        return None
    way = np.arctan2(*(edge - crossing[within[good]].mean(axis=0)).T[::-1])
    seen_in = np.unique(np.floor((way / (2.0 * np.pi) + 0.5) * DIRECTIONS).astype(int) % DIRECTIONS)
    return beyond if len(seen_in) >= AROUND * DIRECTIONS else None
