"""Smaller images of the same scene, less noisy, with their cameras; the noise of depths, and the blur of an image.

Of each block one pixel is kept. Noise is told by residuals among which some are not noise, and which a sensor may have
rounded; blur by the pixels beside the image's steps.
"""

from dataclasses import replace

import numpy as np

from derender.camera.intrinsics import Camera
from derender.compilation.cache import njit
from derender.render.blur import blur, weighed_along_both

# Standard deviations beyond which residuals are no noise, and how wide a standard normal number scatters within.
NO_NOISE, WITHIN = 3.0, 0.9866
# Share of residuals that surely are noise, and what so many of standard normal ones are below.
MOST, AT_MOST = 0.75, 1.1503
ROUNDS = 30  # of leaving out, at most
BEGIN = 1000  # residuals, about, of which it is told where the leaving out begins
LEAST_SIGMA, MOST_SIGMA, MOST_GROWTH = 1e-4, 1.0, 1.0  # the last two as a likelihood allows them
LEAST_PART = 1e-5  # metres of the part that does not grow, of noise that is LEAST_SIGMA in all where it is least
GROWING = 1.08  # times the noise at the nearest depths from which that at the farthest is clearly more
MOST_DEPTHS, ENOUGH = 8, 100  # at which the noise is told, and residuals, at least, that tell it at one
USUAL_OFF, POLISHED = 0.05, 2  # of the log of a spread: what 100 residuals leave open; steps of least squares
EQUALLY_FAR = 1e-9  # of the normal equations' determinant, by rounding, where all depths are the same


