"""Noise that neighbouring pixels share: a pixel goes on as earlier ones were observed, or tells of its surface anew.

A mixture transition distribution: Raftery, Journal of the Royal Statistical Society B, 1985; of flat stretches, bursts
and outliers: Le, Martin and Raftery, Journal of the American Statistical Association, 1996. How a surface goes on is
kriging with an unknown plane (Matheron, 1969), of which the scene knows nothing; what that leaves to be told is learnt
from the rows above, which are forgotten by and by (West and Harrison, Bayesian Forecasting and Dynamic Models, 1997).
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from derender.compilation.cache import njit
from derender.registry import Parameter
from derender.render.likelihoods.pixelwise import (
    BACKGROUND,
    BLUR,
    NOWHERE,
    SIGMA,
    Likelihood,
    Numbers,
    blurred_depth,
    likelihoods,
    mixture,
    noise_at,
)

NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0))  # (rows up, columns to the left) of the earlier ones
NEAREST = 4  # of them; where none of these returned a pixel tells of its surface anew
MEMBERS = (np.arange(64)[:, None] >> np.arange(6)) % 2 == 1  # (64, 6), which of them returned in each set
PLACES = np.array([(0, 0), *NEIGHBOURS], float)
# Sets that tell how a plane goes on: not all of one row, and one more than a plane has numbers, or the noise does.
TELL_A_PLANE = np.linalg.matrix_rank(MEMBERS[..., None] * np.column_stack([np.ones(6), PLACES[1:]])) == 3
TELL_A_PLANE &= MEMBERS.sum(axis=1) > 3
APART = np.moveaxis(PLACES[:, None] - PLACES[None], -1, 0)  # (2, 7, 7), rows and columns between a pixel and those
SHARE = (1e-5, 1.0 - 1e-3)  # of the variance that is each pixel's own, and of pixels: both it and the rest are some
REACH = (1e-9, 1e9)  # pixels: a chain may go wherever a distribution over it lets it
NOTHING_SHARED = 700.0  # reaches apart, at which exp(-h) is still above 0
RATE = (1e-30, 0.5)  # of outliers
# Share of the depth, and standard deviations of the noise besides, by which a neighbour may be on the same slanted
# surface or across an outline, over which noise seldom goes on. Did it, an outline would cost least where the solid
# reaches a pixel too far, so that its own surface does not show there.
JUMP, BEYOND = 0.04, 5.0
WIDER = 4  # times as wide as the others are the heavy tails' innovations, about those of rounded disparities
FIRM = 100.0  # pixels that have to tell of an innovation's weight as much as is believed before: that it is none
SWEEPS = 3  # of Gauss and Seidel, in each row: the weights change little from one to the next
SPIKE, FREEDOM = 6.0, 4.0  # standard deviations at which an innovation tells no more; by Student's t less before
STUDENT = 2.0 / (math.pi * math.sqrt(3.0))  # height of Student's t of 3 degrees of freedom


@likelihoods.register("correlated")
class Correlated(Likelihood):
    """In the order of reading a pixel goes on as earlier ones were observed, whatever the scene says, or it tells of
    its surface anew. What tells anew is as `robust` has it: with m the blurred depth

        (1 - outlier) Norm(m, sigma + sigma_growth m^2) + outlier Uniform(near, far).

    It goes on with probability `shared` after neighbours (the one to the left and the one above) that show their
    surfaces, with `clump` after such that do not, by the probability of that given their depths; and after diagonal
    ones alone, for beside holes pixels share their noise too. What is off m by d shows another surface, across an
    outline, but for the share 1 / (1 + (d / j)^4), with j = .04 m + 5 (sigma + sigma_growth m^2). So of many pixels few
    tell of a surface; and where solids are not as they are modelled, that costs once where it begins and little where
    it goes on, yet something at each pixel.

    A pixel that goes on is off the depth m that six earlier ones predict (left, above, and the four beyond: both
    diagonals, two to the left, two above) by step + step_growth m^2. That is kriging of noise whose covariance is

        white [same pixel] + (1 - white) (1 + h) exp(-h),
        h^2 = (columns apart / reach)^2 + (rows apart / reach_down)^2

    (a Matern field of smoothness 3/2), about a plane of which nothing is known; where fewer than four returned, or all
    lie in a row, about a constant. The fewer, the more it is off. What that leaves, in units of the step, is regressed
    on what it left at the same six: their weights are 0 beforehand, as firmly as 100 pixels would tell it, and each row
    forgets the share `fading` of what the rows above told of them. With 1 nothing is learnt. A share `tail` of these
    innovations is four times as wide. The share `alone` goes on from one of the nearest four alone, as along an edge,
    with Student's t of 3 degrees of freedom, four times as wide too. A depth that is not positive is no return.

    The product of all pixels' densities given earlier ones integrates to one for each set of pixels that return. One
    without a return is evidence of nothing. One that holds minus a depth shows what is no part of the scene: see
    `robust`. Files in data/sensors give it under `likelihood:`. So may a scene, or a copy of the prior bare-image.

    Images are drawn from that density unless `drawn:` says by which numbers of a field they are, as calibrate does.
    """

    parameters = (
        SIGMA,
        BLUR,
        BACKGROUND,
        Parameter("sigma_growth", "1/m", 0.0, 1.0, 0.0),
        Parameter("shared", "", *SHARE, 0.9),
        Parameter("clump", "", *SHARE, 0.5),
        Parameter("step", "m", 1e-6, 1.0, 0.001),
        Parameter("step_growth", "1/m", 0.0, 1.0, 0.0),
        Parameter("white", "", *SHARE, 0.05),
        Parameter("reach", "", *REACH, 4.0),
        Parameter("reach_down", "", *REACH, 2.0),
        Parameter("fading", "", 0.0, 1.0, 0.1),
        Parameter("tail", "", 0.0, SHARE[1], 0.1),
        Parameter("alone", "", 0.0, SHARE[1], 0.1),
        Parameter("outlier", "", *RATE, 0.02),
        Parameter("near", "m", 0.0, 1000.0, 0.1),
        Parameter("far", "m", 0.0, 1000.0, 10.0),
    )
    code = 2
    scored = ("sigma_growth", "outlier", "near", "far", "shared", "clump")
    of_image = ("step", "step_growth", "white", "reach", "reach_down", "fading", "tail", "alone")
    of_field = ("sigma", "sigma_growth", "white", "reach", "reach_down", "outlier", "near", "far")

    def beside(self, observed: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
        """Return (H, W) the density of each pixel that goes on; 0 where none of the nearest four returned."""
        return self.going_on(observed, values, (0, 0))[0]

    def going_on(
        self, observed: np.ndarray, values: Mapping[str, float], shape: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (H, W) the density of each pixel that goes on, and the probability that it is nearer than it is.

        shape : of the second, (H, W), or (0, 0) where it is not asked for.
        """
        depths = np.pad(np.abs(np.where(np.isfinite(observed), observed, 0.0)), 2)
        numbers = np.array([values[name] for name in ("step", "step_growth", "tail", "alone", "fading")])
        density, below = np.zeros(observed.shape), np.zeros(shape)
        go_on(depths, numbers, *prediction(values), density, below)
        return density, below

    def parts(self, observed: np.ndarray, depth: np.ndarray, values: Mapping[str, float]) -> Any:
        """Return of each pixel (H, W) whether it holds a depth, that, the model's and the noise, the densities of its
        surface and of what tells anew, and the probability that it goes on."""
        value, model, spread, surface, outliers = mixture(observed, depth, values)
        seen, anew = value > 0.0, surface + outliers
        height, width = depth.shape
        each = np.pad([np.where(seen, surface / anew, 0.0), seen, value], ((0, 0), (1, 1), (1, 1)))
        before = [each[:, 1 - up : 1 - up + height, 1 - left : 1 - left + width] for up, left in NEIGHBOURS[:NEAREST]]
        most = JUMP * model + BEYOND * spread
        shows = sum(shown / (1.0 + ((there - model) / most) ** 4) for shown, _, there in before[:2])
        count = before[0][1] + before[1][1]
        goes_on = values["clump"] + (values["shared"] - values["clump"]) * shows / np.maximum(count, 1.0)
        follows = np.any([there for _, there, _ in before], axis=0)
        return seen, value, model, spread, anew, np.where(follows, goes_on, 0.0)

    def per_pixel(self, observed: np.ndarray, depth: np.ndarray, values: Numbers = None) -> np.ndarray:
        values = self.complete(values)
        seen, _, _, _, anew, goes_on = self.parts(observed, depth, values)
        density = (1.0 - goes_on) * anew + goes_on * self.beside(observed, values)
        return np.where(seen, np.log(np.maximum(density, NOWHERE)), 0.0)

    def whitened(self, observed: np.ndarray, depth: np.ndarray, values: Any = None) -> np.ndarray:
        """Return an image's noise (H, W) without what earlier neighbours tell of it, NaN where nothing returned.

        Each pixel's quantile among those that it might have had given these, as the quantile of a normal number: under
        the right values independent standard normal numbers.
        """
        from scipy.special import ndtr, ndtri

        values = self.complete(values)
        seen, depths, model, spread, _, goes_on = self.parts(observed, depth, values)
        nearer = np.clip((depths - values["near"]) / (values["far"] - values["near"]), 0.0, 1.0)
        below = (1.0 - values["outlier"]) * ndtr((depths - model) / spread) + values["outlier"] * nearer
        below = (1.0 - goes_on) * below + goes_on * self.going_on(observed, values, depth.shape)[1]
        return np.where(seen, ndtri(np.clip(below, 1e-15, 1.0 - 1e-15)), np.nan)

    def sample(self, rng: np.random.Generator, depth: np.ndarray, values: Numbers = None) -> np.ndarray:
        values = self.complete(values)
        names = ("sigma", "sigma_growth", "step", "step_growth", "shared", "clump", "outlier", "near", "far", "tail",
                 "alone", "fading")  # fmt: skip
        result, numbers = np.zeros([side + 4 for side in depth.shape]), np.array([values[name] for name in names])
        draw(rng, result, blurred_depth(depth, values), numbers, *prediction(values))
        result = result[2:-2, 2:-2]
        return np.where(result > 0.0, result, np.nan)

    def field(self, rng: np.random.Generator, depth: np.ndarray, values: Numbers = None) -> np.ndarray:
        """Draw an image (H, W) whose noise is one normal field of that covariance about its surfaces, but for outliers.

        As that of cameras is. It is not the density's own: pixels that know nothing of their surface drift from it, so
        that the numbers that explain frames best draw several times their noise. On a torus of twice the size, by the
        spectrum (Wood and Chan, Journal of Computational and Graphical Statistics, 1994).
        """
        values = self.complete(values)
        model, sides = blurred_depth(depth, values), tuple(2 * side for side in depth.shape)
        rows, columns = (np.minimum(np.arange(side), side - np.arange(side)) for side in sides)
        spectrum = np.maximum(np.fft.rfft2(covariance(rows[:, None], columns[None], values)).real, 0.0)
        unit = np.fft.irfft2(np.sqrt(spectrum) * np.fft.rfft2(rng.standard_normal(sides)), sides)
        result = model + noise_at(model, values) * unit[: depth.shape[0], : depth.shape[1]]
        anywhere = rng.uniform(values["near"], values["far"], depth.shape)
        result = np.where(rng.random(depth.shape) < values["outlier"], anywhere, result)
        return np.where(result > 0.0, result, np.nan)


