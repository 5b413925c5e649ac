"""The noise of depths, from residuals among which some are not noise, and which a sensor may have rounded."""

import numpy as np

# Standard deviations beyond which residuals are no noise, and how wide a standard normal number scatters within.
NO_NOISE, WITHIN = 3.0, 0.9866
# Share of residuals that surely are noise, and what so many of standard normal ones are below.
MOST, AT_MOST = 0.75, 1.1503
ROUNDS = 30  # of leaving out, at most
LEAST_SIGMA, MOST_SIGMA, MOST_GROWTH = 1e-4, 1.0, 1.0  # the last two as a likelihood allows them
GROWING = 1.08  # times the near half's noise from which the far half's is clearly more


def noise_of(residual, depth):
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
    squares = [np.mean(z[half] ** 2) for half in (near, ~near)]
    if spreads[1] < GROWING * spreads[0]:
        return constant
    growth = (spreads[1] - spreads[0]) / (squares[1] - squares[0])
    sigma = spreads[0] - growth * squares[0]
    if sigma < LEAST_SIGMA:
        sigma, growth = LEAST_SIGMA, (spreads[1] - LEAST_SIGMA) / squares[1]
    return float(np.clip(sigma, LEAST_SIGMA, MOST_SIGMA)), float(np.clip(growth, 0.0, MOST_GROWTH))


def spread_of(residual):
    """Return the standard deviation of residuals (N,) about zero, N > 0, without those that are no noise.

    It begins with what most of them are below, and leaves out what lies beyond NO_NOISE of it again and again. Of
    depths that a sensor rounds to steps as wide as its noise a median tells where a step lies, not how wide they
    scatter.
    """
    square = np.sort(np.square(residual))  # so that those within a limit are the first ones
    sums = np.cumsum(square)
    low, between = divmod(MOST * (len(square) - 1), 1.0)
    low, high = square[int(low)], square[min(int(low) + 1, len(square) - 1)]
    spread, count = np.sqrt(low + between * (high - low)) / AT_MOST, 0
    for _ in range(ROUNDS):
        kept = int(np.searchsorted(square, (NO_NOISE * spread) ** 2, "right"))
        if kept == count:
            break
        spread, count = np.sqrt(sums[kept - 1] / kept) / WITHIN, kept
    return float(spread)
