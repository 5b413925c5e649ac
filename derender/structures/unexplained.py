"""Solids that a search did not find: where the best structure leaves an image unexplained, and where nothing shows.

The search asks 40 nats of a solid and sees single pixels. Here residuals and their squares are summed over windows: of
noise alone no such sum, in standard deviations, exceeds FAINT but once in ten images.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.compilation.threads import in_threads
from derender.detection.floor import floor_depth
from derender.detection.search.bodies import body_hypotheses
from derender.detection.search.greedy import Settings
from derender.detection.solids.beliefs import CUBE, FIRST, HIGH, LOW, NODES, Beliefs, bare_image
from derender.detection.solids.image import CENTRE, ROTATION, SIZE, Image, make_image, make_row
from derender.detection.solids.interpenetration import highest, penetration
from derender.detection.solids.state import FLOOR, State, held_out, run_polish
from derender.detection.solids.support import flat_top
from derender.render.blur import blur
from derender.render.likelihoods.pixelwise import near_edges, noise_at
from derender.scene.pose import rotation_z
from derender.scene.solids import BOX, CYLINDER, SPHERE
from derender.structures.alternatives import PROMISING, QUICK, likeliest_of_each
from derender.structures.draws.chart import PARENT
from derender.structures.draws.refined import Refined, at_mode, floor_pose_of, height
from derender.structures.draws.sensor import model_depth

SIDES = (2, 3, 5, 8)  # pixels of the windows
FAINT = 4.5  # standard deviations: 3e-6 of independent windows, of which an image of 3,000 pixels has ten thousand
SURELY = 6.0  # standard deviations from which on what is left after all is surely not noise: 1e-9, in any image
MOST_OF_ONE = 4.0  # standard deviations that one pixel counts for: a single outlier is no solid
SPOTS = 2  # windows looked at, those that tell most
SHOWS = 1.0  # standard deviations off what is explained from which on a pixel about a window shows the solid
# Nats of the likelihood by which the image has to tell of one solid more: half of what a window of FAINT tells. With
# less it is one of those that nothing shows, as a floor may have anywhere outside the image (`hidden_expected`).
TOLD = 5.0
CLIMBED, WEIGHED = 6, 2  # polished candidates of a window that are climbed by themselves, and then with all others


class Spot(NamedTuple):
    """A window of badly explained pixels."""

    strength: float  # standard deviations
    shown: np.ndarray  # (H, W) bool, those pixels


def place_of(mask: np.ndarray) -> list[float]:
    """Return the first and the last row and column of a mask (H, W), as shares of the image's height and width."""
    ends = np.array([[each.min(), each.max() + 1] for each in np.nonzero(mask)])
    return (ends / np.array(mask.shape)[:, None]).ravel().tolist()


def nearer_than_explained(clean: np.ndarray, observed: np.ndarray, numbers: Mapping[str, float]) -> np.ndarray:
    """Return (H, W) by how many standard deviations of the noise pixels are nearer than explained; NaN: no return.
    clean, observed : (H, W) metres, of the scene without blur, and of the image. numbers : of a likelihood."""
    model = blur(clean, numbers["blur"])
    return np.clip((model - observed) / noise_at(model, numbers), -MOST_OF_ONE, MOST_OF_ONE)


def spots_left(clean: np.ndarray, observed: np.ndarray, numbers: Mapping[str, float]) -> list[list[float]]:
    """Return the places of what a scene leaves that is surely no noise, unless neighbouring pixels share it; see
    `spots`. What may fly at an edge, where pixels do, is explained."""
    nearer = nearer_than_explained(clean, observed, numbers)
    if numbers.get("flying", 0.0) > 0.0:
        edge, nearest, farthest = near_edges(clean, numbers["edge_step"])
        nearer[edge & (observed >= nearest) & (observed <= farthest)] = 0.0
    found = spots(nearer)
    return [place_of(spot.shown) for spot in found if spot.strength > SURELY]


def spots(nearer: np.ndarray) -> list[Spot]:
    """Return the Spots of an image (H, W) of standard deviations, the strongest first, none beside another."""
    nearer, found = nearer.copy(), []
    sides = [side for side in SIDES if side <= min(nearer.shape)]
    while sides and len(found) < SPOTS:
        seen = np.isfinite(nearer)
        filled = np.where(seen, nearer, 0.0)
        tables = np.stack([filled, filled**2, seen], axis=-1).cumsum(axis=0).cumsum(axis=1)
        tables = np.pad(tables, ((1, 0), (1, 0), (0, 0)))
        strength, side, row, column = max(strongest(tables, side) for side in sides)
        if strength < FAINT:
            break
        about = slice(max(row - 1, 0), row + side + 1), slice(max(column - 1, 0), column + side + 1)
        shown = np.zeros(nearer.shape, bool)
        shown[about] = np.abs(nearer[about]) > SHOWS
        found.append(Spot(strength, shown))
        nearer[about] = np.nan
    return found


