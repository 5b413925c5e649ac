"""A mixture in every pixel: the surface, an outlier anywhere in range, or no return, which is likelier at edges."""

import math
from collections.abc import Mapping

import numpy as np

from derender.errors import DerenderError
from derender.registry import Parameter
from derender.render.likelihoods.base import BACKGROUND, BLUR, SIGMA, Likelihood, blurred_depth, likelihoods, with_wall

RATE = (1e-30, 1.0 - 1e-12)  # of a share: its logarithm and that of the rest are finite; {uniform: [0, 1]} fits in


@likelihoods.register("robust")
class Robust(Likelihood):
    """With m the blurred depth and d the clean one, a pixel

        has no return with probability q = `missing_edge` at an edge, else `missing`;
        otherwise its density is (1 - outlier) Norm(m, sigma + sigma_growth m^2) + outlier Uniform(near, far).

    An edge is a pixel at which the second difference of d along the row or the column is more than `edge_step`:
    surfaces that are flat in space, at whatever slant, have next to none. A pixel's value is a depth or "no return", so
    missing pixels count: a hole where the scene has no edge is evidence.

    A pixel may show what is no part of the scene: background, or a thing of no known form. Nothing is known of such a
    surface but that it is where it was seen, unless the scene hides it. Such a pixel holds minus that depth, and its
    density is the one above with min(m, that depth) in place of m: solids behind it make no difference, and those
    before it are as improbable as they would be before any other surface.
    """

    parameters = (
        SIGMA,
        BLUR,
        BACKGROUND,
        Parameter("sigma_growth", "1/m", 0.0, 1.0, 0.0),
        Parameter("outlier", "", *RATE, 0.02),
        Parameter("near", "m", 0.0, 1000.0, 0.1),
        Parameter("far", "m", 0.0, 1000.0, 10.0),
        Parameter("missing", "", *RATE, 0.02),
        Parameter("missing_edge", "", *RATE, 0.3),
        Parameter("edge_step", "m", 1e-4, 100.0, 0.02),
    )
    code = 1

    def check(self, values: Mapping[str, float]) -> None:
        if not values["near"] < values["far"]:
            raise DerenderError("outliers range from far to near", "likelihood.far", "give a far beyond near")

    def row(self, values: Mapping[str, float]) -> np.ndarray:
        names = ("sigma_growth", "outlier", "near", "far", "missing", "missing_edge", "edge_step")
        return np.array([values["sigma"], values["background"], 0.0, *(values[name] for name in names)])

    def missing_rate(self, depth: np.ndarray, values: dict[str, float]) -> np.ndarray:
        """Return the probability of no return, (H, W)."""
        padded = np.pad(with_wall(depth, values["background"]), 1, mode="edge")
        middle = 2.0 * padded[1:-1, 1:-1]
        along = np.abs(padded[1:-1, :-2] + padded[1:-1, 2:] - middle)
        down = np.abs(padded[:-2, 1:-1] + padded[2:, 1:-1] - middle)
        edge = np.maximum(along, down) > values["edge_step"]
        return np.where(edge, values["missing_edge"], values["missing"])

    def per_pixel(
        self, observed: np.ndarray, depth: np.ndarray, values: Mapping[str, float] | None = None
    ) -> np.ndarray:
        values = self.complete(values)
        value = np.abs(np.where(np.isfinite(observed), observed, 0.0))
        seen, model, missing = value > 0.0, blurred_depth(depth, values), self.missing_rate(depth, values)
        model = np.where(seen & (observed < 0.0), np.minimum(model, value), model)
        spread = values["sigma"] + values["sigma_growth"] * model**2
        surface = np.exp(-0.5 * ((value - model) / spread) ** 2) / (spread * math.sqrt(2.0 * math.pi))
        inside = (value >= values["near"]) & (value <= values["far"])
        floor = values["outlier"] / (values["far"] - values["near"])
        returned = (1.0 - values["outlier"]) * surface + np.where(inside, floor, 1e-30)
        return np.where(seen, np.log((1.0 - missing) * returned), np.log(missing))

    def sample(
        self, rng: np.random.Generator, depth: np.ndarray, values: Mapping[str, float] | None = None
    ) -> np.ndarray:
        values = self.complete(values)
        model, missing = blurred_depth(depth, values), self.missing_rate(depth, values)
        spread = values["sigma"] + values["sigma_growth"] * model**2
        result = model + spread * rng.standard_normal(depth.shape)
        outliers = rng.random(depth.shape) < values["outlier"]
        result[outliers] = rng.uniform(values["near"], values["far"], size=int(outliers.sum()))
        return np.where((rng.random(depth.shape) < missing) | (result <= 0.0), np.nan, result)
