"""The blur b of Eq. 6: a Gaussian, cut off at three standard deviations, with replicated edges."""

import math
from functools import lru_cache

import numpy as np

from derender.compilation.cache import interpreted, njit


@njit(cache=True, nogil=True, borrows=True)
def reach(sigma):
    """Return how many pixels the blur reaches: three standard deviations, rounded up."""
    return int(math.ceil(3.0 * sigma))


@njit(cache=True, nogil=True, borrows=True)
def write_taps(sigma, taps):
    """Write the weights from the centre outwards into taps (> radius,), over both sides 1 in all; return the radius."""
    radius, total = reach(sigma), 0.0
    for k in range(radius + 1):
        total += math.exp(-0.5 * (k / sigma) ** 2) if k else 1.0
    total = 2.0 * total - 1.0
    for k in range(radius + 1):
        taps[k] = (math.exp(-0.5 * (k / sigma) ** 2) if k else 1.0) / total
    return radius


blur_radius, _write_taps = interpreted(reach), interpreted(write_taps)


def blur_taps(sigma: float) -> np.ndarray:
    """Return the weights from the centre outwards: (radius + 1,) float64; over both sides they sum to 1.

    sigma : standard deviation in pixels; 0 is no blur.
    """
    return _taps(float(sigma)).copy()


@lru_cache(maxsize=64)  # chains whose blur is open draw it from the same few again and again
def _taps(sigma: float) -> np.ndarray:
    taps = np.empty(blur_radius(sigma) + 1)
    _write_taps(sigma, taps)
    return taps


def blur(image: np.ndarray, sigma: float) -> np.ndarray:
    """Blur an (H, W) image along both axes, edges replicated, in float64.

    The same as `scipy.ndimage.gaussian_filter(image, sigma, mode="nearest", radius=blur_radius(sigma))`, whose import
    takes longer than many images.
    """
    return weighed_along_both(image, blur_taps(sigma))


def weighed_along_both(image: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """Return an (H, W) image whose pixels are weighed along both axes, edges replicated, in float64.

    taps : (radius + 1,) weights from the centre outwards.
    """
    image = np.ascontiguousarray(image, np.float64)
    height, width = image.shape
    found = np.empty(image.shape)
    blur_into(taps, image, 0, width, 0, height, found)
    return found


@njit(cache=True, nogil=True)
def blur_into(taps, image, i0, i1, j0, j1, out):
    """Blur pixels i0..i1 of rows j0..j1 (ends excluded) of an image (H, W), its edges replicated, into out."""
    height, width = image.shape
    radius, count = taps.size - 1, i1 - i0
    top, bottom = max(j0 - radius, 0), min(j1 + radius, height)
    rows, line = np.empty((bottom - top, count)), np.empty(count + 2 * radius)
    for j in range(top, bottom):
        for n in range(line.size):
            line[n] = image[j, min(max(i0 - radius + n, 0), width - 1)]
        weigh(taps[0], line[radius : radius + count], line[radius : radius + count], 0.0, rows[j - top])
        for k in range(1, radius + 1):
            weigh(taps[k], line[radius - k : radius - k + count], line[radius + k : radius + k + count], 1.0,
                  rows[j - top])  # fmt: skip
    for j in range(j0, j1):
        weigh(taps[0], rows[j - top], rows[j - top], 0.0, out[j - j0])
        for k in range(1, radius + 1):
            weigh(taps[k], rows[max(j - k, 0) - top], rows[min(j + k, height - 1) - top], 1.0, out[j - j0])


@njit(cache=True, nogil=True, borrows=True)
def weigh(tap, one, other, kept, out):
    """Write kept * out plus `tap` times two rows (n,), or the one where they are the same row, into out (n,)."""
    share = tap if kept > 0.0 else 0.5 * tap
    if kept == 0.0:
        for n in range(out.size):
            out[n] = share * (one[n] + other[n])
    else:
        for n in range(out.size):
            out[n] += share * (one[n] + other[n])
