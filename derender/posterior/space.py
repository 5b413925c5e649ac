"""The unknowns of a fixed structure: which numbers they are, their prior, and how to take a step among them.

The values of all unknowns are one flat (P,) float64 vector. An unknown lives on a line, on a circle (an angle with a
period) or in the group of rotations (a unit quaternion wxyz: four values, three directions to go). A *tangent* vector
has one number for each direction; a step by it is `compiled.prior.moved`, `differences` finds the steps from one place
to others.
"""

import math
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from derender.scene.distributions import Distribution


class Unknown(NamedTuple):
    """A number (or rotation) that inference has to find."""

    address: str  # such as "red.contact.theta"
    distribution: Distribution  # its prior
    period: float | None = None  # of an angle, or None

    @property
    def ways(self) -> int:
        """How many directions there are to go: one, three for a rotation."""
        return 3 if self.distribution.size == 4 else 1


class Block(NamedTuple):
    """Unknowns that move together: the contact of one edge, the shape of one object, the likelihood, or all."""

    name: str  # such as "red.contact", "red.shape", "likelihood", "all"
    unknowns: tuple[int, ...]  # indices of its unknowns

    @property
    def object(self) -> str:
        """The object whose contact this is."""
        return self.name.removesuffix(".contact")


class Space:
    """The unknowns with their prior and geometry. Immutable.

    unknowns : tuple of Unknown; their priors are independent.
    blocks : tuple of Block, a partition of the unknowns.
    addresses : one for each of the P values; those of "a.contact.quat_wxyz" are "a.contact.qw" to "qz".
    offsets : (U + 1,) int64, where each unknown's values begin; directions : (U + 1,) int64, the same in tangents.
    """

    def __init__(self, unknowns: Sequence[Unknown], blocks: Sequence[Block]) -> None:
        self.unknowns = tuple(unknowns)
        self.blocks = tuple(blocks)
        self.slides: tuple[str, ...] = ()  # blocks that may move under their children: the target knows
        self.relocations: tuple[str, ...] = ()  # blocks that may be put down anew in the world
        self.spans: dict[str, tuple[str, str]] = {}  # extents of boxes along the face that they rest on, by object
        sizes = [unknown.distribution.size for unknown in self.unknowns]
        self.offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        ways = [unknown.ways for unknown in self.unknowns]
        self.directions = np.concatenate([[0], np.cumsum(ways)]).astype(np.int64)
        self.addresses = tuple(
            address
            for unknown in self.unknowns
            for address in (
                [unknown.address]
                if unknown.distribution.size == 1
                else [unknown.address.removesuffix("quat_wxyz") + f"q{axis}" for axis in "wxyz"]
            )
        )
        self.periods = tuple(
            unknown.period if size == 1 else None
            for unknown, size in zip(self.unknowns, sizes, strict=True)
            for _ in range(size)
        )

    @property
    def everything(self) -> Block:
        """All unknowns as one block."""
        return Block("all", tuple(range(len(self.unknowns))))

    def sample(self, rng: np.random.Generator) -> np.ndarray:
        """Return (P,) values from the prior, in the order of the unknowns."""
        values = np.empty(self.offsets[-1])
        for i in range(len(self.unknowns)):
            self.resample(rng, values, i)
        return values

    def resample(self, rng: np.random.Generator, values: np.ndarray, unknown: int) -> None:
        """Draw one unknown in place from its prior."""
        values[self.offsets[unknown] : self.offsets[unknown + 1]] = self.unknowns[unknown].distribution.sample(rng)

    def log_prior(self, values: np.ndarray) -> float:
        """Return the log prior density with respect to the stock measure."""
        total = 0.0
        for i, unknown in enumerate(self.unknowns):
            start = self.offsets[i]
            if unknown.distribution.size == 4:
                total += unknown.distribution.log_density(tuple(values[start : start + 4]))
            else:
                total += unknown.distribution.log_density(float(values[start]))
        return total

    def differences(self, places: np.ndarray, origin: np.ndarray) -> np.ndarray:
        """Return (n, D), the shortest tangents from `origin` to each of (n, P) places."""
        tangents = np.empty((len(places), self.directions[-1]))
        for i, unknown in enumerate(self.unknowns):
            start, direction = self.offsets[i], self.directions[i]
            if unknown.distribution.size == 4:
                turns = [turn_between(origin[start : start + 4], place[start : start + 4]) for place in places]
                tangents[:, direction : direction + 3] = turns
            else:
                step = places[:, start] - origin[start]
                if unknown.period is not None:
                    step = (step + 0.5 * unknown.period) % unknown.period - 0.5 * unknown.period
                tangents[:, direction] = step
        return tangents

    @cached_property
    def scales(self) -> np.ndarray:
        """(D,) float64, a first scale for each direction: half the way from the prior's 10 % to its 90 % quantile."""
        scales = np.empty(self.directions[-1])
        for i, unknown in enumerate(self.unknowns):
            if unknown.ways == 1:
                low, high = (unknown.distribution.quantile(p) for p in (0.1, 0.9))
                scales[self.directions[i]] = max(0.5 * (high - low), 1e-12)
            else:
                scales[self.directions[i] : self.directions[i + 1]] = 1.0  # radians
        return scales


def wrap(value: float, period: float) -> float:
    """Return `value` modulo the period, in [0, period)."""
    wrapped = value - period * math.floor(value / period)
    return 0.0 if wrapped >= period else wrapped


def turn(quaternion: np.ndarray, vector: np.ndarray) -> tuple[float, float, float, float]:
    """Return the unit quaternion (wxyz, w >= 0) of a rotation followed, in its own frame, by a rotation vector."""
    w, x, y, z = quaternion
    angle = math.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
    scale = 0.5 if angle < 1e-12 else math.sin(0.5 * angle) / angle
    a = math.cos(0.5 * angle)
    b, c, d = scale * vector[0], scale * vector[1], scale * vector[2]
    p = w * a - x * b - y * c - z * d
    q = w * b + x * a + y * d - z * c
    r = w * c - x * d + y * a + z * b
    s = w * d + x * c - y * b + z * a
    norm = math.sqrt(p * p + q * q + r * r + s * s)
    if p < 0.0:
        norm = -norm
    return p / norm, q / norm, r / norm, s / norm


def turn_between(origin: np.ndarray, quaternion: np.ndarray) -> tuple[float, float, float]:
    """Return the rotation vector v with quaternion = turn(origin, v), at most half a turn long."""
    a, b, c, d = origin[0], -origin[1], -origin[2], -origin[3]
    w, x, y, z = quaternion
    p = a * w - b * x - c * y - d * z
    q = a * x + b * w + c * z - d * y
    r = a * y - b * z + c * w + d * x
    s = a * z + b * y - c * x + d * w
    if p < 0.0:
        p, q, r, s = -p, -q, -r, -s
    norm = math.sqrt(q * q + r * r + s * s)
    scale = 2.0 if norm < 1e-12 else 2.0 * math.atan2(norm, p) / norm
    return scale * q, scale * r, scale * s
