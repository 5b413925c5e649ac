"""The blur b of Eq. 6: a Gaussian, cut off at three standard deviations, with replicated edges."""

import math
from functools import lru_cache

import numpy as np


def blur_radius(sigma: float) -> int:
    """Return how many pixels the blur reaches: three standard deviations, rounded up."""
    return int(math.ceil(3.0 * sigma))


def blur_taps(sigma: float) -> np.ndarray:
    """Return the weights from the centre outwards: (radius + 1,) float64; over both sides they sum to 1.

    sigma : standard deviation in pixels; 0 is no blur.
    """
    return _taps(float(sigma)).copy()


@lru_cache(maxsize=64)  # chains whose blur is open draw it from the same few again and again
def _taps(sigma: float) -> np.ndarray:
    radius = blur_radius(sigma)
    if radius == 0:
        return np.ones(1)
    taps = np.exp(-0.5 * (np.arange(radius + 1) / sigma) ** 2)
    return taps / (taps[0] + 2.0 * taps[1:].sum())


def blur(image: np.ndarray, sigma: float) -> np.ndarray:
    """Blur an (H, W) image along both axes, edges replicated, in float64.

    The same as `scipy.ndimage.gaussian_filter(image, sigma, mode="nearest", radius=blur_radius(sigma))`, whose import
    takes longer than many images.
    """
    image = np.asarray(image, np.float64)
    taps = blur_taps(sigma)
    for axis in (0, 1):
        image = blur_along(image, taps, axis)
    return image


def blur_along(image: np.ndarray, taps: np.ndarray, axis: int) -> np.ndarray:
    """Blur an (H, W) image along one axis, with the weights of `blur_taps`."""
    radius, length = len(taps) - 1, image.shape[axis]
    padded = image.take(np.clip(np.arange(-radius, length + radius), 0, length - 1), axis=axis)

    def shifted(by: int) -> np.ndarray:
        inside = slice(radius + by, radius + by + length)
        return padded[inside] if axis == 0 else padded[:, inside]

    blurred = taps[0] * shifted(0)
    both = np.empty_like(blurred)
    for k in range(1, radius + 1):
        np.add(shifted(-k), shifted(k), out=both)
        both *= taps[k]
        blurred += both
    return blurred
