"""Noise that neighbouring pixels share: each pixel is predicted from earlier ones of its surface, or an outlier.

The factors of a nearest-neighbour Gaussian process in the order of reading: Vecchia, Journal of the Royal Statistical
Society B, 1988; Datta, Banerjee, Finley and Gelfand, Journal of the American Statistical Association, 2016.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from derender.errors import DerenderError
from derender.registry import Parameter
from derender.render.likelihoods.base import BACKGROUND, BLUR, SIGMA, Likelihood, blurred_depth, likelihoods, with_wall

# (rows up, columns to the left) of the earlier neighbours, and which of them tell together: one, one, and four
NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0))
GROUPS = (0, 1, 2, 2, 2, 2)
MEMBERS = (np.arange(8)[:, None] >> np.array(GROUPS)) % 2 == 1  # (8, 6), which neighbours tell in each set of groups
PLACES = np.array([(0, 0), *NEIGHBOURS], float)
APART = np.moveaxis(PLACES[:, None] - PLACES[None], -1, 0)  # (2, 7, 7), rows and columns between a pixel and those
SHARE = (1e-5, 1.0 - 1e-3)  # of the variance that is each pixel's own: both it and the rest are some
REACH = (1e-9, 1e9)  # pixels: a chain may go wherever a distribution over it lets it
NOTHING_SHARED = 700.0  # reaches apart, at which exp(-h) is still above 0
RATE = (1e-30, 0.5)  # of outliers
# Times as wide as the others are the heavy tails' innovations, about those of rounded disparities on real frames; the
# compiled score counts on it
WIDER = 4.0
LIMIT = 4.0  # standard deviations of a residual from which a pixel is an outlier, and tells the next ones nothing


class Factors(NamedTuple):
    """Of each pixel (H, W): the residual in standard deviations, its mean given earlier ones, and the deviation about
    that; the inverse of the noise's standard deviation in metres; whether it holds a depth."""

    residual: np.ndarray
    mean: np.ndarray
    deviation: np.ndarray
    inverse: np.ndarray
    seen: np.ndarray


