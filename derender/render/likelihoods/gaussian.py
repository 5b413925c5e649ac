"""Independent normals around the blurred depth image: Eq. 6."""

import math
from collections.abc import Mapping

import numpy as np

from derender.render.likelihoods.base import (
    BACKGROUND,
    BLUR,
    EFFECTIVE_PIXELS,
    SIGMA,
    Likelihood,
    blurred_depth,
    has_return,
    likelihoods,
    temper,
)


@likelihoods.register("gaussian")
class Gaussian(Likelihood):
    """Norm(observed; b(d), sigma) in every pixel with a return; a pixel without one is evidence of nothing."""

    parameters = (SIGMA, BLUR, BACKGROUND, EFFECTIVE_PIXELS)
    code = 0

    def counted_pixels(self, observed: np.ndarray) -> int:
        return int(has_return(observed).sum())

    def row(self, values: Mapping[str, float], pixels: int) -> np.ndarray:
        return np.array([values["sigma"], values["background"], temper(values, pixels), 0.0])

    def per_pixel(
        self, observed: np.ndarray, depth: np.ndarray, values: Mapping[str, float] | None = None
    ) -> np.ndarray:
        values = self.complete(values)
        seen = has_return(observed)
        spread = values["sigma"] / math.sqrt(temper(values, self.counted_pixels(observed)))
        residual = np.where(seen, observed, 0.0) - blurred_depth(depth, values)
        density = -0.5 * (residual / spread) ** 2 - math.log(spread) - 0.5 * math.log(2.0 * math.pi)
        return np.where(seen, density, 0.0)

    def sample(
        self, rng: np.random.Generator, depth: np.ndarray, values: Mapping[str, float] | None = None
    ) -> np.ndarray:
        values = self.complete(values)
        spread = values["sigma"] / math.sqrt(temper(values, depth.size))
        return blurred_depth(depth, values) + rng.normal(scale=spread, size=depth.shape)
