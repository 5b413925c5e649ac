"""A sparse Jacobian of a depth image by the motions of solids, and its products with motions."""

from typing import NamedTuple

import numpy as np

from derender.compilation.cache import njit

MOTION = 9  # twist (v, w) and the rates of the three extents


class Records(NamedTuple):
    """The Jacobian of the antialiased image by every solid's motion: d depth[pixel] = sum over records form .
    motion[solid].

    Attributes
    ----------
    pixel : (M,) int32, row * W + column. solid : (M,) int32. form : (M, MOTION) float64; only the first `filled[0]`
        are filled.
    filled : (1,) int64, how many are.
    """

    pixel: np.ndarray
    solid: np.ndarray
    form: np.ndarray
    filled: np.ndarray


def new_records(camera, solids: int) -> Records:
    """Allocate Records for a Camera and this many solids: four for every pixel, and the outlines."""
    size = 4 * camera.width * camera.height + solids * 16 * (camera.width + camera.height)
    return Records(
        np.zeros(size, np.int32),
        np.zeros(size, np.int32),
        np.zeros((size, MOTION)),
        np.zeros(1, np.int64),
    )


@njit(cache=True, nogil=True)
def spread(records, motions, moves, images):
    """Forward mode: add the derivative of the antialiased image by parameters to images (P, H * W).

    motions : (P, N, MOTION) float64, the motion of each solid per unit of each parameter; moves : (P, N) bool, where
    that is not zero.
    """
    for m in range(records.filled[0]):
        pixel, form = records.pixel[m], records.form[m]
        k = records.solid[m]
        for p in range(motions.shape[0]):
            if moves[p, k]:
                motion = motions[p, k]
                value = 0.0
                for c in range(MOTION):
                    value += form[c] * motion[c]
                images[p, pixel] += value
