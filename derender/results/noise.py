"""The noise that an image shows by itself: how depths scatter about planes on patches that are flat.

Inference fits a noise too, about the scene that it found; where that scene is wrong the fit is far above this one.
"""

from typing import NamedTuple

import numpy as np

PATCHES_ABREAST, SMALLEST = 40, 6  # patches in a row of the image; pixels of a patch's side at least
FLAT = 0.25  # share of the patches that surely show one flat surface and nothing else
LEAST_PATCHES = 8  # fewer tell nothing


class Noise(NamedTuple):
    """Standard deviation sigma_0 + growth z^2 at a depth z, metres.

    Attributes
    ----------
    sigma : at the median depth. sigma_0 : metres; growth : 1/m.
    """

    sigma: float
    sigma_0: float
    growth: float

    def at(self, depth: np.ndarray) -> np.ndarray:
        """Return the standard deviation at depths in metres."""
        return self.sigma_0 + self.growth * np.square(depth)


def flat_noise(observed: np.ndarray) -> Noise:
    """Return the Noise that the flattest patches of an image (H, W) show; none where there are too few patches.

    A plane's inverse depth is affine in the pixel's place, so that residuals of a linear fit to it are noise alone.
    A near and a far half of the patches tell whether it grows.
    """
    side = max(SMALLEST, observed.shape[1] // PATCHES_ABREAST)
    rows, columns = observed.shape[0] // side, observed.shape[1] // side
    tiles = observed[: rows * side, : columns * side].reshape(rows, side, columns, side)
    patches = tiles.swapaxes(1, 2).reshape(rows * columns, side * side)
    patches = patches[np.isfinite(patches).all(axis=1)]
    if len(patches) < LEAST_PATCHES:
        return Noise(0.0, 0.0, 0.0)
    at = np.linspace(-1.0, 1.0, side)
    design = np.column_stack([np.ones(side * side), np.repeat(at, side), np.tile(at, side)])
    basis, _ = np.linalg.qr(design)
    inverse = 1.0 / patches
    residual = inverse - (inverse @ basis) @ basis.T
    middle = np.median(patches, axis=1)
    scatter = np.sqrt((residual**2).sum(axis=1) / (side * side - 3)) * middle**2
    near = middle <= np.median(middle)
    square = np.array([np.mean(middle[half] ** 2) for half in (near, ~near) if half.any()])
    spread = np.array([np.quantile(scatter[half], FLAT) for half in (near, ~near) if half.any()])
    growth = float((spread[-1] - spread[0]) / (square[-1] - square[0])) if square[-1] > square[0] else 0.0
    growth = float(np.clip(growth, 0.0, spread[0] / square[0]))  # from nothing at no distance, at most
    sigma_0 = float(spread[0] - growth * square[0])
    return Noise(float(sigma_0 + growth * np.median(middle) ** 2), sigma_0, growth)
