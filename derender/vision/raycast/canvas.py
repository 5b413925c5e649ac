"""What the antialiased renderer draws on: rows of inverse depth, codes of faces, pixels that a line divides."""

from typing import NamedTuple

import numpy as np

from derender.kernel_cache import njit
from derender.vision.raycast.convex import PREPARED, prepare_solid

SAMPLES = 64
GENERATOR = 19  # of the lattice: spreads the projections on every direction
QUADRIC = 3  # the "face" number of a curved surface; 0, 1, 2 are the front faces in the order of `prepared`
FACE_BITS = 24
FACE_MASK = (1 << FACE_BITS) - 1
NOTHING = -1
SPLIT = -2  # the first of a mixed pixel's codes, if a straight line divides it: then `split` holds the parts


class Canvas(NamedTuple):
    """Arrays of one antialiased rendering, made by `new_canvas` and written by `draw_antialiased`.

    Attributes
    ----------
    camera : (4,) float64 fx, fy, cx, cy. offsets : (SAMPLES, 2) float64, sample points about the pixel's centre.
    prepared : (N, PREPARED), rectangle : (N, 4) int64, of every solid; the rectangle one pixel wider than its centres'.
    inverse : (H, W) float64, inverse depth at pixel centres. code : (H, W) int64, what is seen there:
        (solid << FACE_BITS) + face, or NOTHING. mixed : (H, W) uint8, 1 where a pixel is sampled.
    depth : (H, W) float64, the antialiased image in metres.
    mixed_pixels : (H * W,) int32, row * W + column of the mixed ones. samples : (H * W, SAMPLES) int64, their codes;
        or SPLIT and the codes of two parts, whose area and centroid (share, x, y) are in split : (H * W, 2, 3).
    count : (1,) int64, how many there are.
    """

    camera: np.ndarray
    offsets: np.ndarray
    prepared: np.ndarray
    rectangle: np.ndarray
    inverse: np.ndarray
    code: np.ndarray
    mixed: np.ndarray
    depth: np.ndarray
    mixed_pixels: np.ndarray
    samples: np.ndarray
    split: np.ndarray
    count: np.ndarray


def new_canvas(camera, solids: int) -> Canvas:
    """Allocate a Canvas for a Camera and this many solids."""
    height, width = camera.height, camera.width
    k = np.arange(SAMPLES)
    offsets = np.stack([(k + 0.5) / SAMPLES, (k * GENERATOR / SAMPLES + 0.5 / SAMPLES) % 1.0], axis=1) - 0.5
    return Canvas(
        np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64),
        offsets,
        np.zeros((solids, PREPARED)),
        np.zeros((solids, 4), np.int64),
        np.zeros((height, width)),
        np.zeros((height, width), np.int64),
        np.zeros((height, width), np.uint8),
        np.zeros((height, width)),
        np.zeros(height * width, np.int32),
        np.zeros((height * width, SAMPLES), np.int64),
        np.zeros((height * width, 2, 3)),
        np.zeros(1, np.int64),
    )


@njit(cache=True, nogil=True)
def prepare_all(canvas, kinds, poses, sizes):
    """Prepare every solid and widen its rectangle by a pixel: a solid may reach into pixels whose centres it misses."""
    height, width = canvas.depth.shape
    for k in range(kinds.shape[0]):
        rectangle = canvas.rectangle[k]
        prepare_solid(kinds[k], poses[k], sizes[k], canvas.camera, width, height, canvas.prepared[k], rectangle)
        if rectangle[0] < rectangle[1]:
            rectangle[0], rectangle[1] = max(rectangle[0] - 1, 0), min(rectangle[1] + 1, width)
            rectangle[2], rectangle[3] = max(rectangle[2] - 1, 0), min(rectangle[3] + 1, height)
