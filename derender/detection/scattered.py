"""Depth images whose returns lie scattered, taken as images of as many pixels as returned.

Depths put into a larger colour image, one pixel each, leave a lattice of them there; other sensors return from a few
pixels only. Returns without neighbours hang together nowhere: where neighbours share noise all that stood on the floor
was taken for background piece by piece, and "nothing" was told at P .9; blocks with one return each were left empty.
Of independent noise with returns anywhere each tells as much as with all, and the image is taken as it is.
"""

import numpy as np

from derender.camera.intrinsics import Camera
from derender.camera.repeats import Enlargement, Repeats, enlargement_of
from derender.camera.windows import total
from derender.compilation.cache import njit
from derender.detection.estimate import WIDEST
from derender.detection.pyramid import STEP, plane_at_origin, reduced_by
from derender.results.fit import scatter

# Pixels about a return in which is counted how many others are; their share, at the median return, up to which returns
# left by chance hang together nowhere (percolation, from .593 on), and a lattice with lines left out does not: where
# the image is searched at half its size, or all of it. Of larger ones a pixel stands for a block, of which a fifth has
# to return: this share is enough. (Of 150 real frames it is .95 at least; but for two put into a colour image: .6.)
ABOUT, SCATTERED, LINES, HALF, ENOUGH = 4, 0.593, 0.8, 2, 0.3
LEAST = 500  # returns that tell how they lie
ALONG = 0.92  # the same of those in its row, and in its column: rows that are scanned with gaps hang together
# Share of a return's eight neighbours that returned against that of all about it: of returns left by chance .98 to
# 1.04, on lattices of 1.15 to 3 pixels 1.07 to 1.12, .96, .87 and less.
CHANCE = 0.97, 1.05
# Deviation of depths that are bent between neighbours against that between those twice as far apart, where they share
# noise: .94 and more of independent noise, .32 to .8 of any other.
SHARED = 0.88
# Of nine cells about one with a return so many have one too, but about a share of them: cells as far apart as a
# lattice's lines are left empty in stripes, one of which hid a sphere. They are so much wider until that is so, or so
# many times in all, where returns are patchy besides. (Of returns left by chance 1.4 times, of lattices up to that.)
FILLED, FEW, WIDER, WIDEST_CELLS = 7, 0.2, 1.05, 1.5
SURROUNDING = 1.5  # cells about a cell's middle by whose returns is told how its surface slopes
FEWEST = 4  # returns that tell it


class Scattering(Enlargement):
    """Cells of equal size over an image, each a pixel of the smaller one that it is taken as."""

    def told(self) -> str:
        """Return a line for a person."""
        return f"returns lie scattered: taken as an image of {len(self.columns.kept)} x {len(self.rows.kept)} pixels"

    def reduced(self, depth: np.ndarray) -> np.ndarray:
        """Return the smaller image (h, w) of one (H, W): of each cell the return that is nearest to its middle, moved
        there along the surface that those about it show; NaN = no return."""
        rows, columns = self.rows, self.columns
        seen = np.nan_to_num(np.asarray(depth, float))
        found = gathered(seen, rows.source, columns.source, rows.ratio, columns.ratio)
        return np.where(found > 0.0, found, np.nan)


def smaller_image_of(depth: np.ndarray) -> Enlargement | None:
    """Return how a depth image (H, W), NaN = no return, was made of a smaller one; None: it is to be taken as it is."""
    return enlargement_of(depth) or scattering_of(depth)


def as_made(depth: np.ndarray, camera: Camera) -> tuple[np.ndarray, Camera]:
    """Return the image that one (H, W) was made of, with its camera; one that was not made of another as it is."""
    found = smaller_image_of(depth)
    return (depth, camera) if found is None else (found.reduced(depth), found.camera(camera))


def scattering_of(depth: np.ndarray) -> Scattering | None:
    """Return the Scattering of the returns of a depth image (H, W), NaN = no return; None: it is taken as it is."""
    seen = np.nan_to_num(depth) > 0.0
    if seen.sum() < LEAST:
        return None
    count, pixels = total(seen.astype(float), ABOUT)[seen], (2 * ABOUT + 1) ** 2
    share = float(np.median(count)) / pixels
    if share > LINES or max(share_along(seen), share_along(seen.T)) > ALONG:
        return None
    beside = total(seen.astype(float), 1)[seen].mean() - 1.0
    by_chance = CHANCE[0] < beside / 8 / ((count.mean() - 1.0) / (pixels - 1)) < CHANCE[1]
    if share > (ENOUGH if reduced_by(depth, WIDEST) > HALF else SCATTERED if by_chance else LINES):
        return None
    found = Scattering(*cells_over(seen, share**-0.5))
    return found if not by_chance or shares_noise(found.reduced(depth)) else None


