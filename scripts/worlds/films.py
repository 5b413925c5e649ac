"""What films of moving solids have for truth."""

import numpy as np

GRAVITY = 9.81  # m/s^2
# Metres: a hop that is no higher, by the time until the pair touches again, is no change of what bears a thing. Who
# watches a film sees nothing of it, and a thing that has fallen lands with several.
HOP = 0.005


def without_hops(touched: np.ndarray, step: float) -> np.ndarray:
    """Return what touches what at each step, (S, N, N + 1) bool, with hops of at most HOP taken as contact.

    step : seconds from one to the next.
    """
    kept, longest = touched.copy(), int(np.sqrt(8 * HOP / GRAVITY) / step)
    for pair in np.argwhere(touched.any(axis=0)):
        steps = np.append(np.flatnonzero(touched[:, *pair]), len(touched))
        for begin, end in zip(steps[:-1], steps[1:], strict=True):
            if end - begin <= longest:
                kept[begin:end, *pair] = True
    return kept


ARM = 0.8  # metres of a forearm: its other end is outside the image


def hand_of(rng: np.random.Generator, grip: float) -> np.ndarray:
    """Return spheres (K, 4), each its centre and radius in metres, of a hand and its forearm, no two alike.

    The origin is between the fingertips, x points there from the wrist, y from the fingers to the thumb, which are grip
    metres apart.
    """
    spheres: list[list[float]] = []

    def chain(first, last, count, radii, bulge=0.0):
        for s in np.linspace(0.0, 1.0, count):
            centre = (1 - s) * np.array(first) + s * np.array(last) + [0.0, 4 * s * (1 - s) * bulge, 0.0]
            spheres.append([*centre, np.interp(s, [0.0, 1.0], radii) * rng.uniform(0.93, 1.07)])

    chain([-0.16 - ARM, 0.0, 0.0], [-0.16, 0.0, 0.0], 55, (0.042, 0.030))
    for z in np.linspace(-0.03, 0.03, 4):
        chain([-0.15, 0.0, z], [-0.085, -0.01, z], 5, (0.018, 0.015))
        chain([-0.085, -0.01, z], [-rng.uniform(0.0, 0.02), -grip / 2 - 0.008, 0.8 * z], 9, (0.011, 0.008), -0.02)
    chain([-0.12, 0.02, -0.02], [-0.01, grip / 2 + 0.009, 0.0], 8, (0.014, 0.009), 0.02)
    return np.array(spheres)
