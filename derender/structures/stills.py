"""Images from one place averaged: what a camera that stands still sees again tells no more than how noisy it is.

Errors that come again in each image - a sensor's bias, its fixed pattern - stay in the mean, and inference fits its
noise to the mean's own residuals: so a hundred images of a sensor with a bias make no sure answer of it, and those of
independent noise have a tenth of one's.
"""

import warnings
from collections.abc import Sequence

import numpy as np

from derender.camera.intrinsics import Camera
from derender.errors import DerenderError
from derender.results.fit import flat_noise, tolerance_of
from derender.structures.options import Frame

STILL = 0.1  # pixels by which what is seen may move between images that count as from one place
OUTLYING = 4.0  # robust standard deviations from the median of its images at which a pixel's depth is left out
RETURNS = 0.5  # share of the images in which a pixel has to have a depth
TOLERANCES = 2.0  # times what may be a depth's error (results/fit.py), beyond which two images differ at a pixel
SAME, DIFFERENT = 0.01, 0.1  # share of the pixels: with fewer it is one place, with more another scene


def averaged(
    depth: np.ndarray, camera: Camera, frames: Sequence[Frame], name: str = "the first image"
) -> tuple[np.ndarray, list[Frame]]:
    """Return (depth (H, W), Frames) with images from one place averaged, each about the first of its place.

    Raises DerenderError : images from one place do not show the same.
    """
    places = [[Frame(depth, camera, np.eye(4), name)]]
    for frame in frames:
        same = next((place for place in places if from_one_place(place[0], frame)), None)
        if same is None:
            places.append([frame])
            continue
        refuse_another_scene(same[0], frame)
        same.append(frame)
    first, *others = (mean_of(place) for place in places)
    return first.depth, others


def from_one_place(one: Frame, other: Frame) -> bool:
    """Return whether two images were taken by one camera from one place, to STILL pixels.

    Where nobody says where the camera stood, images that show the same everywhere were.
    """
    camera = one.camera
    if one.depth.shape != other.depth.shape or abs(camera.fx - other.camera.fx) > 1e-6 * camera.fx:
        return False
    if one.into is None or other.into is None:
        return differing(one, other) < SAME
    apart = other.into @ np.linalg.inv(one.into)
    turn = np.linalg.norm(apart[:3, :3] - np.eye(3)) / np.sqrt(2.0)
    nearest = float(np.nanmin(np.where(one.depth > 0, one.depth, np.nan)))
    return bool(camera.fx * (turn + np.linalg.norm(apart[:3, 3]) / nearest) < STILL)


def differing(one: Frame, other: Frame) -> float:
    """Return the share of the pixels in which two images differ by more than noise and edges."""
    off = np.abs(other.depth - one.depth)
    both = np.isfinite(off)
    far = off > TOLERANCES * tolerance_of(one.depth, flat_noise(one.depth))
    return float(far[both].mean()) if both.any() else 1.0


def refuse_another_scene(one: Frame, other: Frame) -> None:
    """Raise a DerenderError where two images from one place differ by more than noise."""
    share = differing(one, other)
    if share > DIFFERENT:
        what = f"{share:.0%} of it differs from {one.name}, though the poses say that both are from one place"
        raise DerenderError(what, other.name, "--together is for one scene that stands still: check the poses")


def mean_of(frames: Sequence[Frame]) -> Frame:
    """Return the mean of images from one place, outliers left out; one image is itself."""
    if len(frames) == 1:
        return frames[0]
    depths = np.stack([np.where(frame.depth > 0, frame.depth, np.nan) for frame in frames])
    counted = np.isfinite(depths)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of pixels that no image has
        middle = np.nanmedian(depths, axis=0)
        spread = 1.4826 * np.nanmedian(np.nanmedian(np.abs(depths - middle), axis=0))
        kept = np.where(np.abs(depths - middle) <= OUTLYING * spread, depths, np.nan)
        kept = np.where(np.isfinite(kept).any(axis=0), kept, middle)
        mean = np.nanmean(kept, axis=0)
    name = f"{frames[0].name} and {len(frames) - 1} more from there"
    return frames[0]._replace(name=name, depth=np.where(counted.mean(axis=0) >= RETURNS, mean, np.nan))