def cells_over(seen: np.ndarray, ratio: float) -> Enlargement:
    """Return cells of `ratio` pixels, or so much larger that most of those about returns, (H, W) bool, have one."""
    (rows, columns), most = np.nonzero(seen), WIDEST_CELLS * ratio
    while True:
        cells = Enlargement(*(cells_of(side, ratio) for side in seen.shape))
        filled = np.zeros([len(each.kept) for each in cells], bool)
        filled[cells.rows.source[rows], cells.columns.source[columns]] = True
        if np.quantile(total(filled.astype(float), 1)[filled], FEW) >= FILLED or WIDER * ratio > most:
            return cells
        ratio *= WIDER


def shares_noise(depth: np.ndarray) -> bool:
    """Return whether neighbouring pixels of an image (H, W), NaN = no return, share noise: between them it bends less.

    The inverse depth of a plane is affine, so that three of its pixels in line are bent by their noise alone.
    """
    bends = []
    for step in (1, 2):
        of = [
            (each[: -2 * step] - 2.0 * each[step:-step] + each[2 * step :]).ravel() for each in (1 / depth, 1 / depth.T)
        ]
        bent = np.concatenate(of)
        bends.append(bent[np.isfinite(bent)])
    return all(map(len, bends)) and scatter(bends[0]) < SHARED * scatter(bends[1])


def share_along(seen: np.ndarray) -> float:
    """Return the share of the pixels in the same row, ABOUT to either side, that returned, at the median return."""
    wide = np.pad(seen.astype(float), ((0, 0), (ABOUT, ABOUT)))
    count = np.sum([wide[:, k : k + seen.shape[1]] for k in range(2 * ABOUT + 1)], axis=0)
    return float(np.median(count[seen])) / (2 * ABOUT + 1)


def cells_of(side: int, ratio: float) -> Repeats:
    """Return the cells of `ratio` pixels each along a side of an image."""
    return Repeats(((np.arange(side) + 0.5) / ratio).astype(int), ratio, 0.5 * (ratio - 1.0))


@njit(cache=True, nogil=True)
def gathered(depth, of_row, of_column, tall, wide):
    """Return (h, w) depths at the middles of cells, see `Scattering.reduced`; 0 where none returned.

    depth : (H, W) metres, 0 = no return. of_row, of_column : (H,) and (W,), in which cell each pixel is. tall, wide : a
    cell's size in pixels.
    """
    height, width = of_row[-1] + 1, of_column[-1] + 1
    out = np.zeros((height, width))
    nearest = np.full((height, width), np.inf)
    own = np.zeros((height, width, 2), np.int64)
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            if depth[v, u] > 0.0:
                j, i = of_row[v], of_column[u]
                off = (v + 0.5 - (j + 0.5) * tall) ** 2 + (u + 0.5 - (i + 0.5) * wide) ** 2
                if off < nearest[j, i]:
                    nearest[j, i], own[j, i, 0], own[j, i, 1] = off, v, u
    down, across = int(np.ceil(SURROUNDING * tall)), int(np.ceil(SURROUNDING * wide))
    most = (2 * down + 1) * (2 * across + 1)
    values, place, moved = np.empty(most), np.empty((most, 2)), np.empty((most, 2))
    for j in range(height):
        for i in range(width):
            if nearest[j, i] == np.inf:
                continue
            row, column, n = own[j, i, 0], own[j, i, 1], 0
            z = depth[row, column]
            out[j, i] = z
            for v in range(max(0, row - down), min(depth.shape[0], row + down + 1)):
                for u in range(max(0, column - across), min(depth.shape[1], column + across + 1)):
                    if abs(depth[v, u] - z) < STEP * z:
                        values[n] = depth[v, u]
                        place[n, 0], place[n, 1] = u - column, v - row
                        moved[n, 0], moved[n, 1] = u + 0.5 - (i + 0.5) * wide, v + 0.5 - (j + 0.5) * tall
                        n += 1
            if n >= FEWEST:
                here = plane_at_origin(values[:n], place[:n], z, STEP * z, True)
                out[j, i] = z * plane_at_origin(values[:n], moved[:n], z, STEP * z, True) / here
    return out
