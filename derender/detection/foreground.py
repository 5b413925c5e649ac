"""Objects so near the camera that they hide the floor on which they stand.

What stands beyond the visible floor's outline is usually background: a wall, the room behind a table. An object that
fills the image stands there too, but it is joined to what stands over visible floor, is no higher than the camera, and
no wider than LARGEST.
"""

import numpy as np

LARGEST = 0.5  # metres across
SHARE = 0.5  # of what stands over the floor: with less beyond its outline nothing fills the image
FEWEST = 4  # pixels over visible floor that join an object to it


def joined_to_floor(points, above, inside, footprint, camera_height):
    """Return (H, W) bool: pixels beyond the floor's outline that belong to an object which fills the image.

    Parameters
    ----------
    points : (H, W, 3) float64, floor frame. above : (H, W) bool, pixels that stand over the floor's plane.
    inside : (H, W) bool, pixels within the outline of the visible floor. footprint : (H, W) metres across a pixel.
    camera_height : metres over the floor.
    """
    found = np.zeros(above.shape, bool)
    beyond = above & ~inside
    if beyond.sum() < SHARE * max(above.sum(), 1):
        return found
    from scipy import ndimage

    limit = 4 * footprint + 0.004
    whole = above.copy()  # without the pixels at jumps, so that components end there
    for axis in (0, 1):
        step = np.linalg.norm(np.diff(points, axis=axis), axis=-1)
        near = step < (limit[1:] if axis == 0 else limit[:, 1:])
        if axis == 0:
            whole[1:] &= near
        else:
            whole[:, 1:] &= near
    labels, _ = ndimage.label(whole)
    for label in np.unique(labels[whole & inside]):
        member = labels == label
        own = points[member]
        spread = float(np.ptp(own[:, :2], axis=0).max())
        if (member & inside).sum() >= FEWEST and own[:, 2].max() < camera_height and spread < LARGEST:
            found |= member
    if not found.any():
        return found
    return above & ndimage.binary_dilation(found, iterations=1)
