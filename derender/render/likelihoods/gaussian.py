"""Independent normals around the blurred depth image: Eq. 6."""

import math
from collections.abc import Mapping

import numpy as np

from derender.render.likelihoods.base import BACKGROUND, BLUR, SIGMA, Likelihood, blurred_depth, has_return, likelihoods


@likelihoods.register("gaussian")
class Gaussian(Likelihood):
    """Norm(observed; b(d), sigma) in every pixel with a return; a pixel without one is evidence of nothing."""

    parameters = (SIGMA, BLUR, BACKGROUND)
    code = 0

    def row(self, values: Mapping[str, float]) -> np.ndarray:
        return np.array([values["sigma"], values["background"], 0.0])

    def per_pixel(
        self, observed: np.ndarray, depth: np.ndarray, values: Mapping[str, float] | None = None
    ) -> np.ndarray:
        values = self.complete(values)
        seen = has_return(observed)
        spread = values["sigma"]
        residual = np.where(seen, observed, 0.0) - blurred_depth(depth, values)
        density = -0.5 * (residual / spread) ** 2 - math.log(spread) - 0.5 * math.log(2.0 * math.pi)
        return np.where(seen, density, 0.0)

    def sample(
        self, rng: np.random.Generator, depth: np.ndarray, values: Mapping[str, float] | None = None
    ) -> np.ndarray:
        values = self.complete(values)
        return blurred_depth(depth, values) + rng.normal(scale=values["sigma"], size=depth.shape)