def strongest(tables: np.ndarray, side: int) -> tuple[float, int, int, int]:
    """Return (strength, side, row, column) of the square window whose sum, or sum of squares, tells most: by the cube
    root of their mean, which is nearly normal (Wilson and Hilferty, PNAS 1931).

    tables : (H + 1, W + 1, 3) summed-area tables of the numbers, of their squares, and of how many are known.
    """
    sums = tables[side:, side:] - tables[:-side, side:] - tables[side:, :-side] + tables[:-side, :-side]
    total, squares, count = np.moveaxis(sums, -1, 0)
    count = np.maximum(count, 1.0)
    spread = 2.0 / (9.0 * count)
    strength = np.maximum(total / np.sqrt(count), (np.cbrt(squares / count) - 1.0 + spread) / np.sqrt(spread))
    row, column = np.unravel_index(np.argmax(strength), strength.shape)
    return float(strength[row, column]), side, int(row), int(column)


def additions(rng: np.random.Generator, best: Refined, settings: Settings) -> list[State]:
    """Return the states of the best structure with one solid more where it leaves something unexplained; not where
    neighbouring pixels err together, nor in a reduced image: a sensor's bends and silhouettes look like that."""
    if len(best.state) >= settings.max_objects or best.sensor.worth < 1.0 or settings.reduced:
        return []
    sensor, floor, place = best.sensor, floor_pose_of(best), [len(best.state)]
    noise = np.full(sensor.observed.shape, sensor.values["sigma"])
    image = make_image(sensor.returned, noise, sensor.camera, floor, sensor.values["blur"])
    seen = image.origin + image.depth[..., None] * image.direction
    climb = partial(at_mode, floor_pose=floor, sensor=sensor, rules=settings.rules, steps=QUICK, only=place)
    candidates: list[Refined] = []
    for spot in spots(nearer_than_explained(sensor.clean(best.chart, best.values), sensor.returned, sensor.values)):
        states = with_one_more(rng, image, best.state, seen[spot.shown & (image.depth > 0)], settings)
        trials = in_threads(rng, [partial(climb, state=state) for state in states])
        trials = [trial for trial in trials if trial.log_likelihood > best.log_likelihood + TOLD]
        trials = likeliest_of_each([trial for trial in trials if height(trial) > height(best) - PROMISING])
        candidates += sorted(trials, key=height, reverse=True)[:WEIGHED]
    return [trial.state for trial in candidates]


def with_one_more(
    rng: np.random.Generator, image: Image, state: State, points: np.ndarray, settings: Settings
) -> list[State]:
    """Return the states with one solid more that shows points (N, 3), floor frame: the best polished ones."""
    if len(points) == 0:
        return []
    view = held_out(image, state, -1)
    found = []
    supports = [(FLOOR, 0.0), *((k, highest(row)) for k, row in enumerate(state.rows) if flat_top(row))]
    for parent, bottom in supports:
        if bottom > points[:, 2].max():
            continue
        for each in body_hypotheses(points, image.origin, settings.shapes, bottom):
            solid, energy = run_polish(rng, image, state, -1, each.on(bottom, parent), view, settings, 200, 0.006)
            found.append((energy, len(found), state.add(*solid)))
    return [new for _, _, new in sorted(found, key=lambda each: each[:2])[:CLIMBED]]


TRIES = 400  # solids of the prior that are put down behind what is seen
MARGIN = 0.01  # metres by which all of one has to lie behind what is seen in front of it
LEAST_DEPTH = 1e-3  # metres before the camera: what lies nearer, or behind it, is not in the image
GRID = np.array([[a, b, c] for a in (-1.0, 0.0, 1.0) for b in (-1.0, 0.0, 1.0) for c in (-1.0, 0.0, 1.0)])
LEAST_STEEPNESS = 1e-3  # sine at which a ray meets the floor: below, a pixel's area has no bound
LEAST_AREA = 1e-4  # square metres of hidden floor that are worth a look


def hidden_expected(rng: np.random.Generator, refined: Any, beliefs: Beliefs | None = None) -> float:
    """Return the expected number of solids on the floor that nothing would show, given a structure's scene.

    Solids of the prior are put on the parts of the floor that are hidden, no farther away than floor is seen; those
    count whose corners all lie behind what hides them, in the image, and that enter nothing; see `rate_on_floor`.
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
    places = (camera.rays()[rows, columns] * bare[rows, columns, None] - floor[:3, 3]) @ floor[:3, :3]
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
    steepness = np.maximum(np.abs(camera.rays()[rows, columns] @ floor[:3, 2]), LEAST_STEEPNESS)
    return depth[rows, columns] ** 2 / (camera.fx * camera.fy) / steepness


def rate_on_floor(beliefs: Beliefs, count: int, area: float) -> float:
    """Return how many solids are expected on one more square metre of a floor that shows `count` on `area`: gamma about
    the prior's, which is worth as many solids as the prior says."""
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
    floor : (4, 4) pose, floor frame to camera."""
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
