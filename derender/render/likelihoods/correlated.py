"""Noise that neighbouring pixels share: each pixel is predicted from earlier ones of its surface, or an outlier.

The factors of a nearest-neighbour Gaussian process in the order of reading: Vecchia, Journal of the Royal Statistical
Society B, 1988; Datta, Banerjee, Finley and Gelfand, Journal of the American Statistical Association, 2016.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from derender.compilation.cache import njit
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
# Standard deviations of a residual from which a pixel is an outlier, and tells the next ones nothing: three of the
# heavy tails'. A nearer limit breaks off what only bends, where a level that spares a few hundred pixels that wins.
LIMIT = 3.0 * WIDER
WIDEST = 2  # pixels from a jump within which, at most, either surface may show
EITHER = 0.5  # probability of the other one there: which of two it is nothing tells


class Factors(NamedTuple):
    """Of each pixel (H, W): the residual in standard deviations, its mean given earlier ones, and the deviation about
    that; by how much a metre changes the residual; whether it holds a depth."""

    residual: np.ndarray
    mean: np.ndarray
    deviation: np.ndarray
    slope: np.ndarray
    seen: np.ndarray


@likelihoods.register("correlated")
class Correlated(Likelihood):
    """With m the blurred depth and x the observed one, (x - m) / (sigma + sigma_growth m x) is a Gaussian field with

        covariance = white [same pixel] + (1 - white) (1 + h) exp(-h) + bias^2,
        h^2 = (columns apart / reach)^2 + (rows apart / reach_down)^2:

    each pixel's own noise, what neighbours share (a Matern field of smoothness 3/2), and a slow bias that spans the
    frame. In metres it is sigma + sigma_growth m^2 where it is small: a part that is even in depth, and one in its
    inverse, as disparities have it. (Were it a function of m alone, the amplitudes of all pixels would tell how far
    away a surface is, against what its depths say: those are no more than a few independent numbers.)

    Each pixel has the normal density that this gives it given those of its earlier neighbours that tell of it:
    the one to the left, the one above, and the four beyond (both diagonals, two to the left, two above) together. None
    tells that has no return, is an outlier (over twelve standard deviations off), or lies across a jump in the clean
    depth of more than `jump` of it; four of which one does not tell do not tell at all. The order is that of reading,
    so the product of all pixels' densities integrates to one for each set of pixels that return.

    Files in data/sensors give it under `likelihood:`. So may a scene, or a copy of the prior bare-image: then draws and
    weights of structures are under it.

    Real sensors fatten things, or lose their rims: a pixel up to `edge` pixels from a jump, along its row or column,
    shows the surface beyond as likely as its own. (A jump is where the clean depth's second difference over one pixel,
    or over two, is more than `jump` of it; the farthest pixel there shows the other surface. Of a width of 1.3 a pixel
    one away may, and one two away with .3 of that probability.) A share `flying` of those that do not show their own
    lies anywhere between both.

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
        Parameter("edge", "", 0.0, float(WIDEST), 0.0),
        Parameter("flying", "", 0.0, SHARE[1], 0.1),
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
        beside = [*edge_shares(values), values["flying"]]
        return np.concatenate([numbers, weights.ravel(), 1.0 / deviations, beside])

    def factors(self, observed: np.ndarray, depth: np.ndarray, values: Mapping[str, float]) -> Factors:
        """Return the Factors of an image under complete values."""
        value = np.abs(np.where(np.isfinite(observed), observed, 0.0))
        seen, model = value > 0.0, blurred_depth(depth, values)
        model = np.where(seen & (observed < 0.0), np.minimum(model, value), model)
        sigma, growth = values["sigma"], values["sigma_growth"]
        inverse = 1.0 / (sigma + growth * model * value)
        slope, residual = (sigma + growth * model**2) * inverse**2, np.where(seen, (value - model) * inverse, 0.0)
        tells = links(depth, values)
        telling = seen & (observed > 0.0) & (np.abs(residual) <= tells.limit)
        mean, deviation = tells.predict(np.pad(residual, 2), np.pad(telling, 2), *np.indices(depth.shape))
        alone = observed < 0.0  # of what may be hidden no neighbour tells
        mean, deviation = np.where(alone, 0.0, mean), np.where(alone, tells.deviations[0], deviation)
        return Factors(residual, mean, deviation, slope, seen)

    def per_pixel(
        self, observed: np.ndarray, depth: np.ndarray, values: Mapping[str, float] | None = None
    ) -> np.ndarray:
        values = self.complete(values)
        found = self.factors(observed, depth, values)
        z = (found.residual - found.mean) / found.deviation
        narrow, wide = np.exp(-0.5 * z**2), np.exp(-0.5 * (z / WIDER) ** 2) / WIDER
        surface = (1.0 - values["tail"]) * narrow + values["tail"] * wide
        surface *= found.slope / (found.deviation * math.sqrt(2.0 * math.pi))
        depths = np.abs(np.where(found.seen, observed, 0.0))
        sides = sides_of(depth, values)
        z = sides.off(depths, observed < 0.0)
        other = np.exp(-0.5 * z**2) / (sides.deviation * math.sqrt(2.0 * math.pi))
        between = np.where((depths >= sides.near) & (depths <= sides.far), 1.0 / sides.extent, 0.0)
        other = (1.0 - values["flying"]) * other + values["flying"] * between
        surface = (1.0 - sides.share) * surface + sides.share * other
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
        depths, sides = np.abs(np.where(found.seen, observed, 0.0)), sides_of(depth, values)
        other = (1.0 - values["flying"]) * ndtr(sides.off(depths, observed < 0.0))
        other += values["flying"] * np.clip((depths - sides.near) / sides.extent, 0.0, 1.0)
        below = (1.0 - sides.share) * below + sides.share * other
        nearer = np.clip((depths - values["near"]) / extent, 0.0, 1.0)
        below = (1.0 - values["outlier"]) * below + values["outlier"] * nearer
        return np.where(found.seen, ndtri(np.clip(below, 1e-15, 1.0 - 1e-15)), np.nan)

    def sample(
        self, rng: np.random.Generator, depth: np.ndarray, values: Mapping[str, float] | None = None
    ) -> np.ndarray:
        values = self.complete(values)
        model = blurred_depth(depth, values)
        sigma, growth = values["sigma"], values["sigma_growth"]
        noise = rng.standard_normal(depth.shape)
        noise = np.where(rng.random(depth.shape) < values["tail"], WIDER * noise, noise)
        outliers = rng.random(depth.shape) < values["outlier"]
        sides = sides_of(depth, values)
        anywhere = sides.other + sides.deviation * rng.standard_normal(depth.shape)
        flying = rng.random(depth.shape) < values["flying"]
        anywhere = np.where(flying, sides.near + sides.extent * rng.random(depth.shape), anywhere)
        anywhere = np.where(outliers, rng.uniform(values["near"], values["far"], depth.shape), anywhere)
        anywhere = (anywhere - model) / (sigma + growth * model * anywhere)
        outliers |= rng.random(depth.shape) < sides.share
        tells, residual = links(depth, values), np.full([side + 4 for side in depth.shape], np.inf)
        draw(residual, np.where(outliers, anywhere, np.nan), noise, *tells)
        unit = residual[2:-2, 2:-2]
        result = (model + sigma * unit) / np.maximum(1.0 - growth * model * unit, 0.0)
        return np.where((result > 0.0) & np.isfinite(result), result, np.nan)


