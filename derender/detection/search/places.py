"""Where a state explains the image badly, what moves are aimed at; and guesses of solids that show given points there.

Hypotheses from patches and from bodies of points take what shows for most of a solid. Of a drum behind another solid a
strip of its side and a bit of its end show, which no least-squares circle fits; of many guesses, at any angle and of
any extent into what is hidden, one is near enough to be polished. A guess costs the pixels of its rectangle.
"""

from typing import NamedTuple

import numpy as np

from derender.compilation.cache import njit
from derender.detection.search.bodies import find_bodies
from derender.detection.search.greedy import Settings
from derender.detection.search.proposals import THINNEST
from derender.detection.solids.image import ROW, Image
from derender.detection.solids.misfit import added_misfit
from derender.detection.solids.polish import FREE, TYPICAL_SIZE, UPRIGHT
from derender.detection.solids.state import Solid, State, held_out
from derender.scene.solids import BOX, CYLINDER, SPHERE

NEAR = 2  # pixels from a bad one to the solids that share it


class Places(NamedTuple):
    """Where the image is badly explained.

    bodies : list of (K, 3) float64, the points of bad pixels that are nearer than explained, and joined.
    """

    blame: np.ndarray  # (N + 1,) bad pixels about each solid (last: about none, as many as bodies have)
    pairs: np.ndarray  # (N + 1, N + 1) how many bad pixels two solids share
    beside: np.ndarray  # (N + 1, N + 1) how many neighbouring pixels show two solids
    points: np.ndarray  # (B, 3) float64, the observed points of the bad pixels, floor frame
    bodies: list[np.ndarray]
    shown: np.ndarray  # (H, W) int32, the solid that each pixel shows; negative: none
    seen: np.ndarray  # (H, W, 3) float64, all points
    alone: dict[frozenset[int], list[Solid]]  # of one solid for what some show, made when it is asked for

    def none_left(self, settings: Settings) -> bool:
        """Whether hardly any misfit is left that noise would not leave: less than another solid costs."""
        return self.blame.sum() < settings.clean


MISFIT = 4.5  # nats of a pixel, as of three standard deviations: more is badly explained


def find_places(image: Image, state: State) -> Places:
    """Return the Places of a state; lone pixels count for nothing: they are noise or the rounding of a silhouette."""
    depth, label, misfit, _ = held_out(image, state, -1)
    bad = misfit > MISFIT
    crowded = np.zeros(bad.shape, bool)
    crowded[1:] |= bad[:-1]
    crowded[:-1] |= bad[1:]
    crowded[:, 1:] |= bad[:, :-1]
    crowded[:, :-1] |= bad[:, 1:]
    rows, columns = np.nonzero(bad & crowded)
    count = len(state)
    blame, pairs = blame_of(rows, columns, label, count)
    seen = image.origin + image.depth[..., None] * image.direction
    footprint = image.depth * np.linalg.norm(image.direction[0, 1] - image.direction[0, 0])
    bodies = find_bodies(seen, bad & (image.depth < depth), footprint)
    blame[count] = min(blame[count], sum(map(len, bodies)))  # a new solid could not explain the others
    return Places(blame, pairs, neighbours(label, count), seen[rows, columns], bodies, label, seen, {})


@njit(cache=True, nogil=True)
def blame_of(rows, columns, label, count):
    """Return blame (N + 1,) and pairs (N + 1, N + 1) of bad pixels: each is shared by the solids NEAR it."""
    height, width = label.shape
    blame, pairs = np.zeros(count + 1), np.zeros((count + 1, count + 1))
    near = np.empty((2 * NEAR + 1) ** 2, np.int64)
    for k in range(len(rows)):
        found = 0
        for v in range(max(rows[k] - NEAR, 0), min(rows[k] + NEAR + 1, height)):
            for u in range(max(columns[k] - NEAR, 0), min(columns[k] + NEAR + 1, width)):
                new = label[v, u] >= 0
                for other in range(found):
                    new = new and near[other] != label[v, u]
                if new:
                    near[found] = label[v, u]
                    found += 1
        if found == 0:
            near[0], found = count, 1
        for a in range(found):
            blame[near[a]] += 1.0 / found
            for b in range(found):
                if a != b:
                    pairs[near[a], near[b]] += 1
    return blame, pairs


def neighbours(label: np.ndarray, count: int) -> np.ndarray:
    """Return (count + 1, count + 1): how many pairs of neighbouring pixels show these two solids."""
    beside = np.zeros((count + 1, count + 1))
    for a, b in ((label[1:], label[:-1]), (label[:, 1:], label[:, :-1])):
        edge = (a != b) & (a >= 0) & (b >= 0)
        np.add.at(beside, (a[edge], b[edge]), 1)
    return beside + beside.T


def pick(rng: np.random.Generator, weight: list[int] | np.ndarray) -> int:
    """Return an index drawn with probability proportional to weight (a little for those with none)."""
    weight = np.asarray(weight, float) + 1e-2
    return int(rng.choice(len(weight), p=weight / weight.sum()))