@njit(cache=True, nogil=True)
def predicted(depths, row, column, weights, deviations, step, growth):
    """Return the depth that earlier ones predict for a pixel, and by how much it is off that, in metres.

    depths : (H + 4, W + 4), 0 where none returned; row, column : in that.
    """
    some, mean = 0, 0.0
    for k in range(len(NEIGHBOURS)):
        some |= (depths[row - NEIGHBOURS[k][0], column - NEIGHBOURS[k][1]] > 0.0) << k
    for k in range(len(NEIGHBOURS)):
        mean += weights[k, some] * depths[row - NEIGHBOURS[k][0], column - NEIGHBOURS[k][1]]
    return mean, deviations[some] * (step + growth * mean * mean)


@njit(cache=True, nogil=True)
def any_nearest(depths, row, column):
    """Whether one of the nearest earlier pixels returned; the arguments as of `predicted`."""
    for k in range(NEAREST):
        if depths[row - NEIGHBOURS[k][0], column - NEIGHBOURS[k][1]] > 0.0:
            return True
    return False


@njit(cache=True, nogil=True)
def forget(told, weights, fading):
    """Forget a share of what rows above told of the weights (6,) of innovations, and find those that the rest tells.

    told : (6, 7) their precision and, last, its product with them.
    """
    every = len(weights)
    for k in range(every):
        for j in range(every + 1):
            told[k, j] *= 1.0 - fading
        told[k, k] += fading * FIRM
    for _ in range(SWEEPS):
        for k in range(every):
            weights[k] += (told[k, every] - np.dot(told[k, :every], weights)) / told[k, k]