@likelihoods.register("correlated")
class Correlated(Likelihood):
    """With m the blurred depth and g = sigma + sigma_growth m^2, the noise (observed - m) / g is a Gaussian field with

        covariance = white [same pixel] + (1 - white) (1 + h) exp(-h) + bias^2,
        h^2 = (columns apart / reach)^2 + (rows apart / reach_down)^2:

    each pixel's own noise, what neighbours share (a Matern field of smoothness 3/2), and a slow bias that spans the
    frame. Each pixel has the normal density that this gives it given those of its earlier neighbours that tell of it:
    the one to the left, the one above, and the four beyond (both diagonals, two to the left, two above) together. None
    tells that has no return, is an outlier (over four standard deviations off), or lies across a jump in the clean
    depth of more than `jump` of it; four of which one does not tell do not tell at all. The order is that of reading,
    so the product of all pixels' densities integrates to one for each set of pixels that return.

    Files in data/sensors give it under `likelihood:`. So may a scene, or a copy of the prior bare-image: then draws and
    weights of structures are under it.

    Innovations of real sensors have heavy tails: a share `tail` of them is four times as wide, and `outlier` of the
    pixels are Uniform(near, far). A pixel without a return is evidence of nothing. One that holds minus a depth shows
    what is no part of the scene: see `robust`.
    """

    parameters = (
        SIGMA,
        BLUR,
        BACKGROUND,
        Parameter("sigma_growth", "1/m", 0.0, 1.0, 0.0),
        Parameter("white", "", *SHARE, 0.05),
        Parameter("reach", "", *REACH, 4.0),
        Parameter("reach_down", "", *REACH, 2.0),
        Parameter("bias", "", 0.0, 100.0, 1.0),
        Parameter("tail", "", 0.0, SHARE[1], 0.1),
        Parameter("outlier", "", *RATE, 0.02),
        Parameter("near", "m", 0.0, 1000.0, 0.1),
        Parameter("far", "m", 0.0, 1000.0, 10.0),
        Parameter("jump", "", 1e-4, 100.0, 0.04),
    )
    code = 2

    def check(self, values: Mapping[str, float]) -> None:
        if not values["near"] < values["far"]:
            raise DerenderError("outliers range from far to near", "likelihood.far", "give a far beyond near")

    def counted_pixels(self, observed: np.ndarray) -> int:
        return int((np.isfinite(observed) & (observed != 0.0)).sum())

    def row(self, values: Mapping[str, float], pixels: int) -> np.ndarray:
        weights, deviations = prediction(values)
        numbers = [values[name] for name in ("sigma_growth", "outlier", "near", "far", "tail")]
        numbers = [values["sigma"], values["background"], 1.0, 0.0, *numbers, values["jump"], most(values)]
        return np.concatenate([numbers, weights.ravel(), 1.0 / deviations])

    def factors(self, observed: np.ndarray, depth: np.ndarray, values: Mapping[str, float]) -> Factors:
        """Return the Factors of an image under complete values."""
        value = np.abs(np.where(np.isfinite(observed), observed, 0.0))
        seen, model = value > 0.0, blurred_depth(depth, values)
        model = np.where(seen & (observed < 0.0), np.minimum(model, value), model)
        inverse = 1.0 / (values["sigma"] + values["sigma_growth"] * model**2)
        residual = np.where(seen, (value - model) * inverse, 0.0)
        tells = links(depth, values)
        telling = seen & (observed > 0.0) & (np.abs(residual) <= tells.limit)
        mean, deviation = tells.predict(np.pad(residual, 2), np.pad(telling, 2), *np.indices(depth.shape))
        return Factors(residual, mean, deviation, inverse, seen)

    def per_pixel(
        self, observed: np.ndarray, depth: np.ndarray, values: Mapping[str, float] | None = None
    ) -> np.ndarray:
        values = self.complete(values)
        found = self.factors(observed, depth, values)
        z = (found.residual - found.mean) / found.deviation
        narrow, wide = np.exp(-0.5 * z**2), np.exp(-0.5 * (z / WIDER) ** 2) / WIDER
        surface = (1.0 - values["tail"]) * narrow + values["tail"] * wide
        surface *= found.inverse / (found.deviation * math.sqrt(2.0 * math.pi))
        depths = np.abs(np.where(found.seen, observed, 0.0))
        inside = (depths >= values["near"]) & (depths <= values["far"])
        floor = values["outlier"] / (values["far"] - values["near"])
        density = (1.0 - values["outlier"]) * surface + np.where(inside, floor, 1e-30)
        return np.where(found.seen, np.log(density), 0.0)

    def whitened(self, observed: Any, depth: np.ndarray, values: Any = None) -> np.ndarray:
        """Return an image's noise (H, W) without what earlier neighbours tell of it, NaN where nothing returned.

        Each pixel's quantile among those that it might have had given these, as the quantile of a normal number: under
        the right values independent standard normal numbers.
        """
        from scipy.special import ndtr, ndtri

        values = self.complete(values)
        found = self.factors(observed, depth, values)
        z = (found.residual - found.mean) / found.deviation
        below = (1.0 - values["tail"]) * ndtr(z) + values["tail"] * ndtr(z / WIDER)
        extent = values["far"] - values["near"]
        nearer = np.clip((np.abs(np.where(found.seen, observed, 0.0)) - values["near"]) / extent, 0.0, 1.0)
        below = (1.0 - values["outlier"]) * below + values["outlier"] * nearer
        return np.where(found.seen, ndtri(np.clip(below, 1e-15, 1.0 - 1e-15)), np.nan)

    def sample(
        self, rng: np.random.Generator, depth: np.ndarray, values: Mapping[str, float] | None = None
    ) -> np.ndarray:
        values = self.complete(values)
        model = blurred_depth(depth, values)
        deviation = values["sigma"] + values["sigma_growth"] * model**2
        noise = rng.standard_normal(depth.shape)
        noise = np.where(rng.random(depth.shape) < values["tail"], WIDER * noise, noise)
        outliers = rng.random(depth.shape) < values["outlier"]
        anywhere = (rng.uniform(values["near"], values["far"], depth.shape) - model) / deviation
        tells, residual = links(depth, values), np.zeros([side + 4 for side in depth.shape])
        telling = np.zeros(residual.shape, bool)
        rows, columns = np.indices(depth.shape).reshape(2, -1)
        front = columns + 2 * rows  # a pixel's neighbours lie on earlier fronts, so those of one are drawn together
        order = np.argsort(front, kind="stable")
        for at in np.split(order, np.cumsum(np.bincount(front))[:-1]):
            pixel = rows[at], columns[at]
            mean, spread = tells.predict(residual, telling, *pixel)
            drawn = np.where(outliers[pixel], anywhere[pixel], mean + spread * noise[pixel])
            place = rows[at] + 2, columns[at] + 2
            residual[place], telling[place] = drawn, np.abs(drawn) <= tells.limit
        result = model + deviation * residual[2:-2, 2:-2]
        return np.where(result > 0.0, result, np.nan)


