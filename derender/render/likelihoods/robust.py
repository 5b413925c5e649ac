"""A mixture in every pixel: the surface, an outlier anywhere in range, or no return, which is likelier at edges."""

import functools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.registry import Parameter
from derender.render.likelihoods.base import (
    BACKGROUND,
    BLUR,
    EFFECTIVE_PIXELS,
    SIGMA,
    Likelihood,
    blurred_depth,
    likelihoods,
    temper,
    with_wall,
)

RATE = (1e-30, 1.0 - 1e-12)  # of a share: its logarithm and that of the rest are finite; {uniform: [0, 1]} fits in
DEGREE = 7  # of the polynomial in depth for the log normaliser of a tempered pixel
KEPT = 256  # normalisers that are not computed anew: sensors that differ in their blur alone share one


@functools.cache
def _quadrature() -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights on [-1, 1]."""
    return np.polynomial.legendre.leggauss(200)


@functools.lru_cache(maxsize=KEPT)
def _normaliser(
    sigma: Any, growth: Any, outlier: Any, near: Any, far: Any, background: Any, exponent: Any, missing: Any
) -> np.ndarray:
    """Return what `Robust.normaliser` does, through its values at Chebyshev's points between 0 and the background."""
    shares = 0.5 + 0.5 * np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))
    spread = sigma + growth * np.square(background * shares)
    extent = far - near
    floor = outlier / extent
    height = (1.0 - outlier) / (spread * math.sqrt(2.0 * math.pi))
    # In z = |x - m| / spread the integrand is smooth; beyond `reach` the normal is below the floor's last digit.
    reach = np.sqrt(2.0 * np.maximum(np.log(height / floor) + 40.0, 1.0))
    nodes, weights = _quadrature()
    z = 0.5 * reach[:, None] * (nodes + 1.0)
    excess = (height[:, None] * np.exp(-0.5 * z * z) + floor) ** exponent - floor**exponent
    integral = extent * floor**exponent + reach * spread * (excess @ weights)
    logs = np.log(missing**exponent + (1.0 - missing) ** exponent * integral)
    found = np.linalg.solve(np.vander(shares, increasing=True), logs) / background ** np.arange(DEGREE + 1)
    if growth == 0.0:
        found[0], found[1:] = logs[0], 0.0
    found.flags.writeable = False
    return found


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
        EFFECTIVE_PIXELS,
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

    def counted_pixels(self, observed: np.ndarray) -> int:
        return int(np.size(observed))

    def row(self, values: Mapping[str, float], pixels: int) -> np.ndarray:
        exponent = temper(values, pixels)
        numbers = [
            values["sigma"],
            values["background"],
            exponent,
            0.0,
            values["sigma_growth"],
            values["outlier"],
            values["near"],
            values["far"],
            values["missing"],
            values["missing_edge"],
            values["edge_step"],
        ]
        return np.concatenate(
            [numbers, *(self.normaliser(values, exponent, q) for q in (values["missing"], values["missing_edge"]))]
        )

    def normaliser(self, values: Any, exponent: float, missing: float) -> np.ndarray:
        """Return the polynomial in m, (DEGREE + 1,) from the constant on, of a tempered pixel's log normaliser.

        log of missing^t + integral ((1 - missing) f)^t, f the density of a return; exact where sigma does not grow.
        """
        if exponent == 1.0:
            return np.zeros(DEGREE + 1)
        names = ("sigma", "sigma_growth", "outlier", "near", "far", "background")
        return _normaliser(*(values[name] for name in names), exponent, missing)

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
        exponent = temper(values, self.counted_pixels(observed))
        value = np.abs(np.where(np.isfinite(observed), observed, 0.0))
        seen, model, missing = value > 0.0, blurred_depth(depth, values), self.missing_rate(depth, values)
        model = np.where(seen & (observed < 0.0), np.minimum(model, value), model)
        spread = values["sigma"] + values["sigma_growth"] * model**2
        surface = np.exp(-0.5 * ((value - model) / spread) ** 2) / (spread * math.sqrt(2.0 * math.pi))
        inside = (value >= values["near"]) & (value <= values["far"])
        floor = values["outlier"] / (values["far"] - values["near"])
        returned = (1.0 - values["outlier"]) * surface + np.where(inside, floor, 1e-30)
        density = np.where(seen, np.log((1.0 - missing) * returned), np.log(missing))
        if exponent == 1.0:
            return density
        rates = np.array([values["missing"], values["missing_edge"]])
        normalisers = [np.polynomial.polynomial.polyval(model, self.normaliser(values, exponent, q)) for q in rates]
        return exponent * density - np.where(missing == rates[1], normalisers[1], normalisers[0])

    def sample(
        self, rng: np.random.Generator, depth: np.ndarray, values: Mapping[str, float] | None = None
    ) -> np.ndarray:
        values = self.complete(values)
        exponent = temper(values, depth.size)
        model, missing = blurred_depth(depth, values), self.missing_rate(depth, values)
        spread = values["sigma"] + values["sigma_growth"] * model**2
        outlier, extent = values["outlier"], values["far"] - values["near"]
        if exponent == 1.0:
            result = model + spread * rng.standard_normal(depth.shape)
            outliers = rng.random(depth.shape) < outlier
            result[outliers] = rng.uniform(values["near"], values["far"], size=int(outliers.sum()))
            return np.where((rng.random(depth.shape) < missing) | (result <= 0.0), np.nan, result)
        # (a + b)^t <= a^t + b^t: draw from the mixture of the tempered parts, keep with the ratio (at least 2^(t - 1)).
        height, floor = (1.0 - outlier) / (spread * math.sqrt(2.0 * math.pi)), outlier / extent
        wide = spread / math.sqrt(exponent)
        share = height**exponent * wide * math.sqrt(2.0 * math.pi)
        share = share / (share + floor**exponent * extent)
        result = np.empty(depth.shape)
        todo = np.ones(depth.shape, bool)
        while todo.any():
            n = int(todo.sum())
            m, h = model[todo], height[todo]
            from_surface = rng.uniform(size=n) < share[todo]
            x = np.where(from_surface, rng.normal(m, wide[todo]), rng.uniform(values["near"], values["far"], size=n))
            a = h * np.exp(-0.5 * ((x - m) / spread[todo]) ** 2)
            b = np.where((x >= values["near"]) & (x <= values["far"]), floor, 0.0)
            keep = rng.uniform(size=n) * (a**exponent + b**exponent) <= (a + b) ** exponent
            where = np.flatnonzero(todo)[keep]
            result.flat[where] = x[keep]
            todo.flat[where] = False
        weight = missing**exponent
        total = np.empty_like(weight)
        for q in np.unique(missing):
            at = missing == q
            total[at] = np.exp(np.polynomial.polynomial.polyval(model[at], self.normaliser(values, exponent, q)))
        lost = rng.uniform(size=depth.shape) < weight / total
        return np.where(lost | (result <= 0.0), np.nan, result)
