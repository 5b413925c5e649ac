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
from derender.scene.polygon import convex_outline, outline_planes

ENDS = 0.02  # share of a piece's points over its upper edge: flying pixels
FEWEST = 12  # pixels of a piece, and of an opening
# Metres by which upper edges may lie apart (real sensors' faces are off by some 3 mm, either one of them); pixels by
# which the uppermost that is seen of one may lie below it.
EVEN, PIXELS = 0.008, 1.5
NEXT = 3  # pixels between pieces that meet
# Of the lines of sight that cross the upper edges' plane between them, how many go on to what is lower; of the
# directions from its middle, in how many there is an edge.
OPEN, AROUND = 0.7, 0.8
DIRECTIONS = 36


def walls(seen: Observation, state: State, masks: list[np.ndarray]) -> tuple[list[int], list[int], np.ndarray] | None:
    """Return (indices of solids, of masks) that are the walls of one open box, at least two in all, and the pixels
    (H, W) bool of its edges that nothing explains, as of walls seen from above; else None.

    masks : [(H, W) bool] of free-form things.
    """
    _, label, misfit, _ = held_out(seen.image, state, -1)
    piece = np.where((seen.image.weight > 0) & (misfit < LIMIT), label, -1)
    for k, mask in enumerate(masks, start=len(state)):
        piece[mask] = k
    count = len(state) + len(masks)
    pixels = np.bincount(piece[piece >= 0], minlength=count)
    tops = np.full(count, -np.inf)
    for k in np.flatnonzero(pixels >= FEWEST).tolist():
        tops[k] = ends_of(seen.points[piece == k][:, 2], ENDS)[1]
    if not np.isfinite(tops).any():
        return None
    even = np.maximum(EVEN * seen.scale, PIXELS * float(np.median(seen.footprint[piece >= 0])))
    level = np.abs(tops[:, None] - np.where(np.isfinite(tops), tops, np.inf)) < even
    for group in components(level & touching(seen, piece, count)):
        solids, things = [k for k in group if k < len(state)], [k - len(state) for k in group if k >= len(state)]
        bears = any(parent in solids and k not in solids for k, parent in enumerate(state.parents))
        if len(group) == 1 or bears:
            continue
        mask, top = np.isin(piece, group), float(np.median(tops[group]))
        edges = seen.mask & (piece < 0) & (np.abs(seen.points[..., 2] - top) < even)
        body, _ = label_bodies(seen.points, mask | edges, seen.surface.jump)
        edges &= np.isin(body, body[mask])
        if is_open(seen, mask | edges, top, even):
            return solids, things, edges
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


def is_open(seen: Observation, mask: np.ndarray, top: float, even: float) -> bool:
    """Return whether what a mask (H, W) shows goes around an opening at a height, to within `even` metres."""
    origin, height = seen.image.origin, seen.points[..., 2]
    edge = seen.points[mask & (height > top - even)][:, :2]
    corners = convex_outline(np.ascontiguousarray(edge))
    if corners is None or origin[2] <= top:
        return False
    sides = outline_planes(corners)
    share = (origin[2] - top) / np.maximum(origin[2] - height, 1e-9)  # of the way to what is seen, to the plane
    crossing = origin[:2] + share[..., None] * (seen.points[..., :2] - origin[:2])
    within = (crossing @ sides[:, :2].T + sides[:, 2]).max(axis=-1) < -even
    within &= (seen.image.weight > 0) & (height < origin[2])
    if within.sum() < FEWEST or np.mean(height[within] < top - even) < OPEN:
        return False
    way = np.arctan2(*(edge - crossing[within].mean(axis=0)).T[::-1])
    seen_in = np.unique(np.floor((way / (2.0 * np.pi) + 0.5) * DIRECTIONS).astype(int) % DIRECTIONS)
    return len(seen_in) >= AROUND * DIRECTIONS
