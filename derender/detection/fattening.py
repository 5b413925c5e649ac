"""Silhouettes that a stereo camera fattens: it matches blocks, and gives what is near to the pixel beside it.

Such a pixel has no depth of its own: it has that of the nearest one in its block. So the surface keeps its slope as far
as it reaches, and goes on flat over one pixel. Where planes slope to a silhouette that tells that all of them are too
wide. Other cameras' surfaces grow flat over several pixels, more and more: that tells of smoothing, not how wide they
are. (On 51 real frames, most of them of Kinects, over two; thinned by as many, objects that show in little were lost.)
So may a mug's or a bowl's rim be; but on one side of what is near nothing returns to a stereo camera, where only one of
its eyes sees what is behind.
"""

import numpy as np

from derender.camera.windows import least
from derender.detection.floor import pixel_noise
from derender.results.fit import scatter

# Share of the depth by which what is beyond a silhouette is farther, and standard deviations of a pixel's own noise:
# of a pixel that noise parts from its neighbours the one that is nearer looks as if it were one too many.
JUMP, CLEAR = 0.03, 8.0
INSIDE = np.arange(3.0, 7.0)  # pixels within a silhouette whose line goes on to it: what is flat is no part of it
BENT = np.array([1.0, -1.0, -1.0, 1.0])  # how far those are from lying on a line
WAVED = np.array([-1.0, 3.0, -3.0, 1.0])  # from lying on a parabola: what is left of smooth surfaces is noise
SLOPES = 0.002, 0.012  # shares of the depth by pixel: flatter is told by nothing, steeper is seen at a grazing angle
ROUGH, NOISE = 4.0, 2.5  # standard deviations from which on pixels are on no line, and silhouettes tell something else
ROUNDS = 5  # in which those are left out
FEWEST = 30  # pixels of silhouettes
# Pixels over which surfaces are flat: over none, or one, or more where they are smoothed; and of standard error: with
# more silhouettes differ by more than a sensor's noise.
LEAST, MOST, TOLD = 0.5, 1.5, 0.15
BEFORE = 0.6  # of that over which what is smoothed is flat before its last pixel (.61 to .97 on real frames), at least
SHADOW = 5  # pixels without return beside a silhouette, beyond which is told what lies behind it
# Share of the silhouettes on one side that nothing returned beside, from which on they are in the shadow of an eye: of
# frames of 20 real cameras with two eyes, or a projector for one, .20 to 1.00, .96 at the median; of others none.
SHADED = 0.3


def jump_of(depth: np.ndarray) -> np.ndarray:
    """Return (H, W) by which share of the depth what is beyond a silhouette of a depth image is farther at least.

    Noise grows with the depth, or does not: what is nearer than most is taken to be as noisy, which parts it more.
    """
    there = depth > 0.0
    noise = CLEAR * pixel_noise(depth) / float(np.median(depth[there])) if there.any() else 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        nearer = np.maximum(1.0, np.median(depth[there]) / depth) if there.any() else np.ones(depth.shape)
    return np.where(there, np.maximum(JUMP, noise * nearer), JUMP)


