"""Depth images that were made of smaller ones, taken as they were before: enlarged, or with returns that lie scattered.

What pixels that repeat tell is told once: taken as independent they tell too much, and edges run in steps. Of 12 made
scenes enlarged by two to 320 x 240 pixels seven were told wrong at P .95.

Depths put into a larger colour image, one pixel each, leave a lattice of them there; other sensors return from a few
pixels only. Returns without neighbours hang together nowhere: where neighbours share noise all that stood on the floor
was taken for background piece by piece, and "nothing" was told at P .9; blocks with one return each were left empty.
Of independent noise with returns anywhere each tells as much as with all, and the image is taken as it is.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.camera.windows import total
from derender.compilation.cache import njit
from derender.detection.estimate import WIDEST
from derender.detection.pyramid import STEP, plane_at_origin, reduced_by
from derender.results.fit import scatter

FEWEST_ROWS = 16  # rows and columns of what was enlarged: in fewer regular repeats may be what is seen
LEAST_RATIO = 1.2  # times that rows repeat, in the mean; where a few are the same by chance it is hardly more than once
MOST_OFF = 1.0  # rows by which a repeat may begin beside where it would in equal steps: those of rounding
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


class Repeats(NamedTuple):
    """From which row, or column, of a smaller image each one of an image came."""

    source: np.ndarray  # (n,) int, ascending, each number from 0 on at least once
    ratio: float  # of the image's size to the smaller one's
    first: float  # where the middle of the smaller image's first row is in the image, rows

    @property
    def kept(self) -> np.ndarray:
        """(n',) int, of the rows that came from one the first."""
        return np.flatnonzero(np.diff(self.source, prepend=-1))


class Enlargement(NamedTuple):
    """How an image was made of a smaller one."""

    rows: Repeats
    columns: Repeats

    @property
    def ratio(self) -> float:
        """The image's size to the smaller one's, along a row and a column in the mean."""
        return float(np.sqrt(self.rows.ratio * self.columns.ratio))

    def told(self) -> str:
        """Return a line for a person."""
        return f"pixels repeat: taken as the {len(self.columns.kept)} x {len(self.rows.kept)} that were enlarged"

    def reduced(self, depth: np.ndarray) -> np.ndarray:
        """Return the smaller image (h, w) of an image (H, W)."""
        return np.ascontiguousarray(depth[self.rows.kept[:, None], self.columns.kept])

    def enlarged(self, values: np.ndarray) -> np.ndarray:
        """Return the image (H, W) of a smaller one (h, w)."""
        return np.ascontiguousarray(values[self.rows.source[:, None], self.columns.source])

    def camera(self, camera: Camera) -> Camera:
        """Return the camera of the smaller image."""
        rows, columns = self.rows, self.columns
        return replace(
            camera, width=len(columns.kept), height=len(rows.kept),
            fx=camera.fx / columns.ratio, fy=camera.fy / rows.ratio,
            cx=(camera.cx - columns.first) / columns.ratio, cy=(camera.cy - rows.first) / rows.ratio,
        )  # fmt: skip


def enlargement_of(depth: np.ndarray) -> Enlargement | None:
    """Return the Enlargement that a depth image (H, W), NaN = no return, went through; None: it was not enlarged so."""
    seen = np.nan_to_num(depth)
    found = Enlargement(repeats_of(seen), repeats_of(seen.T))
    return found if found.ratio > 1.0 else None


def repeats_of(image: np.ndarray) -> Repeats:
    """Return the Repeats among the rows of an image (n, m): each its own where they do not repeat in equal steps."""
    count = len(image)
    begins = np.flatnonzero((image[1:] != image[:-1]).any(axis=1)) + 1  # of all but the first, which may be cut off
    alone = Repeats(np.arange(count), 1.0, 0.0)
    if len(begins) < FEWEST_ROWS:
        return alone
    ratio = float(begins[-1] - begins[0]) / (len(begins) - 1)
    steps = begins[0] + ratio * np.arange(len(begins))
    cut = max(begins[0], count - begins[-1]) < ratio + MOST_OFF
    if ratio < LEAST_RATIO or not cut or np.abs(begins - steps).max() >= MOST_OFF:
        return alone
    source = np.zeros(count, int)
    source[begins] = 1
    begin = float(np.mean(begins - ratio * np.arange(1, len(begins) + 1)))  # of the first row, were it not cut off
    return Repeats(np.cumsum(source), ratio, begin + 0.5 * (ratio - 1.0))


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
