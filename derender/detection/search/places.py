"""Where a state explains the image badly: what moves are aimed at."""

from typing import NamedTuple

import numpy as np

from derender.compilation.cache import njit
from derender.detection.search.bodies import find_bodies
from derender.detection.search.greedy import Settings
from derender.detection.solids.image import Image
from derender.detection.solids.state import Solid, State, held_out

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
