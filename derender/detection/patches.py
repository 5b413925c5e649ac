"""Planar patches of a depth image: local plane fits, each pixel taking its best window, grown to regions."""

from typing import NamedTuple

import numpy as np

from derender.compilation.cache import njit
from derender.detection.local_planes import local_planes, separation, sharpen, smallest_eigenvector
from derender.detection.regions import grow, reassign


class Patches(NamedTuple):
    """Planar pieces of the surface above the floor.

    Attributes
    ----------
    label : (H, W) int32, patch of each pixel or -1.
    normal : (P, 3) float64 unit, towards the camera; offset : (P,) float64: normal . point.
    pixels : (P,) int64, how many; centre : (P, 3) float64.
    residual : (P,) float64, root mean square distance to the plane in metres.
    touching : (P, P) int64, pairs of neighbouring pixels without a jump in depth between two patches.
    """

    label: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    pixels: np.ndarray
    centre: np.ndarray
    residual: np.ndarray
    touching: np.ndarray


@njit(cache=True, nogil=True)
def moments(points, label, regions):
    """Return count (P,), centre (P, 3), and scatter (P, 6: xx xy xz yy yz zz) of the regions' points."""
    count = np.zeros(regions, np.int64)
    centre = np.zeros((regions, 3))
    scatter = np.zeros((regions, 6))
    height, width = label.shape
    for passes in range(2):
        for j in range(height):
            for i in range(width):
                k = label[j, i]
                if k < 0:
                    continue
                if passes == 0:
                    count[k] += 1
                    for axis in range(3):
                        centre[k, axis] += points[j, i, axis]
                else:
                    x = points[j, i, 0] - centre[k, 0]
                    y = points[j, i, 1] - centre[k, 1]
                    z = points[j, i, 2] - centre[k, 2]
                    scatter[k, 0] += x * x
                    scatter[k, 1] += x * y
                    scatter[k, 2] += x * z
                    scatter[k, 3] += y * y
                    scatter[k, 4] += y * z
                    scatter[k, 5] += z * z
        if passes == 0:
            for k in range(regions):
                for axis in range(3):
                    centre[k, axis] /= max(count[k], 1)
    return count, centre, scatter


@njit(cache=True, nogil=True)
def fit_regions(points, label, regions, origin):
    """Return normal (P, 3) towards the origin, offset (P,), count, centre, residual of all regions."""
    count, centre, scatter = moments(points, label, regions)
    normal = np.zeros((regions, 3))
    offset = np.zeros(regions)
    residual = np.zeros(regions)
    for k in range(regions):
        n = max(count[k], 1)
        a, b, c, value = smallest_eigenvector(scatter[k, 0] / n, scatter[k, 1] / n, scatter[k, 2] / n,
                                              scatter[k, 3] / n, scatter[k, 4] / n, scatter[k, 5] / n)  # fmt: skip
        if (a * (origin[0] - centre[k, 0]) + b * (origin[1] - centre[k, 1]) + c * (origin[2] - centre[k, 2])) < 0:
            a, b, c = -a, -b, -c
        normal[k, 0], normal[k, 1], normal[k, 2] = a, b, c
        offset[k] = a * centre[k, 0] + b * centre[k, 1] + c * centre[k, 2]
        residual[k] = np.sqrt(value)
    return normal, offset, count, centre, residual


@njit(cache=True, nogil=True)
def touching_pixels(points, label, regions, jump):
    """Return (P, P) int64: pairs of neighbouring pixels of two regions without a jump in depth."""
    height, width = label.shape
    touching = np.zeros((regions, regions), np.int64)
    for j in range(height):
        for i in range(width):
            a = label[j, i]
            if a < 0:
                continue
            for way in range(4):
                v, u = (j, i + 1 + way // 2) if way % 2 == 0 else (j + 1 + way // 2, i)
                if v >= height or u >= width:
                    continue
                b = label[v, u]
                if b < 0 or a == b:
                    continue
                if separation(points, j, i, v, u) < (jump[j, i] * (2.0 + way // 2)) ** 2:
                    touching[a, b] += 1
                    touching[b, a] += 1
    return touching


def find_patches(points, mask, origin, sigma, footprint, smallest=8):
    """Segment the surface into planar patches.

    Parameters
    ----------
    points : (H, W, 3) float64, floor frame (any finite numbers where mask is False).
    mask : (H, W) bool, pixels to segment; sigma : (H, W) noise in metres; footprint : (H, W) size of a pixel in metres.
    smallest : pixels that a patch must have.
    """
    jump = np.ascontiguousarray(2.5 * footprint + 3 * sigma)
    tolerance = np.ascontiguousarray(3.0 * sigma)
    normal, offset, error = local_planes(points, mask, origin, jump, 2)
    normal, quality = sharpen(points, mask, normal, offset, error, 2, tolerance)
    order = np.argsort(quality.ravel(), kind="stable")
    order = order[quality.ravel()[order] < 1e8].astype(np.int64)
    label, regions = grow(points, mask, normal, quality, order, tolerance, jump, np.cos(np.radians(22)), smallest)
    for _ in range(2):
        plane_normal, plane_offset, count, centre, residual = fit_regions(points, label, regions, origin)
        reassign(points, mask, label, plane_normal, plane_offset, tolerance, jump, 4)
    # reassignment can leave a region with next to nothing: number the others anew
    alive = np.bincount(label[label >= 0], minlength=regions) >= max(smallest // 2, 4)
    number = np.append(np.where(alive, np.cumsum(alive) - 1, -1), -1).astype(np.int32)
    label, regions = np.ascontiguousarray(number[label]), int(alive.sum())
    plane_normal, plane_offset, count, centre, residual = fit_regions(points, label, regions, origin)
    return Patches(label, plane_normal, plane_offset, count, centre, residual,
                   touching_pixels(points, label, regions, jump))  # fmt: skip
