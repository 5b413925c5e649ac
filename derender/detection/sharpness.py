"""How blurred a depth image is, told by the pixels beside its steps."""

import numpy as np

# Median share of a step that leaks across it, by the blur's standard deviation in pixels: measured on ideal steps in
# all directions (tests/detection/test_sharpness.py makes them again).
SIGMAS = (0.0, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0)
LEAKS = (0.0, 0.005, 0.039, 0.119, 0.194, 0.249, 0.278)
LEAST_STEP = 30.0  # standard deviations of the noise: smaller steps tell little
LEAST_COUNT = 60
LEAST_LEAK = 0.03  # below it the image is as good as sharp


def leaks(inverse_depth, noise):
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


def estimate_blur(depth, sigma):
    """Return the standard deviation, in pixels, of the blur of a depth image; 0 where it is sharp or cannot be told.

    depth : (H, W) metres, NaN or 0 = no return; sigma : (H, W) or float, standard deviation of the noise in metres.
    """
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
    shares = leaks(1 / depth, np.broadcast_to(sigma, depth.shape) / depth**2)
    leak = float(np.median(shares)) if len(shares) >= LEAST_COUNT else 0.0
    return float(np.interp(leak, LEAKS, SIGMAS)) if leak > LEAST_LEAK else 0.0
