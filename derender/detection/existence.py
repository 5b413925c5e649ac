"""Whether what shows as a free-form thing is an object: how much of the image it explains, and how it stands out."""

from typing import TYPE_CHECKING

import numpy as np

from derender.detection.freestanding import FARTHER, JOINED, outline_shares
from derender.detection.search.bodies import APART
from derender.detection.segments import outline_area

if TYPE_CHECKING:
    from derender.detection.search.greedy import Settings
    from derender.detection.search.observation import Observation

LEAST_EXISTENCE = 0.5  # probability that a thing of the best scene is an object


def existence_of(
    seen: "Observation", mask: np.ndarray, gain: float, settings: "Settings", below: np.ndarray
) -> tuple[float, float]:
    """Return (probability, standard error) that what a mask (H, W) shows is an object; gain : in tempered nats.

    below : (H, W) bool, pixels of the solid that it stands on.
    """
    return settings.believed.loose.existence.of(gain / settings.temper, outstanding(seen, mask, below))


def outstanding(seen: "Observation", mask: np.ndarray, below: np.ndarray) -> float:
    """Return how much what a mask (H, W) shows stands out, 1 at most: the share of its outline's hull that it fills,
    times the share of its outline beyond which something farther is seen, or the floor or the solid (`below`, (H, W)
    bool) that it stands on.

    Clutter, such as leaves or the edge of a bin, is ragged or goes on behind what hides it, and a piece of something
    goes on there; where nothing returned beyond the outline nothing tells what it is.
    """
    good = seen.image.weight > 0
    jump = np.ascontiguousarray(APART * seen.footprint + 3.0 * seen.sigma)
    piece = np.where(mask, 0, -1).astype(np.int32)
    around, floor = (outline_shares(piece, 1, seen.points, beyond, jump, seen.footprint, seen.image.origin)[0]
                     for beyond in (good, good & (mask | ~seen.mask | below)))  # fmt: skip
    rows, columns = np.nonzero(mask)
    pixels = np.column_stack([rows, columns])
    corners = np.concatenate([pixels + [down, across] for down in (-0.5, 0.5) for across in (-0.5, 0.5)])
    filled = min(1.0, len(rows) / outline_area(corners) / returns_about(seen))
    return float((around[FARTHER] + min(floor[JOINED], around[JOINED])) * filled)


def returns_about(seen: "Observation") -> float:
    """Return the share of the eight neighbours of an Observation's pixels that have a depth as these do."""
    good = np.pad((seen.image.weight > 0).astype(float), 1)
    about = good[:, :-2] + good[:, 1:-1] + good[:, 2:]
    about = about[:-2] + about[1:-1] + about[2:] - good[1:-1, 1:-1]
    inner = good[1:-1, 1:-1]
    return float((about * inner).sum() / max(8.0 * inner.sum(), 1.0))
