"""Windows about each pixel: the least and the greatest value, whether all or any are set; and what hangs together.

Without scipy, whose import takes as long as all else that a command imports. Beyond an image's border is nothing.
"""

import numpy as np

from derender.compilation.cache import njit


def greatest(image: np.ndarray, reach: int) -> np.ndarray:
    """Return the greatest value of an image (H, W), of any type, within `reach` rows and columns of each pixel."""
    return _extreme(np.maximum, image, reach)


def least(image: np.ndarray, reach: int) -> np.ndarray:
    """Return the least value of an image (H, W), of any type, within `reach` rows and columns of each pixel."""
    return _extreme(np.minimum, image, reach)


def _extreme(better: np.ufunc, image: np.ndarray, reach: int) -> np.ndarray:
    """Return the extreme about each pixel: windows to either side are doubled until they reach so far."""
    found = image.copy()
    for here in (found, found.T):
        up, down, wide, most = here.copy("K"), here, 0, min(reach, len(here) - 1)
        while wide < most:  # up[n] is that of n to n + wide, down[n] of n - wide to n
            step = min(wide + 1, most - wide)
            better(up[:-step], up[step:], out=up[:-step])
            better(down[step:], down[:-step], out=down[step:])
            wide += step
        better(up, down, out=here)
    return found


def total(image: np.ndarray, reach: int) -> np.ndarray:
    """Return the sum of an image (H, W) float within `reach` rows and columns of each pixel."""
    (height, width), wide, ways = image.shape, np.pad(image, reach), range(2 * reach + 1)
    across = np.sum([wide[:, k : k + width] for k in ways], axis=0)
    return np.sum([across[k : k + height] for k in ways], axis=0)


def of_five(better: np.ufunc, image: np.ndarray) -> np.ndarray:
    """Return the extreme of each pixel of an image (H, W) and its four neighbours; better : np.maximum or minimum."""
    found = image.copy()
    for here, there in ((found, image), (found.T, image.T)):
        better(here[1:], there[:-1], out=here[1:])
        better(here[:-1], there[1:], out=here[:-1])
    return found


def grown(mask: np.ndarray, steps: int) -> np.ndarray:
    """Return a mask (H, W) bool with what is so many steps to a neighbour, of four, from it."""
    for _ in range(steps):
        mask = of_five(np.maximum, mask)
    return mask


def shrunk(mask: np.ndarray, steps: int) -> np.ndarray:
    """Return a mask (H, W) bool without what is so many steps, or fewer, from what is not in it; nothing beyond the
    border is."""
    return ~grown(np.pad(~mask, 1, constant_values=True), steps)[1:-1, 1:-1]


def opened(mask: np.ndarray, reach: int) -> np.ndarray:
    """Return what of a mask (H, W) bool is covered by squares of 2 reach + 1 pixels that lie within it."""
    inner = least(np.pad(mask, 1), reach)[1:-1, 1:-1]
    return greatest(inner, reach)


@njit(cache=True, nogil=True)
def labelled(mask):
    """Return ((H, W) int64: k where a pixel of a mask is in the k-th of its parts, from 1, and 0 elsewhere; how many
    there are): pixels hang together by their sides."""
    height, width = mask.shape
    label = np.zeros((height, width), np.int64)
    waiting = np.empty((mask.size, 2), np.int64)
    count = 0
    for row in range(height):
        for column in range(width):
            if not mask[row, column] or label[row, column] > 0:
                continue
            count += 1
            label[row, column] = count
            waiting[0, 0], waiting[0, 1], ahead = row, column, 1
            while ahead > 0:
                ahead -= 1
                j, i = waiting[ahead, 0], waiting[ahead, 1]
                for down, right in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                    v, u = j + down, i + right
                    if 0 <= v < height and 0 <= u < width and mask[v, u] and label[v, u] == 0:
                        label[v, u] = count
                        waiting[ahead, 0], waiting[ahead, 1] = v, u
                        ahead += 1
    return label, count