@njit(cache=True, nogil=True)
def carried(left, row, column, weights):
    """Return what innovations `left` (H + 4, W + 4) over at earlier pixels tell of that of a pixel."""
    total = 0.0
    for k in range(len(NEIGHBOURS)):
        total += weights[k] * left[row - NEIGHBOURS[k][0], column - NEIGHBOURS[k][1]]
    return total


@njit(cache=True, nogil=True)
def learn(told, left, row, column, z, carry):
    """Write down the innovation z of a pixel, of which `carry` was told, and what it tells of the weights."""
    kept, every = min(max(z, -SPIKE), SPIKE), len(NEIGHBOURS)
    left[row, column] = kept
    trust = (FREEDOM + 1.0) / (FREEDOM + (z - carry) ** 2)
    for k in range(every):
        by = trust * left[row - NEIGHBOURS[k][0], column - NEIGHBOURS[k][1]]
        if by != 0.0:
            for j in range(every):
                told[k, j] += by * left[row - NEIGHBOURS[j][0], column - NEIGHBOURS[j][1]]
            told[k, every] += by * kept


@njit(cache=True, nogil=True, error_model="numpy")
def go_on(depths, numbers, weights, deviations, density, below):
    """Write the density of pixels (H, W) that go on, and the probability that they are nearer, if that has a shape.

    depths : (H + 4, W + 4), two pixels wider than the image all round, 0 where none returned. numbers : step,
    step_growth, tail, alone, fading.
    """
    step, growth, tail, alone, fading = numbers
    left, told, shares = np.zeros(depths.shape), FIRM * np.eye(6, 7), np.zeros(6)
    sharp = np.zeros(depths.shape)  # of each pixel, 1 / metres: how closely one that goes on from it alone does so
    for row in range(depths.shape[0]):
        for column in range(depths.shape[1]):
            there = depths[row, column]
            if there > 0.0:
                sharp[row, column] = 1.0 / (WIDER * math.sqrt(3.0) * (step + growth * there * there))
    for row in range(density.shape[0]):
        forget(told, shares, fading)
        for column in range(density.shape[1]):
            here = depths[row + 2, column + 2]
            if not (here > 0.0 and any_nearest(depths, row + 2, column + 2)):
                continue
            mean, off = predicted(depths, row + 2, column + 2, weights, deviations, step, growth)
            inverse = 1.0 / off
            z, carry = (here - mean) * inverse, carried(left, row + 2, column + 2, shares)
            if fading < 1.0:
                learn(told, left, row + 2, column + 2, z, carry)
            z -= carry
            wide = math.exp(-0.5 * (z / WIDER) ** 2)
            narrow = wide ** (WIDER * WIDER)
            total = (1.0 - alone) / math.sqrt(2.0 * math.pi) * ((1.0 - tail) * narrow + tail * wide / WIDER) * inverse
            heavy, nearer, count = 0.0, 0.0, 0
            for k in range(NEAREST):
                there, sharply = (
                    depths[row + 2 - NEIGHBOURS[k][0], column + 2 - NEIGHBOURS[k][1]],
                    sharp[row + 2 - NEIGHBOURS[k][0], column + 2 - NEIGHBOURS[k][1]],
                )
                if there > 0.0:
                    t = (here - there) * sharply
                    at = 1.0 / (1.0 + t * t)
                    heavy += sharply * at * at
                    count += 1
                    if below.size:
                        nearer += 0.5 + (t * at + math.atan(t)) / math.pi
            density[row, column] = total + alone * STUDENT * math.sqrt(3.0) * heavy / count
            if below.size:
                narrow, wide = math.erf(z / math.sqrt(2.0)), math.erf(z / (WIDER * math.sqrt(2.0)))
                nearer *= alone / count
                below[row, column] = nearer + (1.0 - alone) * (0.5 + 0.5 * ((1.0 - tail) * narrow + tail * wide))


