"""Planes at other heights than the main one: a second table, a shelf's boards, the steps of a stair.

They are looked for among what the main plane takes as background: level, with a good part of the image. What stands on
one rises from it as from any floor. Lengths are those of a main plane that is seen from `USUAL` metres.
"""

import numpy as np

from derender.camera.intrinsics import LEVEL
from derender.detection.floor import ROOM
from derender.detection.outline import ends_of
from derender.detection.search.bodies import TIGHT, label_bodies
from derender.detection.search.observation import CORRELATED, Observation
from derender.detection.search.proposals import smallest_rectangle

LEAST_SHARE = 0.03  # of the pixels with a depth that show a plane: less carries nothing that can be told
LEAST_AREA = 0.04  # square metres of it that are seen: a tray of 20 by 20 cm
NEAR, NOISES = 0.01, 4.0  # metres, and standard deviations of the noise, off a plane that still lie on it
# Share of its points beyond each end of the rectangle that is there: flying pixels; metres by which that reaches beyond
# the last pixels that show it.
ENDS, RIM = 0.002, 0.01
MOST = 4  # planes
STEP = 0.03  # metres over or under the main plane, at least: less may be its own bend, or a mat on it


def levels_of(seen: Observation) -> list[tuple[np.ndarray, float]]:
    """Return [(normal, offset)] of the level planes among the background of a real sensor's image, the largest first.

    In camera axes, towards the camera: normal . p = offset. Pieces of one height are one plane, such as a table with
    things on it that cut it in two.
    """
    good = seen.image.weight > 0
    candidate = seen.behind & good
    if seen.no_floor or seen.correlation <= CORRELATED or candidate.mean() < LEAST_SHARE:
        return []
    surface = seen.surface
    level = candidate & (surface.normals(candidate)[..., 2] > LEVEL)
    label, count = label_bodies(seen.points, level, TIGHT * surface.jump)
    found: list[tuple[np.ndarray, float]] = []
    scale = seen.floor_scale
    pixels = np.bincount(label[label >= 0], minlength=count)
    points = seen.camera.points(np.where(good, seen.image.depth, np.nan))
    taken = np.zeros(good.shape, bool)
    for k in np.argsort(-pixels, kind="stable"):
        if pixels[k] < LEAST_SHARE * good.sum() or len(found) == MOST:
            break
        own = (label == k) & ~taken
        if own.sum() < LEAST_SHARE * good.sum():
            continue
        centre = points[own].mean(axis=0)
        axes = np.linalg.svd(points[own] - centre, full_matrices=False)[2]
        across = axes[2] * np.sign(-axes[2] @ centre)
        offset = float(across @ centre)
        height = points @ across - offset
        with np.errstate(invalid="ignore"):
            mask = level & ~taken & (np.abs(height) < np.maximum(NOISES * seen.sigma, NEAR * scale))
        slope = np.maximum(np.abs(points @ across) / np.linalg.norm(points, axis=-1), 1e-3)
        area = float(np.nansum(np.where(mask, seen.footprint**2 / slope, 0.0)))
        rise = float(seen.points[mask][:, 2].mean()) if mask.any() else 0.0
        rises = rise > -ROOM and abs(rise) > STEP * scale
        if across @ seen.floor.pose[:3, 2] > LEVEL and area > LEAST_AREA * scale**2 and rises:
            found.append((across, offset))
            taken |= mask
    return found


def patch_of(seen: Observation) -> list[float] | None:
    """Return [x, y, length, width, turn] of the rectangle of its floor's plane that an Observation shows, None: none.

    Metres and radians, in the floor's frame.
    """
    flat = seen.points[seen.floor.inliers & ~seen.behind][:, :2]
    if len(flat) < 3:
        return None
    turn = float(smallest_rectangle(flat))
    axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    low, high = ends_of(flat @ axes, ENDS)
    x, y = axes @ (0.5 * (low + high))
    return [float(x), float(y), *map(float, high - low + 2.0 * RIM * seen.floor_scale), turn]


BELOW, LOWEST = 0.05, 0.01  # share of the pixels that show what is lower, at least; share of these that shows its foot


def floor_below(seen: Observation) -> np.ndarray | None:
    """Return the plane (4,), camera axes, on which stands what a floor is the top of, if it is one; None: it is none.

    It is parallel, and as low as what is seen below: a box that fills the view hides all or most of its own floor. From
    its top the surface goes on over its sides, with no jump; behind a bare table a room is seen beyond one.
    """
    if seen.no_floor:
        return None
    good = seen.image.weight > 0
    body, count = label_bodies(seen.points, good, seen.surface.jump)
    top = np.bincount(body[seen.floor.inliers & good], minlength=count).argmax()
    lower = seen.behind & good & (seen.points[..., 2] < -STEP)
    if (lower & (body == top)).sum() < BELOW * good.sum():
        return None
    height = np.sort(seen.points[lower][:, 2])[: max(1, int(LOWEST * lower.sum()))]
    normal = seen.floor.pose[:3, 2]
    return np.append(normal, -normal @ seen.floor.pose[:3, 3] - float(np.median(height)))