def noise_of(residual: np.ndarray, depth: np.ndarray) -> tuple[float, float]:
    """Return (sigma, growth) of noise sigma + growth depth^2 in metres, from what scatters at each of some depths.

    A constant one where the difference is not clear. Both lie in the ranges that a likelihood allows.
    """
    seen = np.isfinite(residual)
    r, z = residual[seen], depth[seen]
    if len(r) == 0:
        return LEAST_SIGMA, 0.0
    count = max(min(MOST_DEPTHS, len(z) // ENOUGH), 1)
    some = np.sort(z[:: max(1, len(z) // BEGIN)])  # a tenth of what it takes to order all of them
    limits = some[np.arange(1, count) * len(some) // count]
    ordered, ends, squares = by_depth(r, z, limits)
    told = np.diff(ends) > min(ENOUGH, len(z)) // 2  # fewer where many are at one depth
    parts = [ordered[begin:end] for begin, end in zip(ends[:-1][told], ends[1:][told], strict=True)]
    spreads = np.array([max(spread_of(part), LEAST_SIGMA) for part in parts])
    sigma, growth = noise_through(spreads, squares[told]) if told.sum() > 1 else (spreads[0], 0.0)
    if sigma + growth * squares[told].max() < GROWING * (sigma + growth * squares[told].min()):
        sigma, growth = max(spread_of(r), LEAST_SIGMA), 0.0
    return float(np.clip(sigma, LEAST_PART, MOST_SIGMA)), float(np.clip(growth, 0.0, MOST_GROWTH))


@njit(cache=True, nogil=True)
def by_depth(residual, depth, limits):
    """Return residuals (N,) in the order of their depths between limits (K - 1,), which ascend; the ends (K + 1,) of
    each lot of them; and the mean squares (K,) of its depths."""
    which, ends = np.zeros(len(depth), np.int64), np.zeros(len(limits) + 2, np.int64)
    squares = np.zeros(len(limits) + 1)
    for n in range(len(depth)):
        for limit in limits:
            which[n] += depth[n] >= limit
        ends[which[n] + 1] += 1
        squares[which[n]] += depth[n] ** 2
    for k in range(len(squares)):
        squares[k] /= max(ends[k + 1], 1)
        ends[k + 1] += ends[k]
    ordered, place = np.empty(len(residual)), ends.copy()
    for n in range(len(residual)):
        ordered[place[which[n]]] = residual[n]
        place[which[n]] += 1
    return ordered, ends, squares


@njit(cache=True, nogil=True)
def noise_through(spreads, squares):
    """Return (sigma, growth) that go with the spreads (K,) of noise at depths, given squared (K,).

    The line through two of them that has the least sum of |log(spread / line)|, as what is unexplained at one depth may
    scatter ten times as wide there; then towards the least one, by least squares in which those far off weigh less.
    """
    sigma, growth, least = 0.0, 0.0, np.inf
    for i in range(len(spreads)):
        for j in range(i + 1, len(spreads)):
            slope = max((spreads[j] - spreads[i]) / max(squares[j] - squares[i], 1e-12), 0.0)
            slope = min(slope, (spreads[i] - LEAST_PART) / max(squares[i], 1e-12))
            begin, off = spreads[i] - slope * squares[i], 0.0
            for k in range(len(spreads)):
                off += abs(np.log(spreads[k] / (begin + slope * squares[k])))
            if off < least:
                sigma, growth, least = begin, slope, off
    for _ in range(POLISHED):
        a, b, c, u, v = 0.0, 0.0, 0.0, 0.0, 0.0  # of the normal equations
        for k in range(len(spreads)):
            at = sigma + growth * squares[k]
            off, one, other = np.log(spreads[k] / at), 1.0 / at, squares[k] / at
            weight = 1.0 / max(abs(off), USUAL_OFF)
            a, b, c = a + weight * one * one, b + weight * one * other, c + weight * other * other
            u, v = u + weight * one * off, v + weight * other * off
        determinant = a * c - b * b
        if determinant <= EQUALLY_FAR * a * c:
            break
        further, steeper = (c * u - b * v) / determinant, (a * v - b * u) / determinant
        if sigma + further < LEAST_PART or growth + steeper < 0.0:
            break
        sigma, growth = sigma + further, growth + steeper
    return sigma, growth


def spread_of(residual: np.ndarray) -> float:
    """Return the standard deviation of residuals (N,) about zero, N > 0, without those that are no noise.

    It begins with what most of them are below, and leaves out what lies beyond NO_NOISE of it again and again. Of
    depths that a sensor rounds to steps as wide as its noise a median tells where a step lies, not how wide they
    scatter.
    """
    square = np.square(residual)
    some = square[:: max(1, len(square) // BEGIN)]
    most = int(np.ceil(MOST * (len(some) - 1)))
    return float(_spread_within(square, np.sqrt(np.partition(some, most)[most]) / AT_MOST))


@njit(cache=True, nogil=True, fastmath={"reassoc"})
def _spread_within(square, spread):
    """Return the standard deviation of residuals, given squared (N,), within NO_NOISE times that `spread`, again and
    again."""
    before = -1
    for _ in range(ROUNDS):
        total, count, limit = 0.0, 0, (NO_NOISE * spread) ** 2
        for value in square:  # without a branch, so that it is vectorised
            inside = value <= limit
            total += value if inside else 0.0
            count += inside
        if count == before:
            break
        spread, before = np.sqrt(total / count) / WITHIN, count
    return spread


# By how many pixels lie from one that is looked at to the next: blurs, by their standard deviations in pixels, and the
# median share of a step that leaks across it then: measured on ideal steps in all directions
# (tests/detection/test_noise.py makes them again). Of wider blurs that share tells the less.
LEAKS = {
    1: ((0.0, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0), (0.0, 0.005, 0.039, 0.119, 0.194, 0.249, 0.278)),
    2: ((0.6, 0.8, 1.0, 1.2, 1.4), (0.059, 0.172, 0.221, 0.244, 0.257)),
    4: ((1.2, 1.4, 1.6, 1.8, 2.0, 2.4, 2.8, 3.2), (0.067, 0.110, 0.154, 0.193, 0.219, 0.244, 0.258, 0.266)),
}
LEAST_STEP = 30.0  # standard deviations of the noise: smaller steps tell little
LEAST_COUNT = 60
LEAST_LEAK = 0.03  # below it the image is as good as sharp
UNCLEAR = 0.35  # of the steps that are clear farther apart: of a blur as wide as the pixels are apart fewer are


def leaks(inverse_depth: np.ndarray, noise: np.ndarray, stride: int = 1) -> np.ndarray:
    """Return the shares of the steps that leak to the pixel beside them, along rows and columns.

    Inverse depth is affine on a plane, so two pixels on either side say what the next one would be without the blur.

    inverse_depth : (H, W), NaN where nothing returned; noise : (H, W), its standard deviation. stride : pixels from
    one that is looked at to the next.
    """
    shares = []
    for w, n in ((inverse_depth, noise), (inverse_depth.T, noise.T)):
        end = w.shape[1] - 5 * stride
        a, b, p, q, c, d = (w[:, k * stride : max(end, 0) + k * stride] for k in range(6))
        left_p, left_q, right_p, right_q = 2 * b - a, 3 * b - 2 * a, 3 * c - 2 * d, 2 * c - d
        step_p, step_q = right_p - left_p, right_q - left_q
        with np.errstate(invalid="ignore"):
            clear = np.minimum(abs(step_p), abs(step_q)) > LEAST_STEP * n[:, 2 * stride : max(end, 0) + 2 * stride]
            clear &= (step_p * step_q > 0) & (abs(step_p - step_q) < 0.3 * abs(step_p))
        for share in ((p - left_p)[clear] / step_p[clear], (right_q - q)[clear] / step_q[clear]):
            shares.append(np.minimum(share, 1 - share))
    return np.concatenate(shares)


def estimate_blur(depth: np.ndarray, sigma: float | np.ndarray) -> float:
    """Return the standard deviation, in pixels, of the blur of a depth image; 0 where it is sharp or cannot be told.

    depth : (H, W) metres, NaN or 0 = no return; sigma : (H, W) or float, standard deviation of the noise in metres.
    """
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
    inverse, noise = 1 / depth, np.broadcast_to(sigma, depth.shape) / depth**2
    told, wide, clear = 0.0, False, np.inf
    for stride, (sigmas, shares_by_sigma) in LEAKS.items():
        shares = leaks(inverse, noise, stride)
        if stride == 1 and np.isnan(shares).any():  # a sensor that loses pixels beside jumps does not blur them
            break
        shares = shares[np.isfinite(shares)]
        if stride > 1 and not wide and clear >= UNCLEAR * len(shares) / stride:
            break
        wide, clear = False, len(shares) / stride
        if len(shares) >= LEAST_COUNT and (leak := float(np.median(shares))) > LEAST_LEAK:
            told = float(np.interp(leak, shares_by_sigma, sigmas))
            wide = told > sigmas[-2]
    return told


STEP = 0.04  # share of the depth: a greater step within a block is a jump, not a slanted surface
FAR_OFF = 2.0  # standard deviations
SLOPING = 0.004  # share of the depth by which a surface may go on beside all that returned of it
# Standard deviations of a blur, rounded up to pixels, beyond which a pixel shows less than 2 % of a jump's other side;
# and those of the noise by which three pixels in line are bent at a jump: five times sqrt(6), what noise alone makes.
MIXED, JUMP = 1.5, 12.0
# The widest blur that is undone, in pixels: it more than doubles noise, which a wider one multiplies; pixels from which
# on one tells less than 3e-6 of that; rounds in which leaks are told by what is smoothed, and in which the blur is told
# by what leaks still (each leaves a sixth of it). Standard deviations of the noise by which a scene is off what it
# explains at most: of 16,000 pixels one is by noise alone.
MOST_UNMIXED, REACH, SMOOTHED, REFITTED, FITTING = 0.55, 8, 2, 2, 4.0
ONWARD = 2  # blocks: of a slope told by rows that are nearer to each other noise is the larger part


def reduced_camera(camera: Camera, factor: int) -> Camera:
    """Return the Camera of the image whose pixels stand for blocks of factor x factor pixels."""
    cx, cy = ((centre - sampled(factor)) / factor for centre in (camera.cx, camera.cy))
    return replace(camera, fx=camera.fx / factor, fy=camera.fy / factor, cx=cx, cy=cy, width=camera.width // factor,
                   height=camera.height // factor)  # fmt: skip


@njit(cache=True, nogil=True)
def sampled(factor):
    """Return the row and column within a block of the pixel that stands for it: the middle one, or that before it."""
    return (factor - 1) // 2


@njit(cache=True, nogil=True)
def sampled_blocks(depth, factor, enough):
    """Return the depth (H / factor, W / factor) of one pixel of each block, 0 where fewer than `enough` have one.

    It is that of the plane through the block's pixels on its side of a jump: the mean of all would be a point in the
    air. Where that pixel has no depth the median's side stands for it. (Always to take that side would make solids
    smaller: of two pixels on either side of an edge the median of four is on the far one.) Where all that returned lies
    beside it and what is ONWARD blocks on tells that the surface slopes, as where a far floor ends, there is none: from
    row to row that rises by decimetres, and noise would be multiplied.
    """
    height, width = depth.shape[0] // factor, depth.shape[1] // factor
    out = np.zeros((height, width))
    most = 2 * factor * factor  # pixels of a block, and as many further on
    values, place = np.empty(most), np.empty((most, 2))
    middle = sampled(factor)
    for j in range(height):
        for i in range(width):
            n = 0
            for v in range(factor):
                for u in range(factor):
                    z = depth[j * factor + v, i * factor + u]
                    if z > 0:
                        values[n], place[n, 0], place[n, 1] = z, u - middle, v - middle
                        n += 1
            if n >= enough:
                about = depth[j * factor + middle, i * factor + middle]
                if not about > 0:
                    about = np.sort(values[:n])[n // 2]
                out[j, i] = plane_at_origin(values[:n], place[:n], about, STEP * about, False)
                if beside(place[:n, 0]) or beside(place[:n, 1]):
                    axis = 0 if beside(place[:n, 0]) else 1
                    row, column, on = j * factor + middle, i * factor + middle, ONWARD * factor
                    n = with_further(depth, row, column, axis, on, n, values, place)
                    within = (1.0 + ONWARD) * STEP * about
                    there = plane_at_origin(values[:n], place[:n], about, within, True)
                    if abs(there - out[j, i]) > SLOPING * about:
                        out[j, i] = 0.0
    return out


@njit(cache=True, nogil=True)
def beside(place):
    """Return whether places (n,) along one axis lie all on one side of 0."""
    return place.min() > 0.0 or place.max() < 0.0


@njit(cache=True, nogil=True)
def with_further(depth, row, column, axis, pixels, count, values, place):
    """Add what lies so many pixels on to the first `count` values and places, all on one side of 0 along an axis.

    row, column : of the pixel at the places' origin. Returns how many there are then.
    """
    step = float(pixels) if place[0, axis] > 0.0 else -float(pixels)
    n = count
    for k in range(count):
        u, v = place[k, 0] + step * (axis == 0), place[k, 1] + step * (axis == 1)
        j, i = row + int(v), column + int(u)
        if 0 <= j < depth.shape[0] and 0 <= i < depth.shape[1] and depth[j, i] > 0:
            values[n], place[n, 0], place[n, 1] = depth[j, i], u, v
            n += 1
    return n


@njit(cache=True, nogil=True)
def plane_at_origin(values, place, about, within, outside):
    """Return the depth at (0, 0) of the plane through pixels at `place` (n, 2) whose depths (n,) are near `about`.

    The inverse depth of a plane is affine in an image; it is fitted twice, the second time without what is far off.

    outside : whether (0, 0) lies beside all places: else it is no nearer and no farther than all of them.
    """
    low, high, limit = np.inf, 0.0, np.inf
    a, b, c = 1.0 / about, 0.0, 0.0
    for again in range(2):
        n = su = sv = sw = uu = uv = vv = uw = vw = square = 0.0
        for k in range(len(values)):
            if abs(values[k] - about) > within:
                continue
            u, v, w = place[k, 0], place[k, 1], 1.0 / values[k]
            off = w - a - b * u - c * v
            if again == 1 and off * off > limit:
                continue
            n += 1.0
            su, sv, sw = su + u, sv + v, sw + w
            uu, uv, vv, uw, vw = uu + u * u, uv + u * v, vv + v * v, uw + u * w, vw + v * w
            low, high = min(low, values[k]), max(high, values[k])
        uu, uv, vv, uw, vw = uu - su * su / n, uv - su * sv / n, vv - sv * sv / n, uw - su * sw / n, vw - sv * sw / n
        determinant = uu * vv - uv * uv
        b, c = 0.0, 0.0
        if determinant > 1e-3 * n * n:  # not all in a line
            b, c = (vv * uw - uv * vw) / determinant, (uu * vw - uv * uw) / determinant
        a = (sw - b * su - c * sv) / n
        for k in range(len(values)):
            if abs(values[k] - about) <= within:
                off = 1.0 / values[k] - a - b * place[k, 0] - c * place[k, 1]
                square += off * off
        limit = FAR_OFF**2 * square / n
    if outside:
        low, high = about - within, about + within
    return min(max(1.0 / a, low), high) if a > 0.0 else about


def reduced_by(depth: np.ndarray, widest: int) -> int:
    """Return the whole factor by which `reduce` makes an image (H, W) smaller, the same however it is turned."""
    return max(1, int(round(max(depth.shape) / widest)))


def reduce(depth: np.ndarray, camera: Camera, widest: int) -> tuple[np.ndarray, Camera, int]:
    """Return (depth, Camera, factor) of the image reduced by a whole factor to about `widest` pixels along its longer
    side.

    depth : (H, W) float metres, NaN or 0 = no return; in the answer NaN = no return.
    """
    factor = reduced_by(depth, widest)
    filled = np.nan_to_num(np.ascontiguousarray(depth, dtype=np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    if factor > 1:
        filled = sampled_blocks(filled, factor, max(2, factor * factor // 5))
    return np.where(filled > 0, filled, np.nan), reduced_camera(camera, factor), factor


def single_pixels(depth: np.ndarray, factor: int) -> np.ndarray:
    """Return (H / factor, W / factor) depths: of each block that of the pixel that stands for it, NaN = no return.

    Where `reduce` makes use of all pixels of a block, these are as the sensor gave them: their noise is the image's,
    and no edge that runs through a block bends them.
    """
    first = sampled(factor)
    height, width = depth.shape[0] // factor, depth.shape[1] // factor
    single = np.asarray(depth, float)[first::factor, first::factor][:height, :width]
    return np.where(np.isfinite(single) & (single > 0), single, np.nan)


def blurred_jumps(depth: np.ndarray, sigma: float) -> tuple[np.ndarray, float]:
    """Return (H, W) bool, the pixels so near a jump that a blurred image shows a mixture of its sides there, and the
    blur's standard deviation in pixels.

    How much of each a pixel shows hangs on where within a pixel the jump is: in a smaller image of single pixels that
    falls between them, and no blur of whole pixels of that image explains it.

    depth : (H, W) metres, NaN or 0 = no return. sigma : metres of noise, which may grow with the depth squared.
    """
    known = np.isfinite(depth) & (depth > 0)
    inverse = np.where(known, 1.0 / np.where(known, depth, 1.0), np.nan)
    noise = np.maximum(sigma * inverse**2, sigma / np.median(depth[known]) ** 2) if known.any() else inverse
    blurred = estimate_blur(depth, noise / inverse**2)
    reach = int(np.ceil(MIXED * blurred))
    jump = np.zeros(depth.shape, bool)
    if reach == 0:
        return jump, blurred
    for bend, limit, out in ((inverse, noise, jump), (inverse.T, noise.T, jump.T)):
        before, middle, after = bend[:, : -2 * reach], bend[:, reach:-reach], bend[:, 2 * reach :]
        with np.errstate(invalid="ignore"):  # inverse depth is affine on a plane: there it does not bend
            out[:, reach:-reach] |= np.abs(before - 2.0 * middle + after) > JUMP * limit[:, reach:-reach]
    return jump, blurred


def unmixed(depth: np.ndarray, beside: np.ndarray, blurred: float, sigma: float) -> np.ndarray:
    """Return the depth (H, W) as it were without the blur, with the noise that it has; NaN beside jumps where that
    cannot be told.

    These pixels alone tell where a solid ends: without them its sides were open to two pixels of the whole image. To
    undo the blur multiplies noise, by which the intervals of turns would hold the truth too seldom. So what is undone
    tells, once it is smoothed, no more than how much leaked into each pixel from others, which is taken away from it.
    What leaks across jumps all the same tells how much more, or less, the blur was.

    beside, blurred : see `blurred_jumps`. sigma : metres of noise.
    """
    known = np.isfinite(depth) & (depth > 0)
    there = blur((~known).astype(float), blurred) == 0.0
    if blurred > MOST_UNMIXED or not (beside & there).any():
        return np.where(beside, np.nan, depth)
    seen = np.where(known, depth, np.median(depth[known]))
    for _ in range(REFITTED):
        sharp = without_leaks(seen, blurred, sigma)
        left = leaks(1.0 / np.where(there, sharp, np.nan), sigma / sharp**2)
        if len(left):
            sigmas, shares_by_sigma = LEAKS[1]
            leaked = np.interp(blurred, sigmas, shares_by_sigma) + np.median(left)
            blurred = min(float(np.interp(leaked, shares_by_sigma, sigmas)), MOST_UNMIXED)
    sharp = without_leaks(seen, blurred, sigma)
    return np.where(there, sharp, np.where(beside, np.nan, depth))


def unmixed_by(scene: np.ndarray, depth: np.ndarray, blurred: float, noise: np.ndarray) -> np.ndarray:
    """Return the depth (H, W) less what a blur of so many pixels leaked into each pixel from others as a scene's exact
    depth (H, W) tells it; where that does not fit what is seen, as the image itself tells it, or NaN where nothing
    returned or it cannot.

    What it tells has no noise, and jumps that are too small for the image itself to tell are among it.

    noise : (H, W) metres, its standard deviation.
    """
    known = np.isfinite(depth) & (depth > 0)
    fits = ~(known & (np.abs(depth - blur(scene, blurred)) > FITTING * noise))
    told = known if blurred <= MOST_UNMIXED else known & (blur((~fits).astype(float), blurred) == 0.0)
    sharp = without_leaks(
        np.where(known, depth, scene), blurred, float(np.median(noise)), np.where(fits, scene, np.nan)
    )
    return np.where(told, sharp, np.nan)


def without_leaks(seen: np.ndarray, blurred: float, sigma: float, scene: np.ndarray | None = None) -> np.ndarray:
    """Return an image (H, W) less what a blur of so many pixels leaked into each from others; sigma : of its noise.

    scene : (H, W) exact depths, NaN where they are not known; None: nowhere.
    """
    sharp = quiet = seen
    if blurred <= MOST_UNMIXED:
        columns = [blur(column[:, None], blurred) for column in np.eye(2 * REACH + 1)]
        sharp = weighed_along_both(seen, np.linalg.inv(np.hstack(columns))[REACH, REACH:].copy())
    for _ in range(SMOOTHED):
        smooth = smoothed(sharp, quiet, sigma)
        if scene is not None:
            smooth = np.where(np.isfinite(scene), scene, smooth)
        sharp = quiet = seen - (blur(smooth, blurred) - smooth)
    return sharp


@njit(cache=True, nogil=True, error_model="numpy")
def smoothed(depth, quiet, sigma):
    """Return depths (H, W) as the mean inverse depth of each pixel and of its neighbours in pairs, one on either side.

    A pair that a jump parts from the pixel does not count: with it inverse depth bends. quiet : (H, W) depths that tell
    it, with noise of sigma metres.
    """
    height, width = depth.shape
    inverse, told, out = 1.0 / depth, 1.0 / quiet, np.empty_like(depth)
    for j in range(height):
        for i in range(width):
            total, count, limit = inverse[j, i], 1.0, JUMP * sigma * told[j, i] ** 2
            for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
                top, bottom, left, end = j - down, j + down, i - right, i + right
                if top < 0 or bottom >= height or min(left, end) < 0 or max(left, end) >= width:
                    continue
                if abs(told[top, left] + told[bottom, end] - 2.0 * told[j, i]) < limit:
                    total += inverse[top, left] + inverse[bottom, end]
                    count += 2.0
            out[j, i] = count / total
    return out