@njit(cache=True, nogil=True)
def draw(rng, result, model, numbers, weights, deviations):
    """Write depths into `result` (H + 4, W + 4), two pixels wider than the image all round, in order of reading.

    model : (H, W) metres. numbers : sigma, sigma_growth, step, step_growth, shared, clump, outlier, near, far, tail,
    alone, fading.
    """
    sigma, growth, step, step_growth, shared, clump, outlier, near, far, tail, alone, fading = numbers
    left, told, shares = np.zeros(result.shape), FIRM * np.eye(6, 7), np.zeros(6)
    shows = np.zeros(result.shape)  # how probably a pixel that returned shows its surface
    for row in range(2, result.shape[0] - 2):
        forget(told, shares, fading)
        for column in range(2, result.shape[1] - 2):
            m = model[row - 2, column - 2]
            spread, count, before = sigma + growth * m * m, 0, 0.0
            for up, back in NEIGHBOURS[:2]:
                there = result[row - up, column - back]
                if there > 0.0:
                    count += 1
                    before += shows[row - up, column - back] / (1.0 + ((there - m) / (JUMP * m + BEYOND * spread)) ** 4)
            mean, off = predicted(result, row, column, weights, deviations, step, step_growth)
            carry = carried(left, row, column, shares)
            follows = any_nearest(result, row, column)
            if not follows or rng.random() >= clump + (shared - clump) * before / max(count, 1):
                drawn = rng.uniform(near, far) if rng.random() < outlier else m + spread * rng.standard_normal()
            elif rng.random() >= alone:
                drawn = mean + off * (carry + rng.standard_normal() * (WIDER if rng.random() < tail else 1.0))
            else:
                some = 0
                for up, back in NEIGHBOURS[:NEAREST]:  # any of those that returned, as probably as another
                    if result[row - up, column - back] > 0.0:
                        some += 1
                        if rng.random() * some < 1.0:
                            there = result[row - up, column - back]
                drawn = there + rng.standard_t(3.0) * WIDER * (step + step_growth * there * there)
            if drawn > 0.0:
                result[row, column] = drawn
                if follows:
                    learn(told, left, row, column, (drawn - mean) / off, carry)
                surface = (1.0 - outlier) / (spread * math.sqrt(2.0 * math.pi))
                surface *= math.exp(-0.5 * ((drawn - m) / spread) ** 2)
                shows[row, column] = surface / (surface + (outlier / (far - near) if near <= drawn <= far else NOWHERE))


