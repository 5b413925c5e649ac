"""Noise that neighbouring pixels share: a sum of random steps on blocks of every size, from the pixel to the frame."""

import math
from collections.abc import Iterator, Mapping

import numpy as np

from derender.errors import DerenderError
from derender.render.likelihoods.base import (
    BACKGROUND,
    BLUR,
    SIGMA,
    Likelihood,
    blurred_depth,
    has_return,
    likelihoods,
)
from derender.scene.parameter import Parameter

SLOW = 6  # log2 of the side of the blocks on which half of the slow bias lives; the other half is the frame's
SHARE = (1e-3, 1.0 - 1e-3)  # of the variance that is each pixel's own: both it and the rest are some


@likelihoods.register("correlated")
class Correlated(Likelihood):
    """With m the blurred depth and g = sigma + sigma_growth m^2, the residuals of the pixels with a return are

        observed - m = g w,    w = sqrt(white) e + sum over levels l of s_l u_l[block of side 2^l] + bias (...),

    with e and all u independent standard normal numbers: each pixel has its own noise, and each block of 2, 4, 8 ...
    pixels' side, up to the frame, an offset. The variances s_l^2 add up to 1 - white and fall off so that what two
    pixels share is about exp(-distance / reach). Besides, a slow bias of `bias` times as much spans blocks of 64 pixels
    and the frame, half its variance each: a frame may be off by as much as its noise and still tell where steps are.

    The density is exact and takes time in proportion to the pixels: a tree of blocks passes what each tells of the
    offset above it. Missing pixels tell nothing, and cost nothing. Blocks are aligned to the image's corner, so two
    neighbours that a block's border parts share less than others do.
    """

    parameters = (
        SIGMA,
        BLUR,
        BACKGROUND,
        Parameter("sigma_growth", "1/m", 0.0, 1.0, 0.0),
        Parameter("white", "", *SHARE, 0.2),
        Parameter("reach", "", 0.1, 1000.0, 8.0),
        Parameter("bias", "", 0.0, 100.0, 1.0),
    )
    code = -1  # none of the engine's

    def counted_pixels(self, observed):
        return int(has_return(observed).sum())

    def row(self, values, pixels):
        what = "the likelihood correlated scores whole images only"
        raise DerenderError(what, "likelihood", "infer under gaussian or robust; derender calibrate and sample know it")

    def per_pixel(self, observed, depth, values=None):
        values = self.complete(values)
        seen = has_return(observed)
        if not seen.any():
            return np.zeros(seen.shape)
        model = blurred_depth(depth, values)
        spread = values["sigma"] + values["sigma_growth"] * model**2
        scaled = np.where(seen, (np.where(seen, observed, 0.0) - model) / spread, np.nan)
        total, weighted = tree_log_density(scaled, values["white"], offset_variances(scaled.shape, values))
        quadratic = np.where(seen, np.nan_to_num(scaled) * weighted, 0.0)
        even = (total + 0.5 * quadratic.sum()) / seen.sum()  # the determinant, which no pixel owns
        return np.where(seen, even - 0.5 * quadratic - np.log(spread), 0.0)

    def sample(self, rng, depth, values=None):
        values = self.complete(values)
        model = blurred_depth(depth, values)
        spread = values["sigma"] + values["sigma_growth"] * model**2
        noise = math.sqrt(values["white"]) * rng.standard_normal(depth.shape)
        for level, variance in enumerate(offset_variances(depth.shape, values), start=1):
            shape = tuple(-(-side // 2**level) for side in depth.shape)
            offsets = math.sqrt(variance) * rng.standard_normal(shape)
            noise += offsets.repeat(2**level, axis=0).repeat(2**level, axis=1)[: depth.shape[0], : depth.shape[1]]
        result = model + spread * noise
        return np.where(result > 0.0, result, np.nan)


def offset_variances(shape: tuple[int, ...], values: Mapping[str, float]) -> np.ndarray:
    """Return the variances (L,) of the offsets of blocks of side 2, 4 ... 2^L, the last the whole image.

    Beside unit noise: the pixels' own share is `white`, the slow bias comes on top.
    """
    levels = max(1, math.ceil(math.log2(max(*shape, 2))))
    sides = 2.0 ** np.arange(levels + 1)
    shared = np.exp(-0.5 * sides / values["reach"])  # by pixels about half a side apart
    steps = shared[:-1] - shared[1:]
    steps[-1] += shared[-1]
    found = (1.0 - values["white"]) * steps / steps.sum()
    found[min(SLOW, levels) - 1] += 0.5 * values["bias"] ** 2
    found[-1] += 0.5 * values["bias"] ** 2
    return found


def tree_log_density(scaled: np.ndarray, white: float, variances: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the log density of an image (H, W) of noise, NaN where missing, and C^-1 times it (H, W).

    white : variance of each pixel's own noise. variances : (L,) of the offsets of blocks of side 2^l, see above.

    What a block of pixels tells of the sum of the offsets above it is a normal: a mean and a precision. Those of its
    four parts multiply; then its own offset widens the product. On the way down the offsets' means given all pixels
    follow, and so what is left to each pixel's own noise, e: C^-1 w = e / white.
    """
    mean, precision = np.nan_to_num(scaled), np.isfinite(scaled) / white
    total = -0.5 * float(np.isfinite(scaled).sum()) * math.log(2.0 * math.pi * white)
    total -= 0.5 * float((mean**2 * precision).sum())
    ups = []
    for variance in variances:
        whole, weighted = blocks(precision), blocks(precision * mean)
        seen = whole > 0.0
        mean = np.divide(weighted, whole, out=np.zeros_like(whole), where=seen)
        # the parts' product is that of a normal of their mean, times this; then the offset widens it
        total += 0.5 * float((mean**2 * whole).sum())
        widened = np.divide(1.0, 1.0 / np.where(seen, whole, 1.0) + variance, out=np.zeros_like(whole), where=seen)
        total -= 0.5 * float(np.log1p(variance * whole[seen]).sum()) + 0.5 * float((mean**2 * widened).sum())
        ups.append((mean, whole, variance))
        precision = widened
    above = np.zeros((1, 1))
    for mean, whole, variance in reversed(ups):
        height, width = mean.shape
        above = above.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
        above = above + variance * whole / (1.0 + variance * whole) * (mean - above)
    height, width = scaled.shape
    above = above.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
    return total, np.where(np.isfinite(scaled), np.nan_to_num(scaled) - above, 0.0) / white


def blocks(image: np.ndarray) -> np.ndarray:
    """Return the sums (ceil(H / 2), ceil(W / 2)) of an image (H, W) over blocks of two by two."""
    height, width = image.shape
    padded = np.pad(image, ((0, height % 2), (0, width % 2)))
    return padded[0::2, 0::2] + padded[1::2, 0::2] + padded[0::2, 1::2] + padded[1::2, 1::2]


def whitened(scaled: np.ndarray, white: float, variances: np.ndarray) -> Iterator[np.ndarray]:
    """Yield, level by level, how far the parts of its blocks lie from the blocks' mean, (H', W') standard deviations.

    They are those differences that the levels above know nothing of: standard normal numbers where the noise is as the
    likelihood says; NaN where a part has nothing to be compared with.
    """
    mean, precision = np.nan_to_num(scaled), np.isfinite(scaled) / white
    for variance in variances:
        whole, weighted = blocks(precision), blocks(precision * mean)
        seen = whole > 0.0
        middle = np.divide(weighted, whole, out=np.zeros_like(whole), where=seen)
        height, width = mean.shape
        wide = [each.repeat(2, axis=0).repeat(2, axis=1)[:height, :width] for each in (middle, whole)]
        with np.errstate(divide="ignore", invalid="ignore"):
            apart = (mean - wide[0]) / np.sqrt(1.0 / precision - 1.0 / wide[1])
        yield np.where((precision > 0.0) & (wide[1] > precision * (1.0 + 1e-9)), apart, np.nan)
        widened = 1.0 / (1.0 / np.where(seen, whole, 1.0) + variance)
        mean, precision = middle, np.where(seen, widened, 0.0)
