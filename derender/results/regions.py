"""Regions of an image: coherent sets of pixels, what they are called, and where they lie in words."""

from typing import NamedTuple

import numpy as np

LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"


class Region(NamedTuple):
    """A coherent set of pixels.

    Attributes
    ----------
    name : a letter; on pictures it stands at the region.
    mask : (H, W) bool.
    share : of the image's pixels with a depth.
    """

    name: str
    mask: np.ndarray
    share: float

    @property
    def where(self) -> str:
        """Where it lies, such as "left of the middle"."""
        return place_words(self.mask)


def components(mask: np.ndarray) -> tuple[np.ndarray, int]:
    """Return label (H, W) int, 0 outside the mask and 1 to n for its 4-connected components, and n.

    By runs along rows, joined where those of neighbouring rows overlap: scipy.ndimage takes longer to load than this.
    """
    height, width = mask.shape
    padded = np.zeros((height, width + 2), np.int8)
    padded[:, 1:-1] = mask
    row, begin = np.nonzero(np.diff(padded, axis=1) == 1)
    _, end = np.nonzero(np.diff(padded, axis=1) == -1)  # run k holds the columns begin[k] to end[k] - 1
    parent = np.arange(len(row))

    def root(k: int) -> int:
        while parent[k] != k:
            parent[k] = parent[parent[k]]
            k = int(parent[k])
        return k

    first = np.searchsorted(row, np.arange(height + 1))
    for y in range(1, height):
        above, here = first[y - 1], first[y]
        while above < first[y] and here < first[y + 1]:
            if begin[above] < end[here] and begin[here] < end[above]:
                one, other = root(above), root(here)
                parent[max(one, other)] = min(one, other)
            if end[above] < end[here]:
                above += 1
            else:
                here += 1
    roots = np.array([root(k) for k in range(len(row))], int)
    kept, number = np.unique(roots, return_inverse=True)
    label = np.zeros((height, width + 1), np.int64)
    np.add.at(label, (row, begin), number + 1)
    np.add.at(label, (row, end), -(number + 1))
    return label.cumsum(axis=1)[:, :width], len(kept)


def opened(mask: np.ndarray, reach: int) -> np.ndarray:
    """Return the mask without what is nowhere 2 reach + 1 pixels wide and high."""
    return _dilated(~_dilated(~mask, reach, True), reach, False)


def _dilated(mask: np.ndarray, reach: int, outside: bool) -> np.ndarray:
    """Return the mask grown by `reach` pixels in rows and columns; beyond the image it is `outside`."""
    side = 2 * reach + 1
    padded = np.pad(mask, reach, constant_values=outside).astype(np.int64)
    sums = np.pad(padded, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    return sums[side:, side:] + sums[:-side, :-side] > sums[:-side, side:] + sums[side:, :-side]


def place_words(mask: np.ndarray) -> str:
    """Return where the middle of a mask (H, W) lies in the image, in words."""
    rows, columns = np.nonzero(mask)
    down, across = rows.mean() / mask.shape[0], columns.mean() / mask.shape[1]
    vertical = "" if 0.4 <= down <= 0.6 else "above" if down < 0.4 else "below"
    sideways = "" if 0.4 <= across <= 0.6 else "left of" if across < 0.4 else "right of"
    if not vertical and not sideways:
        return "in the middle"
    if vertical and sideways:
        return f"{vertical} and {sideways} the middle"
    return f"{vertical or sideways} the middle"