GUESSES = 60  # of each way
POINTS = 60  # of those to be shown, that one lot of guesses looks at
HIDDEN, UNHIDDEN = 0.03, 0.4  # metres hidden beyond what shows along an axis, on average, and how often none are
ASIDE = 1.2  # radians off the way to the camera of a round solid's side that shows, at most
SIZES = 0.5  # log spread of diameters about the typical size
TALL, ROUND, LYING, BALL = range(4)  # ways: an upright box, an upright cylinder, one that lies, a sphere


def guesses(
    rng: np.random.Generator,
    image: Image,
    points: np.ndarray,
    shapes: tuple[str, ...],
    bottom: float,
    depth: np.ndarray,
    misfit: np.ndarray,
) -> list[Solid]:
    """Return a Solid of each way that the shapes allow: the best of GUESSES.

    points : (N, 3) float64, floor frame, that the solid shows. bottom : height on which it stands.
    depth, misfit : (H, W) of the scene without it.
    """
    ways = [TALL] if {"box", "cube"} & set(shapes) else []
    ways += [ROUND, LYING] if "cylinder" in shapes else []
    ways += [BALL] if "sphere" in shapes else []
    if len(points) > POINTS:
        points = points[rng.choice(len(points), POINTS, replace=False)]
    found = []
    for way in ways:
        row = best_guess(rng, way, image, points, bottom, depth, misfit, GUESSES)
        found.append(Solid(row, UPRIGHT if way in (TALL, ROUND) else FREE))
    return found


@njit(cache=True, nogil=True)
def best_guess(rng, way, image, points, bottom, depth, misfit, count):
    """Return the row of the guess that lowers the misfit most."""
    best, row = np.empty(ROW), np.empty(ROW)
    least = np.inf
    for _ in range(count):
        guess(rng, way, image.origin, points, bottom, row)
        change = added_misfit(image, row, depth, misfit)
        if change < least:
            least = change
            best[:] = row
    return best


@njit(cache=True, nogil=True, borrows=True)
def guess(rng, way, origin, points, bottom, row):
    """Write the row of a solid on whose surface one of the points lies, and which reaches over the others."""
    top = bottom + THINNEST
    for k in range(len(points)):
        top = max(top, points[k, 2])
    place = points[int(len(points) * rng.random())]
    ax, ay = place[0] - origin[0], place[1] - origin[1]  # away from the camera
    far = np.sqrt(ax * ax + ay * ay) + 1e-12
    ax, ay = ax / far, ay / far
    yaw = np.pi * rng.random()
    c, s = np.cos(yaw), np.sin(yaw)
    row[1:10] = 0.0
    row[1] = row[5] = row[9] = 1.0
    row[12] = 0.5 * (bottom + top)
    row[15] = top - bottom
    if way == TALL:
        row[0] = BOX
        row[1], row[2], row[4], row[5] = c, -s, s, c
        low, high = reaching(rng, points, c, s, ax, ay)
        left, right = reaching(rng, points, -s, c, ax, ay)
        row[13], row[14] = max(high - low, THINNEST), max(right - left, THINNEST)
        along, across = 0.5 * (low + high), 0.5 * (left + right)
        row[10], row[11] = c * along - s * across, s * along + c * across
        return
    diameter = TYPICAL_SIZE * np.exp(SIZES * rng.standard_normal())
    if way != ROUND and rng.random() < 0.5:  # it ends at what shows highest
        diameter = top - bottom
    radius = 0.5 * diameter
    if way == ROUND:
        inward = radius
    else:
        row[12] = bottom + radius
        height = min(max(place[2] - row[12], -radius), radius)
        inward = np.sqrt(radius * radius - height * height)
    row[13], row[14] = diameter, diameter
    if way == LYING:
        row[0] = CYLINDER
        # own x across the axis, own y up, own z the axis
        row[1], row[2], row[3] = -s, 0.0, c
        row[4], row[5], row[6] = c, 0.0, s
        row[7], row[8], row[9] = 0.0, 1.0, 0.0
        low, high = reaching(rng, points, c, s, ax, ay)
        row[15] = max(high - low, THINNEST)
        along, across = 0.5 * (low + high), s * place[0] - c * place[1]
        across += inward if s * ax - c * ay > 0.0 else -inward
        row[10], row[11] = c * along + s * across, s * along - c * across
        return
    aside = ASIDE * (2.0 * rng.random() - 1.0)
    c, s = np.cos(aside), np.sin(aside)
    row[10], row[11] = place[0] + inward * (c * ax - s * ay), place[1] + inward * (s * ax + c * ay)
    row[0] = CYLINDER
    if way == BALL:
        row[0], row[15] = SPHERE, diameter


@njit(cache=True, nogil=True, borrows=True)
def reaching(rng, points, x, y, ax, ay):
    """Return (low, high) between which points lie along (x, y), and what may be hidden behind them.

    ax, ay : unit vector away from the camera.
    """
    low, high = np.inf, -np.inf
    for k in range(len(points)):
        along = points[k, 0] * x + points[k, 1] * y
        low, high = min(low, along), max(high, along)
    if rng.random() > UNHIDDEN:
        beyond = HIDDEN * rng.standard_exponential()
        if x * ax + y * ay > 0.0:
            high += beyond
        else:
            low -= beyond
    return low, high