def covariance(rows: np.ndarray, columns: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
    """Return the covariance of unit noise of pixels so many rows and columns apart."""
    h = np.minimum(np.hypot(columns / values["reach"], rows / values["reach_down"]), NOTHING_SHARED)
    own = np.where((rows == 0) & (columns == 0), values["white"], 0.0)
    return own + (1.0 - values["white"]) * (1.0 + h) * np.exp(-h) + values["bias"] ** 2


def most(values: Mapping[str, float]) -> float:
    """Return the unit noise beyond which a pixel is an outlier, which tells the next ones nothing."""
    return LIMIT * math.sqrt(1.0 + values["bias"] ** 2)


def prediction(values: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return (6, 8) weights of the neighbours and (8,) deviations about what they predict, for each set of groups.

    Set s has group k where s has bit k.
    """
    matrix = covariance(APART[0], APART[1], values)
    # one system for each set: neighbours that are not of it are apart, and weigh nothing
    both = MEMBERS[:, :, None] & MEMBERS[:, None]
    among = np.where(both, matrix[1:, 1:], np.eye(len(NEIGHBOURS)))
    with_it = np.where(MEMBERS, matrix[1:, 0], 0.0)
    weights = np.linalg.solve(among, with_it[..., None])[..., 0]
    return weights.T, np.sqrt(matrix[0, 0] - np.sum(weights * with_it, axis=1))


class Links(NamedTuple):
    """Which pixels tell of which. same : (6, H, W) bool, whether a neighbour is in the image and on a pixel's surface.
    weights : (6, 8), deviations : (8,), see `prediction`. limit : unit noise from which a pixel tells nothing."""

    same: np.ndarray
    weights: np.ndarray
    deviations: np.ndarray
    limit: float

    def predict(self, residual: Any, telling: Any, rows: Any, columns: Any) -> Any:
        """Return the mean and the deviation of unit noise at pixels (any shape), given what earlier ones hold.

        residual : (H + 4, W + 4), telling : bool, whether each tells at all; two pixels wider than the image all round.
        """
        some, near = np.zeros(rows.shape, np.int64), []
        told = [np.ones(rows.shape, bool) for _ in range(3)]
        for (up, left), group, same in zip(NEIGHBOURS, GROUPS, self.same, strict=True):
            place = rows + 2 - up, columns + 2 - left
            told[group] &= telling[place] & same[rows, columns]
            near.append(residual[place])
        for group in range(3):
            some += told[group] * 2**group
        return sum(self.weights[k, some] * each for k, each in enumerate(near)), self.deviations[some]


def links(depth: np.ndarray, values: Mapping[str, float]) -> Links:
    """Return the Links of a clean depth image (H, W)."""
    clean = with_wall(depth, values["background"])
    (height, width), padded = clean.shape, np.pad(clean, 2, constant_values=np.nan)
    near = [padded[2 - up : 2 - up + height, 2 - left : 2 - left + width] for up, left in NEIGHBOURS]
    same = np.abs(np.array(near) - clean) <= values["jump"] * clean
    return Links(same, *prediction(values), most(values))
