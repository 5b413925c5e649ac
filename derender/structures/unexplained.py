"""Solids where the best structure leaves an image unexplained: candidates that the search's own price kept out.

The search asks 40 nats of a solid and sees single pixels; what shows in three of them, or faintly in many, is worth
less to it. Here residuals and their squares are summed over windows of some pixels: of noise alone no such sum, in
standard deviations, exceeds FAINT but once in ten images. What is proposed is weighed like any other structure.
"""

from functools import partial
from typing import NamedTuple

import numpy as np

from derender.compilation.threads import in_threads
from derender.detection.search.bodies import body_hypotheses
from derender.detection.search.greedy import Settings
from derender.detection.search.guesses import guesses
from derender.detection.solids.image import Image, make_image
from derender.detection.solids.interpenetration import highest
from derender.detection.solids.polish import UPRIGHT
from derender.detection.solids.state import FLOOR, State, held_out, run_polish
from derender.detection.solids.support import flat_top
from derender.render.blur import blur
from derender.structures.alternatives import PROMISING, QUICK, likeliest_of_each, weighed_whole
from derender.structures.draws.refined import Refined, at_mode, floor_pose_of, height
from derender.structures.draws.sensor import model_depth
from derender.structures.weighing import Weighed

SIDES = (2, 3, 5, 8)  # pixels of the windows
FAINT = 4.5  # standard deviations: 3e-6 of independent windows, of which an image of 3,000 pixels has ten thousand
SURELY = 6.0  # standard deviations from which on what is left after all is surely not noise: 1e-9, in any image
MOST_OF_ONE = 4.0  # standard deviations that one pixel counts for: a single outlier is no solid
SPOTS = 2  # windows looked at, those that tell most
SHOWS = 1.0  # standard deviations off what is explained from which on a pixel about a window shows the solid
CLIMBED, WEIGHED = 6, 2  # polished candidates of a window that are climbed by themselves, and then with all others


class Spot(NamedTuple):
    """A window of badly explained pixels. strength : standard deviations. shown : (H, W) bool, those pixels."""

    strength: float
    shown: np.ndarray


def nearer_than_explained(best: Refined) -> np.ndarray:
    """Return (H, W) by how many standard deviations of the noise pixels are nearer than explained; NaN: no return."""
    sensor = best.sensor
    model = blur(model_depth(best.chart, best.values, sensor.camera), sensor.values["blur"])
    noise = sensor.values["sigma"] + sensor.values.get("sigma_growth", 0.0) * model**2
    return np.clip((model - sensor.returned) / noise, -MOST_OF_ONE, MOST_OF_ONE)


def spots(nearer: np.ndarray) -> list[Spot]:
    """Return the Spots of an image (H, W) of standard deviations, the strongest first, none beside another."""
    nearer, found = nearer.copy(), []
    while len(found) < SPOTS:
        seen = np.isfinite(nearer)
        filled = np.where(seen, nearer, 0.0)
        tables = np.stack([filled, filled**2, seen], axis=-1).cumsum(axis=0).cumsum(axis=1)
        tables = np.pad(tables, ((1, 0), (1, 0), (0, 0)))
        strength, side, row, column = max(strongest(tables, side) for side in SIDES)
        if strength < FAINT:
            break
        about = slice(max(row - 1, 0), row + side + 1), slice(max(column - 1, 0), column + side + 1)
        shown = np.zeros(nearer.shape, bool)
        shown[about] = np.abs(nearer[about]) > SHOWS
        found.append(Spot(strength, shown))
        nearer[about] = np.nan
    return found


def strongest(tables: np.ndarray, side: int) -> tuple[float, int, int, int]:
    """Return (strength, side, row, column) of the square window whose sum, or sum of squares, tells most.

    Squares by the cube root of their mean, which is nearly normal (Wilson and Hilferty, PNAS 1931).

    tables : (H + 1, W + 1, 3) summed-area tables of the numbers, of their squares, and of how many are known.
    """
    sums = tables[side:, side:] - tables[:-side, side:] - tables[side:, :-side] + tables[:-side, :-side]
    total, squares, count = np.moveaxis(sums, -1, 0)
    count = np.maximum(count, 1.0)
    spread = 2.0 / (9.0 * count)
    strength = np.maximum(total / np.sqrt(count), (np.cbrt(squares / count) - 1.0 + spread) / np.sqrt(spread))
    row, column = np.unravel_index(np.argmax(strength), strength.shape)
    return float(strength[row, column]), side, int(row), int(column)


def additions(rng: np.random.Generator, best: Refined, settings: Settings) -> list[Weighed]:
    """Return the Weighed of the best structure with one solid more, where it leaves something unexplained.

    Others may have given way to explain what it shows, so all move and all are integrated over. Nothing is proposed
    where neighbouring pixels err together, for a sensor's bends look like that, nor in a reduced image: silhouettes do.
    """
    if len(best.state) >= settings.max_objects or best.sensor.worth < 1.0 or settings.reduced:
        return []
    sensor, floor, place = best.sensor, floor_pose_of(best), [len(best.state)]
    noise = np.full(sensor.observed.shape, sensor.values["sigma"])
    image = make_image(sensor.returned, noise, sensor.camera, floor, sensor.values["blur"])
    seen = image.origin + image.depth[..., None] * image.direction
    climb = partial(at_mode, floor_pose=floor, sensor=sensor, rules=settings.rules, steps=QUICK, only=place)
    candidates = []
    for spot in spots(nearer_than_explained(best)):
        states = with_one_more(rng, image, best.state, seen[spot.shown & (image.depth > 0)], settings)
        trials = in_threads(rng, [partial(climb, state=state) for state in states])
        trials = likeliest_of_each([trial for trial in trials if height(trial) > height(best) - PROMISING])
        candidates += sorted(trials, key=height, reverse=True)[:WEIGHED]
    return weighed_whole(rng, best, [trial.state for trial in candidates], settings.rules, QUICK)


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
        near = [*body_hypotheses(points, image.origin, settings.shapes, bottom),
                *guesses(rng, image, points, settings.shapes, bottom, view[0], view[2])]  # fmt: skip
        for each in near:
            held = bottom if each.form == UPRIGHT else np.nan
            row, energy, _ = run_polish(rng, image, state, -1, each.row, each.form, False, view, held, settings, 200,
                                        0.006)  # fmt: skip
            found.append((energy, len(found), state.add(row, each.form, False, parent, held)))
    return [new for _, _, new in sorted(found, key=lambda each: each[:2])[:CLIMBED]]
