"""The noise of depths and the blur of a depth image, before anything is known of what it shows.

Noise is told by residuals among which some are not noise, and which a sensor may have rounded; blur by the pixels
beside the image's steps.
"""

import numpy as np

from derender.compilation.cache import njit

# Standard deviations beyond which residuals are no noise, and how wide a standard normal number scatters within.
NO_NOISE, WITHIN = 3.0, 0.9866
# Share of residuals that surely are noise, and what so many of standard normal ones are below.
MOST, AT_MOST = 0.75, 1.1503
ROUNDS = 30  # of leaving out, at most
BEGIN = 1000  # residuals, about, of which it is told where the leaving out begins
LEAST_SIGMA, MOST_SIGMA, MOST_GROWTH = 1e-4, 1.0, 1.0  # the last two as a likelihood allows them
GROWING = 1.08  # times the near half's noise from which the far half's is clearly more


def noise_of(residual: np.ndarray, depth: np.ndarray) -> tuple[float, float]:
    """Return (sigma, growth) of noise sigma + growth depth^2 in metres, from what scatters in a near and a far half.

    A constant one where the difference is not clear. Both lie in the ranges that a likelihood allows.
    """
    seen = np.isfinite(residual)
    r, z = residual[seen], depth[seen]
    if len(r) == 0:
        return LEAST_SIGMA, 0.0
    middle = (len(z) - 1) // 2
    near = z <= np.partition(z, middle)[middle]
    constant = float(np.clip(spread_of(r), LEAST_SIGMA, MOST_SIGMA)), 0.0
    if near.all():
        return constant
    spreads = [spread_of(r[half]) + 1e-9 for half in (near, ~near)]
    if spreads[1] < GROWING * spreads[0]:
        return constant
    squares = [np.mean(z[half] ** 2) for half in (near, ~near)]
    growth = (spreads[1] - spreads[0]) / (squares[1] - squares[0])
    sigma = spreads[0] - growth * squares[0]
    if sigma < LEAST_SIGMA:
        sigma, growth = LEAST_SIGMA, (spreads[1] - LEAST_SIGMA) / squares[1]
    return float(np.clip(sigma, LEAST_SIGMA, MOST_SIGMA)), float(np.clip(growth, 0.0, MOST_GROWTH))


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


# Median share of a step that leaks across it, by the blur's standard deviation in pixels: measured on ideal steps in
# all directions (tests/detection/test_noise.py makes them again).
SIGMAS = (0.0, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0)
LEAKS = (0.0, 0.005, 0.039, 0.119, 0.194, 0.249, 0.278)
LEAST_STEP = 30.0  # standard deviations of the noise: smaller steps tell little
LEAST_COUNT = 60
LEAST_LEAK = 0.03  # below it the image is as good as sharp


def leaks(inverse_depth: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the shares of the steps that leak to the pixel beside them, along rows and columns.

    Inverse depth is affine on a plane, so two pixels on either side say what the next one would be without the blur.

    inverse_depth : (H, W), NaN where nothing returned; noise : (H, W), its standard deviation.
    """
    shares = []
    for w, n in ((inverse_depth, noise), (inverse_depth.T, noise.T)):
        a, b, p, q, c, d = (w[:, k : w.shape[1] - 5 + k] for k in range(6))
        left_p, left_q, right_p, right_q = 2 * b - a, 3 * b - 2 * a, 3 * c - 2 * d, 2 * c - d
        step_p, step_q = right_p - left_p, right_q - left_q
        with np.errstate(invalid="ignore"):
            clear = np.minimum(abs(step_p), abs(step_q)) > LEAST_STEP * n[:, 2 : w.shape[1] - 3]
            clear &= (step_p * step_q > 0) & (abs(step_p - step_q) < 0.3 * abs(step_p))
        for share in ((p - left_p)[clear] / step_p[clear], (right_q - q)[clear] / step_q[clear]):
            shares.append(np.minimum(share, 1 - share))
    return np.concatenate(shares)


def estimate_blur(depth: np.ndarray, sigma: float | np.ndarray) -> float:
    """Return the standard deviation, in pixels, of the blur of a depth image; 0 where it is sharp or cannot be told.

    depth : (H, W) metres, NaN or 0 = no return; sigma : (H, W) or float, standard deviation of the noise in metres.
    """
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
    shares = leaks(1 / depth, np.broadcast_to(sigma, depth.shape) / depth**2)
    leak = float(np.median(shares)) if len(shares) >= LEAST_COUNT else 0.0
    return float(np.interp(leak, LEAKS, SIGMAS)) if leak > LEAST_LEAK else 0.0