def covariance(rows: np.ndarray, columns: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
    """Return the covariance of unit noise of pixels so many rows and columns apart."""
    h = np.minimum(np.hypot(columns / values["reach"], rows / values["reach_down"]), NOTHING_SHARED)
    own = np.where((rows == 0) & (columns == 0), values["white"], 0.0)
    return own + (1.0 - values["white"]) * (1.0 + h) * np.exp(-h)


def prediction(values: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return (6, 64) weights of the neighbours and (64,) deviations about what they predict, for each set of those that
    returned, by that of all.

    Set s has neighbour k where s has bit k. What tells a plane predicts it as it is, others a constant, none nothing.
    """
    matrix, count = covariance(APART[0], APART[1], values), len(NEIGHBOURS)
    told = np.column_stack([MEMBERS, MEMBERS.any(axis=1), TELL_A_PLANE, TELL_A_PLANE])  # what each set knows and holds
    trend = np.column_stack([np.ones(count), PLACES[1:]])
    system = np.block([[matrix[1:, 1:], trend], [trend.T, np.zeros((3, 3))]])
    system = np.where(told[:, :, None] & told[:, None], system, np.eye(count + 3))
    right = np.where(told, np.concatenate([matrix[1:, 0], [1.0, 0.0, 0.0]]), 0.0)
    weights = np.linalg.solve(system, right[..., None])[:, :count, 0].T
    with_it = np.vstack([-np.ones(len(MEMBERS)), weights])
    deviations = np.sqrt(np.maximum(np.sum(with_it * (matrix @ with_it), axis=0), SHARE[0]))
    return np.ascontiguousarray(weights), deviations / deviations[-1]


def innovations(observed: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
    """Return by how many metres pixels (H, W) are off what all six earlier ones predict, NaN where one is not there."""
    (height, width), weights = observed.shape, prediction(values)[0][:, -1]
    depths = np.pad(observed, 2, constant_values=np.nan)
    near = [depths[2 - up : 2 - up + height, 2 - left : 2 - left + width] for up, left in NEIGHBOURS]
    return observed - np.tensordot(weights, near, 1)


def independent_share(values: Mapping[str, float]) -> float:
    """Return how many pixels that tell anew one of many tells as much as, where these show their surface: at most 1.

    What a density c F + (1 - c) G tells of G's mean, of pixels that are as both have it: the share (1 - c) G / (c F) of
    them, at the heights of both a metre away.
    """
    anew, narrow = 1.0 - values["shared"], values["step"] + values["step_growth"]
    return anew / (anew + values["shared"] * (values["sigma"] + values["sigma_growth"]) / narrow)


def shown_share(values: Mapping[str, float]) -> float:
    """Return how many independent pixels one of many that show a solid is worth, as a sign that something is there.

    By the nats by which one that goes on after such as show it is likelier than one after such as do not, against those
    by which one that tells anew, a metre away, is likelier than an outlier.
    """
    noise, outlier = values["sigma"] + values["sigma_growth"], values["outlier"]
    anew = (1.0 - outlier) / (noise * math.sqrt(2.0 * math.pi)) * (values["far"] - values["near"]) / outlier
    return min(max(math.log(values["shared"] / values["clump"]), 0.0) / math.log(1.0 + anew), 1.0)
