"""What hypotheses of solids are made from: the points and the planes of patches."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from derender.detection.patches import Patches

ALONG, UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
THINNEST = 0.008


class Hypothesis(NamedTuple):
    """A solid that may be in the scene.

    row : (ROW,) float64, see solids/image.py.
    form : UPRIGHT (its own z axis is the floor's) or FREE.
    cube : whether its edges are equal by construction.
    patches : indices of the patches that suggested it.
    """

    row: np.ndarray
    form: int
    cube: bool
    patches: tuple[int, ...]


class Surface(NamedTuple):
    """What hypotheses are made from: each patch's points, the patches, and the camera's place in the floor frame."""

    points: list[np.ndarray]
    normal: np.ndarray
    offset: np.ndarray
    pixels: np.ndarray
    centre: np.ndarray
    touching: np.ndarray
    origin: np.ndarray
    footprint: float
    sigma: float


def make_surface(points: np.ndarray, patches: "Patches", origin: np.ndarray, footprint: float, sigma: float) -> Surface:
    """Collect the points (H, W, 3) of each patch."""
    flat = patches.label.ravel()
    order = np.argsort(flat, kind="stable")
    starts = np.searchsorted(flat[order], np.arange(len(patches.pixels) + 1))
    coordinates = points.reshape(-1, 3)
    lists = [coordinates[order[starts[k] : starts[k + 1]]] for k in range(len(patches.pixels))]
    return Surface(lists, patches.normal, patches.offset, patches.pixels, patches.centre, patches.touching,
                   origin, footprint, sigma)  # fmt: skip


def convex(surface: Surface, a: int, b: int) -> bool:
    """Whether two patches meet in a convex edge (or none): each one's middle lies behind the other's plane."""
    slack = 3 * surface.sigma
    return (
        surface.normal[a] @ surface.centre[b] - surface.offset[a] < slack
        and surface.normal[b] @ surface.centre[a] - surface.offset[b] < slack
    )


def tangent(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors that make a right-handed frame with the normal."""
    first = cross(UP if abs(normal[2]) < 0.9 else ALONG, normal)
    first /= np.linalg.norm(first)
    return first, cross(normal, first)


def cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the cross product of two vectors (3,), without what numpy.cross does for arrays of them: 3 us, not 40."""
    (a, b, c), (x, y, z) = one.tolist(), other.tolist()
    return np.array([b * z - c * y, c * x - a * z, a * y - b * x])
