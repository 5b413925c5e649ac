"""What is seen nearer to the camera than anything that is drawn: where lost things are, and new ones."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from derender.camera.intrinsics import Camera
    from derender.tracking.tracker import Tracker

OFF = 5.0  # standard deviations nearer than what is drawn
AT_LEAST = 0.008  # metres, and so much besides: contacts and edges are off by less
SMALLEST = 25  # pixels: smaller patches are noise at edges
MOST = 3  # blobs that are looked at, the largest first


class Blob(NamedTuple):
    """Pixels that belong together and that nothing explains."""

    mask: np.ndarray  # (H, W) bool
    pixels: int  # how many
    centre: np.ndarray  # (3,) middle of the seen points, camera axes, metres


def blobs_of(tracker: "Tracker") -> list[Blob]:
    """Return what nothing explains in the tracker's present frame, the largest first."""
    observed = tracker.observed
    near = (observed > 0) & (tracker.misfit.blurred - observed > OFF * tracker.spread + AT_LEAST)
    if int(near.sum()) < SMALLEST:
        return []
    from scipy.ndimage import binary_closing, label

    marks, count = label(binary_closing(near, np.ones((3, 3))))
    sizes = np.bincount(marks.ravel(), weights=near.ravel(), minlength=count + 1)
    found = []
    for number in np.argsort(-sizes[1:])[:MOST] + 1:
        if sizes[number] >= SMALLEST:
            mask = near & (marks == number)
            found.append(Blob(mask, int(sizes[number]), centre_of(mask, observed, tracker.camera)))
    return found


def centre_of(mask: np.ndarray, depth: np.ndarray, camera: "Camera") -> np.ndarray:
    """Return the middle (3,) of the points that some pixels show, robustly, camera axes."""
    rows, columns = np.nonzero(mask)
    z = depth[rows, columns]
    middle = np.median(z)
    kept = np.abs(z - middle) < 0.15
    rows, columns, z = rows[kept], columns[kept], z[kept]
    return np.array([np.mean((columns - camera.cx) / camera.fx * z), np.mean((rows - camera.cy) / camera.fy * z),
                     np.mean(z)])  # fmt: skip


def shifts_to(tracker: "Tracker", blobs: list[Blob], own: np.ndarray | None, pose: np.ndarray) -> list[np.ndarray]:
    """Return poses (4, 4) of a thing, camera axes, that bring it to each blob.

    own : (H, W) bool, where it is drawn now, whose middle goes to the blob's; None: its centre goes somewhat behind.
    """
    found = []
    for blob in blobs:
        moved = pose.copy()
        if own is not None and own.any():
            moved[:3, 3] += blob.centre - centre_of(own, tracker.misfit.canvas.depth, tracker.camera)
        else:
            ray = blob.centre / np.linalg.norm(blob.centre)
            moved[:3, 3] = blob.centre + 0.03 * ray
        found.append(moved)
    return found
