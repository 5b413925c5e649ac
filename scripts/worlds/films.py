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