@njit(cache=True, nogil=True)
def draw(residual, anywhere, noise, same, weights, deviations, limit):
    """Write unit noise into `residual` (H + 4, W + 4), two pixels wider than the image all round, in order of reading.

    anywhere : (H, W), where it is not NaN it is this. noise : (H, W), each pixel's own. The others are those of Links.
    """
    for row in range(noise.shape[0]):
        for column in range(noise.shape[1]):
            some, mean = len(deviations) - 1, 0.0
            for k in range(len(weights)):
                there = residual[row + 2 - NEIGHBOURS[k][0], column + 2 - NEIGHBOURS[k][1]]
                if not (same[k, row, column] and abs(there) <= limit):
                    some &= ~(1 << GROUPS[k])
            for k in range(len(weights)):
                if some >> GROUPS[k] & 1:
                    there = residual[row + 2 - NEIGHBOURS[k][0], column + 2 - NEIGHBOURS[k][1]]
                    mean += weights[k, some] * there
            drawn = mean + deviations[some] * noise[row, column]
            residual[row + 2, column + 2] = drawn if np.isnan(anywhere[row, column]) else anywhere[row, column]


def covariance(rows: np.ndarray, columns: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
    """Return the covariance of unit noise of pixels so many rows and columns apart."""
    h = np.minimum(np.hypot(columns / values["reach"], rows / values["reach_down"]), NOTHING_SHARED)
    own = np.where((rows == 0) & (columns == 0), values["white"], 0.0)
    return own + (1.0 - values["white"]) * (1.0 + h) * np.exp(-h) + values["bias"] ** 2


def independent_share(values: Mapping[str, float]) -> float:
    """Return how many independent pixels one tells as much as, of the mean of many: at most 1.

    The inverse of the sum of its correlations with all pixels. What neighbours share sums to 6 pi reach reach_down: the
    field's integral over the plane. The bias, which no number of pixels tells, is left out.
    """
    shared = 6.0 * math.pi * values["reach"] * values["reach_down"]
    return 1.0 / (values["white"] + (1.0 - values["white"]) * max(shared, 1.0))


def shown_share(values: Mapping[str, float]) -> float:
    """Return how many independent values one pixel shows, of many that show a surface: at most 1.

    The inverse of the sum of its squared correlations with all pixels: a field's degrees of freedom (Bretherton et al.,
    Journal of Climate, 1999), to which its mean square is known. They are more than tell the mean (`independent_share`,
    by the correlations themselves): noise that hides a level does not hide that something of another form is there.
    What neighbours share sums to 9/4 pi reach reach_down. The bias is left out.
    """
    shared = (1.0 - values["white"]) ** 2
    return 1.0 / (1.0 - shared + shared * max(2.25 * math.pi * values["reach"] * values["reach_down"], 1.0))


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


def edge_shares(values: Mapping[str, float]) -> list[float]:
    """Return the probabilities with which a pixel one and two pixels from a jump shows the surface beyond."""
    return [EITHER * min(max(values["edge"] - away, 0.0), 1.0) for away in range(WIDEST)]


class Sides(NamedTuple):
    """Which other surface pixels (H, W) may show. share : with what probability. other : its depth in metres.
    deviation : of what is seen of it. near, extent : metres, where the depths between both begin, and how many."""

    share: np.ndarray
    other: np.ndarray
    deviation: np.ndarray
    near: np.ndarray
    extent: np.ndarray

    @property
    def far(self) -> np.ndarray:
        """Where the depths between both surfaces end."""
        return self.near + self.extent

    def off(self, depths: np.ndarray, hidden: np.ndarray) -> np.ndarray:
        """Return by how many deviations depths are off it; hidden : where what is no part of the scene may hide it."""
        return (depths - np.where(hidden, np.minimum(self.other, depths), self.other)) / self.deviation


def sides_of(depth: np.ndarray, values: Mapping[str, float]) -> Sides:
    """Return the Sides of a clean depth image (H, W)."""
    clean = with_wall(depth, values["background"])
    (height, width), padded = clean.shape, np.pad(clean, WIDEST, mode="edge")
    share, other = np.zeros(clean.shape), clean.copy()
    for away, probability in reversed(list(enumerate(edge_shares(values), start=1))):
        first, last = WIDEST - away, WIDEST + away
        west, east = (padded[WIDEST : WIDEST + height, at : at + width] for at in (first, last))
        north, south = (padded[at : at + height, WIDEST : WIDEST + width] for at in (first, last))
        bend = np.maximum(np.abs(west + east - 2.0 * clean), np.abs(north + south - 2.0 * clean))
        deepest, nearest = (pick.reduce([west, east, north, south]) for pick in (np.maximum, np.minimum))
        beyond = np.where(deepest - clean >= clean - nearest, deepest, nearest)
        at_jump = bend > values["jump"] * clean
        share, other = np.where(at_jump, probability, share), np.where(at_jump, beyond, other)
    spread = math.hypot(1.0, values["bias"]) * (values["sigma"] + values["sigma_growth"] * other**2)
    extent = np.where(share > 0.0, np.abs(other - clean), 1.0)
    return Sides(share, other, spread, np.minimum(clean, other), extent)


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
