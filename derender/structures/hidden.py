"""How many solids the prior expects where nothing would show them: behind and under what is seen."""

from typing import Any

import numpy as np

from derender.camera.intrinsics import Camera
from derender.detection.solids.beliefs import Beliefs, bare_image
from derender.detection.solids.image import CENTRE, ROTATION, SIZE, make_row
from derender.detection.solids.interpenetration import penetration
from derender.detection.solids.sizes import CUBE, FIRST, HIGH, LOW, NODES
from derender.detection.solids.state import FLOOR
from derender.scene.pose import rotation_z
from derender.scene.solids import BOX, CYLINDER, SPHERE
from derender.structures.draws.chart import PARENT
from derender.structures.draws.sensor import floor_depth, model_depth

TRIES = 400  # solids of the prior that are put down behind what is seen
MARGIN = 0.01  # metres by which all of one has to lie behind what is seen in front of it
LEAST_DEPTH = 1e-3  # metres before the camera: what lies nearer, or behind it, is not in the image
GRID = np.array([[a, b, c] for a in (-1.0, 0.0, 1.0) for b in (-1.0, 0.0, 1.0) for c in (-1.0, 0.0, 1.0)])
LEAST_STEEPNESS = 1e-3  # sine at which a ray meets the floor: below, a pixel's area has no bound
LEAST_AREA = 1e-4  # square metres of hidden floor that are worth a look


def hidden_expected(rng: np.random.Generator, refined: Any, beliefs: Beliefs | None = None) -> float:
    """Return the expected number of solids on the floor that nothing would show, given a structure's scene.

    Solids of the prior are put on the parts of the floor that what stands in front hides from the camera, no farther
    away than floor is seen; those count whose corners all lie behind it, in the image, and that enter nothing. How
    many there are on a square metre is what the prior says, and as this floor shows, see `rate_on_floor`.
    """
    beliefs = bare_image() if beliefs is None else beliefs
    camera, floor = refined.sensor.camera, refined.chart.floor
    depth = model_depth(refined.chart, refined.values, camera)
    bare = floor_depth(floor, camera)
    seen = np.isfinite(bare) & (depth >= bare - LEAST_DEPTH) & np.isfinite(refined.sensor.returned)
    if not seen.any() or len(refined.state) == 0:
        return 0.0
    shown = float(floor_areas(np.argwhere(seen), bare, floor, camera).sum())
    hidden = np.argwhere((depth < bare - MARGIN) & (bare <= bare[seen].max()))
    area = floor_areas(hidden, bare, floor, camera)
    total = float(area.sum())
    if total < LEAST_AREA:
        return 0.0
    rows, columns = hidden[rng.choice(len(hidden), size=TRIES, p=area / total)].T
    ray = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(TRIES)], axis=1)
    places = (ray * bare[rows, columns, None] - floor[:3, 3]) @ floor[:3, :3]
    drawn = drawn_rows(rng, places, beliefs)
    drawn = drawn[out_of_sight(drawn, floor, camera, depth)]
    for view in refined.sensor.others:
        there = model_depth(refined.chart, refined.values, view.camera, view.into)
        drawn = drawn[out_of_sight(drawn, view.into @ floor, view.camera, there)]
    count = sum(all(penetration(row, other) <= 0.0 for other in refined.state.rows) for row in drawn)
    standing = int(np.sum(refined.chart.flags[:, PARENT] == FLOOR))
    return rate_on_floor(beliefs, standing, shown) * total * count / TRIES


def floor_areas(pixels: np.ndarray, depth: np.ndarray, floor: np.ndarray, camera: Camera) -> np.ndarray:
    """Return (n,) the square metres of floor, met at a depth (H, W), in each pixel of (n, 2) rows and columns."""
    rows, columns = pixels.T
    ray = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(len(rows))], axis=1)
    steepness = np.maximum(np.abs(ray @ floor[:3, 2]), LEAST_STEEPNESS)
    return depth[rows, columns] ** 2 / (camera.fx * camera.fy) / steepness


def rate_on_floor(beliefs: Beliefs, count: int, area: float) -> float:
    """Return how many solids are expected on one more square metre of a floor that shows so many on so much area.

    The rate is gamma about the prior's, which is worth as many solids as the prior says, after `count` were counted.
    """
    prior, worth = float(np.exp(beliefs.on_floor[1] - beliefs.on_floor[0])), beliefs.loose.crowding
    return (worth + count) / (worth / prior + area)


def drawn_rows(rng: np.random.Generator, places: np.ndarray, beliefs: Beliefs) -> np.ndarray:
    """Return rows (n, ROW) of solids drawn from the prior, each standing at a place (n, 3) on the floor."""
    shares = np.exp(beliefs.kinds)
    kinds = rng.choice(len(shares), size=len(places), p=shares / shares.sum())
    extents = np.empty((len(places), 3))
    for kind in np.unique(kinds):
        of_kind = kinds == kind
        for axis in range(3):
            extents[of_kind, axis] = drawn_extents(rng, beliefs.sizes[kind, axis], int(of_kind.sum()))
    one_size, one_width = np.isin(kinds, (CUBE, SPHERE)), kinds == CYLINDER
    extents[one_size] = extents[one_size, :1]
    extents[one_width, 1] = extents[one_width, 0]
    centres = places + np.array([0.0, 0.0, 0.5]) * extents
    turns = rng.uniform(0.0, np.pi, len(places))
    return np.array([
        make_row(BOX if kind == CUBE else kind, rotation_z(turn)[:3, :3], centre, extent)
        for kind, turn, centre, extent in zip(kinds.tolist(), turns, centres, extents, strict=True)
    ])  # fmt: skip


def out_of_sight(rows: np.ndarray, floor: np.ndarray, camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Return (n,) bool: which solids lie in the image and all behind its depth (H, W), told by points of their boxes.

    floor : (4, 4) pose, floor frame to camera.
    """
    turned = rows[:, ROTATION:CENTRE].reshape(-1, 3, 3)
    points = rows[:, None, CENTRE:SIZE] + np.einsum("nij,kj->nki", turned * 0.5 * rows[:, None, SIZE:], GRID)
    points = points @ floor[:3, :3].T + floor[:3, 3]
    z = np.maximum(points[..., 2], LEAST_DEPTH)
    columns = np.rint(points[..., 0] / z * camera.fx + camera.cx)
    lines = np.rint(points[..., 1] / z * camera.fy + camera.cy)
    inside = (columns >= 0) & (columns < camera.width) & (lines >= 0) & (lines < camera.height)
    inside &= points[..., 2] > LEAST_DEPTH
    # What leaves the image is not hidden by what is seen.
    seen = depth[np.where(inside, lines, 0).astype(int), np.where(inside, columns, 0).astype(int)]
    return (inside & (seen < points[..., 2] - 0.1 * MARGIN)).all(axis=1)


def drawn_extents(rng: np.random.Generator, row: np.ndarray, count: int) -> np.ndarray:
    """Return extents (count,) drawn from a row of a table of sizes, to its grid."""
    grid = np.exp(np.linspace(row[LOW], row[HIGH], NODES))
    share = np.exp(row[FIRST:] - row[FIRST:].max()) * np.gradient(grid)
    return rng.choice(grid, size=count, p=share / share.sum())
