"""A wall behind the objects: an upright plane that ends the floor, with nothing of the image behind it."""

import numpy as np

ANGLES = 90  # directions of a wall that are tried, over half a turn
WIDE = 0.5  # metres: a narrower upright face may be a solid's
SHARE = 0.2  # of what stands over the floor: the least that a wall holds
BEHIND = 0.02  # share of the pixels that may seem to lie behind a wall
MOST_POINTS = 3000
MOST_WALLS = 3


def walls_behind(points, good, above, sigma, origin):
    """Return (H, W) bool: pixels on walls or behind them; a room's corner has two. Takes what `wall_behind` does."""
    found = np.zeros(good.shape, bool)
    for _ in range(MOST_WALLS):
        wall = wall_behind(points, good & ~found, above & ~found, sigma, origin)
        if not wall.any():
            break
        found |= wall
    return found


def wall_behind(points, good, above, sigma, origin):
    """Return (H, W) bool: pixels on a wall or behind it; none where there is no wall.

    Parameters
    ----------
    points : (H, W, 3) float64, floor frame. good : (H, W) bool, pixels with a depth. above : those over the floor.
    sigma : (H, W) metres of noise. origin : (3,) the camera's centre, floor frame.
    """
    none = np.zeros(good.shape, bool)
    if above.sum() < 50:
        return none
    tolerance = max(0.01, 4.0 * float(np.median(sigma[above])))
    flat = points[above][:, :2] - origin[:2]
    flat = flat[:: max(1, len(flat) // MOST_POINTS)]
    everything = points[good][:, :2] - origin[:2]
    everything = everything[:: max(1, len(everything) // MOST_POINTS)]
    angle = np.arange(ANGLES) * 2.0 * np.pi / ANGLES
    away = np.column_stack([np.cos(angle), np.sin(angle)])  # from the camera through the wall
    for _ in range(2):  # a second time finely about the first answer
        distance, all_distance = flat @ away.T, everything @ away.T
        far = np.quantile(all_distance, 1.0 - BEHIND, axis=0)  # where a wall would be, were it across this direction
        on = np.abs(distance - far) < tolerance
        best = int(np.argmax(np.where(far > 0, on.mean(axis=0), 0.0)))
        angle = angle[best] + np.linspace(-1.0, 1.0, 21) * np.pi / ANGLES
        across = flat[on[:, best]] @ np.array([-away[best, 1], away[best, 0]])
        place, share, normal = far[best], on[:, best].mean(), away[best]
        away = np.column_stack([np.cos(angle), np.sin(angle)])
    if share < SHARE or np.ptp(np.quantile(across, (0.02, 0.98))) < WIDE:
        return none
    own = (flat @ normal)[np.abs(flat @ normal - place) < tolerance]
    return good & ((points[..., :2] - origin[:2]) @ normal > np.median(own) - tolerance)
