"""Hypotheses of solids from whole bodies of points: what shows as one without a jump in depth, and is seen as one.

Patches need some ten pixels on one plane each; a small ball, or a can far off, has none. The body of its points still
tells where it is, how wide and how high.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from derender.compilation.cache import njit
from derender.detection.outline import ends_of
from derender.detection.patches import APART, separation
from derender.detection.search.proposals import (
    BEYOND,
    THINNEST,
    UP,
    cross,
    fit_round,
    lying_circle,
    smallest_rectangle,
    snap,
)
from derender.detection.solids.image import make_row, rotation_of
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import Solid
from derender.scene.pose import rotation_z
from derender.scene.solids import BOX, CYLINDER, SPHERE

FEWEST = 5  # pixels of a body
TIGHT = 0.5  # of the widest step within one body: a wider one is an edge between pieces
SLANTED = 2.0  # widths of a pixel between neighbours of one surface that is seen at a slant
BOARD = 0.01  # metres that a board which leans is thick at first
FLAT = 0.12  # of how far points of one face scatter within its plane, how far off it they are at most: of two, a half


@njit(cache=True, nogil=True)
def label_bodies(points, wanted, jump):
    """Return label (H, W), -1 for none, and the number of bodies: wanted pixels joined without a jump.

    jump : (H, W) metres between the points of neighbours of one body, at most.
    """
    height, width = wanted.shape
    label = np.full((height, width), -1, np.int32)
    stack = np.empty((height * width, 2), np.int32)
    count = 0
    for sj in range(height):
        for si in range(width):
            if not wanted[sj, si] or label[sj, si] >= 0:
                continue
            top = 1
            stack[0, 0], stack[0, 1] = sj, si
            label[sj, si] = count
            while top > 0:
                top -= 1
                j, i = stack[top, 0], stack[top, 1]
                for way in range(8):
                    v, u = j + (way + way // 4) // 3 - 1, i + (way + way // 4) % 3 - 1
                    if v < 0 or v >= height or u < 0 or u >= width or not wanted[v, u] or label[v, u] >= 0:
                        continue
                    if separation(points, j, i, v, u) > jump[j, i] ** 2:
                        continue
                    label[v, u] = count
                    stack[top, 0], stack[top, 1] = v, u
                    top += 1
            count += 1
    return label, count


@njit(cache=True, nogil=True)
def bridged(points, mask, jump, footprint, missing, longest):
    """Return (points, mask, jump) of a surface that goes on over holes in the midst of it, along rows or columns.

    A hole is a run of missing pixels, `longest` metres at most. Its sides must be as near as on a surface that slants
    by SLANTED: the shadow beside a silhouette, which has no returns either, is as wide as the step is deep times the
    sensor's baseline over the distance, a tenth or so.
    """
    height, width = mask.shape
    filled, whole, jumps = points.copy(), mask.copy(), jump.copy()
    shortest = np.full((height, width), height + width)
    for way in range(2):
        for line in range(height if way == 0 else width):
            last = -1
            for place in range(width if way == 0 else height):
                j, i = (line, place) if way == 0 else (place, line)
                if missing[j, i]:
                    continue
                b, a = (j, last) if way == 0 else (last, i)
                n, first = place - last - 1, last < 0
                last = place
                if first or n == 0 or not mask[j, i] or not mask[b, a]:
                    continue
                across = 0.5 * n * (footprint[j, i] + footprint[b, a])
                most = 0.5 * TIGHT * (jump[j, i] + jump[b, a]) + SLANTED * across
                if across > longest or separation(points, b, a, j, i) > most * most:
                    continue
                for k in range(1, n + 1):
                    v, u = (j, i - k) if way == 0 else (j - k, i)
                    if n >= shortest[v, u]:
                        continue
                    share = k / (n + 1.0)
                    shortest[v, u], whole[v, u] = n, True
                    jumps[v, u] = (1.0 - share) * jump[j, i] + share * jump[b, a]
                    for axis in range(3):
                        filled[v, u, axis] = (1.0 - share) * points[j, i, axis] + share * points[b, a, axis]
    return filled, whole, jumps


def find_bodies(points: np.ndarray, wanted: np.ndarray, footprint: np.ndarray) -> list[np.ndarray]:
    """Return the points (K, 3) of each body of FEWEST pixels or more.

    points : (H, W, 3) float64, floor frame. wanted : (H, W) bool. footprint : (H, W) metres across a pixel.
    """
    label, count = label_bodies(points, wanted, APART * footprint)
    pixels = np.bincount(label[label >= 0], minlength=count)  # noise is many bodies of a pixel each
    return [points[label == k] for k in np.flatnonzero(pixels >= FEWEST)]


def box_about(points: np.ndarray, yaw: float, bottom: float) -> np.ndarray:
    """Return the row of the upright box, turned so far, that holds points (N, 3) and stands on a height."""
    top = max(np.quantile(points[:, 2], 0.95), bottom + THINNEST)
    upright = rotation_z(yaw)[:3, :3]
    along = points @ upright
    low, high = along.min(axis=0), along.max(axis=0)
    low[2], high[2] = bottom, top
    return make_row(BOX, upright, upright @ (0.5 * (low + high)), np.maximum(high - low, THINNEST))


def body_hypotheses(
    points: np.ndarray, origin: np.ndarray, shapes: tuple[str, ...], bottom: float = 0.0
) -> Iterator[Any]:
    """Yield a solid of each shape allowed that shows these points (N, 3) and stands on a height.

    origin : (3,) the camera's centre, floor frame.
    """
    box = box_about(points, smallest_rectangle(points[:, :2]), bottom)
    turn, middle, wide, height = rotation_of(box)[:2, :2], box[10:13], box[13:15], box[15]
    if "box" in shapes or "cube" in shapes:
        yield Solid(box, UPRIGHT)
        yield from leaning_boards(points, origin, bottom)
    # a round solid shows its near half: as wide as it seems from the camera, and as deep
    away = middle[:2] - origin[:2]
    away = away / max(np.linalg.norm(away), 1e-9)
    across = points[:, :2] @ np.array([-away[1], away[0]])
    diameter = max(np.ptp(across), THINNEST)
    near = np.quantile(points[:, :2] @ away, 0.05) + 0.5 * diameter
    centre = near * away + 0.5 * (across.min() + across.max()) * np.array([-away[1], away[0]])
    if "cylinder" in shapes:
        yield Solid(make_row(CYLINDER, np.eye(3), [*centre, middle[2]], [diameter, diameter, height]), UPRIGHT)
        if bottom == 0.0:
            yield lying_cylinder(points, turn, wide)
    if "sphere" in shapes:
        radius = 0.5 * diameter
        yield Solid(make_row(SPHERE, np.eye(3), [*centre, bottom + radius], [diameter] * 3), FREE)
        middle, radius = fit_round(points)
        if 0.3 * diameter < radius < diameter:
            yield Solid(make_row(SPHERE, np.eye(3), middle, [2.0 * radius] * 3), FREE)


def leaning_boards(points: np.ndarray, origin: np.ndarray, bottom: float) -> Iterator[Solid]:
    """Yield the thin box of which points (N, 3) show a face that is neither level nor upright: as far as they reach,
    and down to a height, where something hides its foot.

    Seen at a grazing angle it has no patch, and of one patch boxes are guessed as deep as it is wide.
    """
    if len(points) < FEWEST:  # of fewer, half lie in many planes
        return
    off = np.zeros(len(points))
    for _ in range(2):  # the second time without those that are farthest off: pixels on its edges
        near = points[off <= np.median(off)]
        middle = near.mean(axis=0)
        spread, axes = np.linalg.svd(near - middle, full_matrices=False)[1:]
        off = np.abs((points - middle) @ axes[2])
    normal = axes[2] if axes[2] @ (origin - middle) > 0.0 else -axes[2]
    scattered = np.median(off) > FLAT * spread[1] / np.sqrt(len(near))
    if scattered or snap(normal)[1] != "tilted" or snap(-normal)[1] == "top":  # the last: an underside, level
        return
    across = cross(UP, normal) / np.hypot(normal[0], normal[1])
    level = np.column_stack([across, cross(normal, across), normal])  # its second axis is the steepest way up
    angle = smallest_rectangle(points @ level[:, :2])
    rotation = level @ rotation_z(angle if angle < 0.25 * np.pi else angle - 0.5 * np.pi)[:3, :3]
    low, high = ends_of(points @ rotation, BEYOND)
    high[2] = middle @ normal
    low[2] = high[2] - BOARD
    foot = bottom + BOARD * max(normal[2], 0.0)  # height at which the face seen ends: the board is thick below it
    further = np.array([0.0, (points[:, 2].min() - foot) / rotation[2, 1], 0.0])
    for begin in (low, low - further) if further[1] > BOARD else (low,):
        row = make_row(BOX, rotation, rotation @ (0.5 * (begin + high)), np.maximum(high - begin, THINNEST))
        yield Solid(row, FREE)


def lying_cylinder(points: np.ndarray, turn: np.ndarray, wide: np.ndarray) -> Solid:
    """Return the cylinder on the floor along the longer side of the rectangle about points (N, 3)."""
    longer = int(np.argmax(wide))
    axis = np.array([*turn[:, longer], 0.0])
    across = cross(UP, axis)
    centre, radius = lying_circle(points @ np.column_stack([across, UP]), np.column_stack([across, UP]))
    along = points @ axis
    middle = centre[0] * across + centre[1] * UP + 0.5 * (along.min() + along.max()) * axis
    rotation = np.column_stack([across, UP, axis])
    return Solid(make_row(CYLINDER, rotation, middle, [2 * radius, 2 * radius, max(np.ptp(along), THINNEST)]), FREE)