def sides_of(image: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return an image (H, W) turned so that each of its four sides lies below once."""
    return image, image[::-1], image.T, image.T[::-1]


def flat_pixels(depth: np.ndarray, within: int = 0) -> tuple[float, float]:
    """Return (pixels over which surfaces are flat at silhouettes, standard error), infinite where that is not told.

    depth : (H, W) metres. within : pixels before the last one, as far as which they are counted.

    At a silhouette of slope s, inverse depth by pixel, which is flat over the last f pixels, inverse depth is f s less
    than the line within goes on to. What is round goes on otherwise, in proportion to how bent it is: both are fitted.
    """
    away, found, jumps = INSIDE - INSIDE.mean(), [], jump_of(depth)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(depth > 0.0, 1.0 / depth, np.nan)  # of a plane it is affine
        for image, jump in zip(sides_of(inverse), sides_of(jumps), strict=True):
            first, last = int(INSIDE[-1]), len(image) - 1
            row, column = np.nonzero(image[first + 1 :] < (1.0 - jump[first:last]) * image[first:last])
            edge, row = image[row + first, column], row + first
            inner = np.stack([image[row - int(k), column] for k in INSIDE]) / edge
            middle, slope = inner.mean(axis=0), away @ inner / (away @ away)
            rough = np.mean((inner - middle - slope * away[:, None]) ** 2, axis=0)
            rise = image[row - within, column] / edge - middle + slope * (INSIDE.mean() - within)
            found.append(np.stack([slope, BENT @ inner, rise, rough, jump[row, column], WAVED @ inner])
                         [:, np.isfinite(slope)])  # fmt: skip
    slope, bent, rise, rough, most, waved = np.concatenate(found, axis=1)
    good = (np.abs(slope) > SLOPES[0]) & (np.abs(slope) < SLOPES[1]) & (np.abs(rise) < most)
    if good.any():
        good &= rough <= ROUGH**2 * np.median(rough[good])
    terms, rise, pixels, error = np.column_stack([slope, bent])[good], rise[good], 0.0, np.inf
    noise = scatter(waved[good]) ** 2 / (WAVED @ WAVED) if good.any() else 0.0  # variance
    of_slope = noise / (away @ away)
    by_noise = np.diag([of_slope, noise * (BENT @ BENT)]), np.array([(INSIDE.mean() - within) * of_slope, 0.0])
    for _ in range(ROUNDS):
        sums = terms.T @ terms
        squares = sums - len(terms) * by_noise[0]
        if len(terms) < FEWEST or np.linalg.eigvalsh(squares)[0] <= 0.0:  # too few, or slopes that noise makes
            return 0.0, np.inf
        spreads = np.linalg.inv(squares)
        fitted = spreads @ (terms.T @ rise - len(terms) * by_noise[1])
        left = np.abs(rise - terms @ fitted)
        pixels, spread = float(fitted[0]), scatter(left)
        error = spread * float(np.sqrt((spreads @ sums @ spreads)[0, 0]))
        terms, rise = terms[left < NOISE * spread], rise[left < NOISE * spread]
    return pixels, error


def shaded(depth: np.ndarray) -> float:
    """Return on which share of the silhouettes of a depth image (H, W) nothing returned beside them, of those of the
    side on which it is largest."""
    shares = []
    for image, jump in zip(sides_of(np.where(depth > 0.0, depth, np.nan)), sides_of(jump_of(depth)), strict=True):
        there, row = np.isfinite(image), np.arange(len(image))[:, None]
        returns = np.minimum.accumulate(np.where(there, row, len(image) - 1)[::-1])[::-1]  # the first from here on
        with np.errstate(invalid="ignore"):
            silhouette = image[:-1] < (1.0 - jump[:-1]) * np.take_along_axis(image, returns[1:], axis=0)
        shares.append(float((silhouette & ~there[1:]).sum() / max(silhouette.sum(), 1)))
    return max(shares)


def fattened(depth: np.ndarray) -> bool:
    """Whether the silhouettes of a depth image (H, W) rather are a pixel too wide than as wide as they seem."""
    pixels, error = flat_pixels(depth)
    told = error < TOLD and LEAST < pixels < MOST and flat_pixels(depth, within=1)[0] < BEFORE * pixels
    return told and shaded(depth) > SHADED


def thinned(depth: np.ndarray) -> np.ndarray:
    """Return a depth image (H, W) without the last pixel of each silhouette: there it is as deep as what lies beyond,
    or nothing returned where nothing did."""
    there = depth > 0.0
    inverse = np.where(there, 1.0 / np.where(there, depth, 1.0), np.inf)
    farthest = least(inverse, 1)
    behind = least(np.where(there, inverse, least(inverse, SHADOW)), 1)
    near = jump_of(depth) * np.where(there, inverse, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        beyond = np.where(inverse - farthest > near, 1.0 / farthest, np.nan)
        return np.where(there & (inverse - behind > near), beyond, depth)
