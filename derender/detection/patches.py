"""Planar patches of a depth image: planes through each pixel's neighbours, its best window taken, grown to regions.

Regions of pixels on one plane grow from the best pixels on, then are mended at their borders.
"""

from itertools import product
from typing import NamedTuple

import numpy as np

from derender.compilation.cache import njit

APART = 6.0  # widths of a pixel between the points of neighbours that belong to different bodies


def components(tied: np.ndarray) -> list[list[int]]:
    """Return what hangs together, in order, of N things of which some are tied (N, N) bool to each other.

    Without scipy, whose import takes long.
    """
    tied, found, left = tied | tied.T, [], list(range(len(tied)))
    while left:
        part, ahead = set[int](), {left[0]}
        while ahead:
            part |= ahead
            ahead = set(np.flatnonzero(tied[list(ahead)].any(axis=0)).tolist()) - part
        found.append(sorted(part))
        left = [k for k in left if k not in part]
    return found


@njit(cache=True, nogil=True)
def separation(points, j, i, v, u):
    """Return the squared distance of two pixels' points."""
    x = points[v, u, 0] - points[j, i, 0]
    y = points[v, u, 1] - points[j, i, 1]
    z = points[v, u, 2] - points[j, i, 2]
    return x * x + y * y + z * z


@njit(cache=True, nogil=True)
def smallest_eigenvector(a, b, c, d, e, f):
    """Return (x, y, z, eigenvalue) of the smallest eigenvalue of [[a, b, c], [b, d, e], [c, e, f]]."""
    mean = (a + d + f) / 3.0
    p1 = b * b + c * c + e * e
    p2 = (a - mean) ** 2 + (d - mean) ** 2 + (f - mean) ** 2 + 2 * p1
    p = np.sqrt(p2 / 6.0) + 1e-30
    a1, d1, f1 = (a - mean) / p, (d - mean) / p, (f - mean) / p
    b1, c1, e1 = b / p, c / p, e / p
    half = 0.5 * (a1 * (d1 * f1 - e1 * e1) - b1 * (b1 * f1 - e1 * c1) + c1 * (b1 * e1 - d1 * c1))
    angle = np.arccos(min(1.0, max(-1.0, half))) / 3.0
    value = mean + 2 * p * np.cos(angle + 2.0943951023931953)
    a, d, f = a - value, d - value, f - value
    # rows of the shifted matrix span the plane orthogonal to the eigenvector: take the longest cross product
    x0, y0, z0 = b * e - c * d, c * b - a * e, a * d - b * b
    x1, y1, z1 = b * f - c * e, c * c - a * f, a * e - b * c
    x2, y2, z2 = d * f - e * e, e * c - b * f, b * e - d * c
    s0, s1, s2 = x0 * x0 + y0 * y0 + z0 * z0, x1 * x1 + y1 * y1 + z1 * z1, x2 * x2 + y2 * y2 + z2 * z2
    if s0 >= s1 and s0 >= s2:
        x, y, z, s = x0, y0, z0, s0
    elif s1 >= s2:
        x, y, z, s = x1, y1, z1, s1
    else:
        x, y, z, s = x2, y2, z2, s2
    s = np.sqrt(s) + 1e-30
    return x / s, y / s, z / s, max(value, 0.0)


@njit(cache=True, nogil=True)
def add_point(sums, x, y, z):
    """Add a point to the sums (10,) from which `plane_of` tells the plane: its number, coordinates and products."""
    sums[0] += 1.0
    sums[1] += x
    sums[2] += y
    sums[3] += z
    sums[4] += x * x
    sums[5] += x * y
    sums[6] += x * z
    sums[7] += y * y
    sums[8] += y * z
    sums[9] += z * z


@njit(cache=True, nogil=True)
def plane_of(sums):
    """Return the normal (a, b, c) of the plane through the points, its offset, and the mean squared distance to it."""
    n = sums[0]
    x, y, z = sums[1] / n, sums[2] / n, sums[3] / n
    a, b, c, value = smallest_eigenvector(sums[4] / n - x * x, sums[5] / n - x * y, sums[6] / n - x * z,
                                          sums[7] / n - y * y, sums[8] / n - y * z, sums[9] / n - z * z)  # fmt: skip
    return a, b, c, a * x + b * y + c * z, value


@njit(cache=True, nogil=True)
def local_planes(points, mask, origin, jump, radius):
    """Fit a plane to the window about each pixel.

    Returns normal (H, W, 3) towards the origin (zero where there is none), offset (H, W), mean squared distance (H, W).
    """
    height, width = mask.shape
    normal = np.zeros((height, width, 3))
    offset = np.zeros((height, width))
    error = np.full((height, width), 1e9)
    sums = np.empty(10)
    for j in range(height):
        for i in range(width):
            if not mask[j, i]:
                continue
            px, py, pz = points[j, i, 0], points[j, i, 1], points[j, i, 2]
            limit = jump[j, i]
            sums[:] = 0.0
            for v in range(max(j - radius, 0), min(j + radius + 1, height)):
                for u in range(max(i - radius, 0), min(i + radius + 1, width)):
                    if not mask[v, u]:
                        continue
                    x, y, z = points[v, u, 0] - px, points[v, u, 1] - py, points[v, u, 2] - pz
                    if x * x + y * y + z * z <= limit * limit * (1 + (u - i) ** 2 + (v - j) ** 2):
                        add_point(sums, x, y, z)
            n = sums[0]
            if n < 6:
                continue
            a, b, c, beyond, value = plane_of(sums)
            if a * (origin[0] - px) + b * (origin[1] - py) + c * (origin[2] - pz) < 0:
                a, b, c, beyond = -a, -b, -c, -beyond
            normal[j, i, 0], normal[j, i, 1], normal[j, i, 2] = a, b, c
            offset[j, i] = a * px + b * py + c * pz + beyond
            error[j, i] = value * n / (n - 3.0)  # three numbers were fitted
    return normal, offset, error


def turned(array: np.ndarray, times: int) -> np.ndarray:
    """Return an array (H, W, ...) turned by quarter turns."""
    return np.ascontiguousarray(np.rot90(array, times))


class SeenSurface(NamedTuple):
    """What a camera shows of surfaces, in an upright frame."""

    points: np.ndarray  # (H, W, 3) float64
    good: np.ndarray  # (H, W) bool, pixels with a depth
    footprint: np.ndarray  # (H, W) metres across a pixel
    jump: np.ndarray  # (H, W) metres between the points of neighbours of one body, at most
    origin: np.ndarray  # (3,) the camera's centre

    @classmethod
    def of(cls, points: np.ndarray, good: np.ndarray, footprint: np.ndarray, sigma: np.ndarray,
           origin: np.ndarray) -> "SeenSurface":  # fmt: skip
        """Return the surface seen with noise of `sigma` (H, W) metres."""
        return cls(points, good, footprint, np.ascontiguousarray(APART * footprint + 3.0 * sigma), origin)

    def in_units_of(self, metres: float) -> "SeenSurface":
        """Return the surface with all its lengths counted in so many metres."""
        points, good, *lengths = self
        return SeenSurface(points / metres, good, *(each / metres for each in lengths))

    def turned(self, times: int) -> "SeenSurface":
        """Return the surface as an image of it shows it that is turned by quarter turns, see `numpy.rot90`."""
        points, good, footprint, jump = (turned(each, times) for each in self[:-1])
        return SeenSurface(points, good, footprint, jump, self.origin)

    def normals(self, mask: np.ndarray) -> np.ndarray:
        """Return (H, W, 3) the normals at the pixels of a mask (H, W), by these alone; zero where there is none."""
        return local_planes(self.points, mask, self.origin, self.jump, 2)[0]


@njit(cache=True, nogil=True)
def sharpen(points, mask, normal, offset, error, radius, tolerance):
    """Give each pixel the plane of the best window that holds it, so that normals stay sharp at edges."""
    height, width = mask.shape
    out = np.zeros((height, width, 3))
    quality = np.full((height, width), 1e9)
    for j in range(height):
        for i in range(width):
            if not mask[j, i]:
                continue
            best, bu, bv = 1e8, -1, -1
            for v in range(max(j - radius, 0), min(j + radius + 1, height)):
                for u in range(max(i - radius, 0), min(i + radius + 1, width)):
                    if error[v, u] >= 1e8:
                        continue
                    r = (normal[v, u, 0] * points[j, i, 0] + normal[v, u, 1] * points[j, i, 1]
                         + normal[v, u, 2] * points[j, i, 2] - offset[v, u])  # fmt: skip
                    if abs(r) > tolerance[j, i]:
                        continue
                    e = error[v, u] + 0.2 * r * r
                    if e < best:
                        best, bu, bv = e, u, v
            if bu >= 0:
                for axis in range(3):
                    out[j, i, axis] = normal[bv, bu, axis]
                quality[j, i] = best
    return out, quality


@njit(cache=True, nogil=True)
def grow(points, mask, normal, quality, order, tolerance, jump, cosine, smallest):
    """Grow regions from the best pixels on; return label (H, W) and the number of regions.

    A neighbour joins when it lies within its tolerance of the region's running plane and its own normal is near.
    """
    height, width = mask.shape
    label = np.full((height, width), -1, np.int32)
    stack = np.empty((height * width, 2), np.int32)
    member = np.empty((height * width, 2), np.int32)
    regions = 0
    sums = np.empty(10)
    for seed in order:
        sj, si = seed // width, seed % width
        if label[sj, si] != -1 or not mask[sj, si] or quality[sj, si] > 1e8:
            continue
        nx, ny, nz = normal[sj, si, 0], normal[sj, si, 1], normal[sj, si, 2]
        bx, by, bz = points[sj, si, 0], points[sj, si, 1], points[sj, si, 2]
        plane = 0.0
        n = 0
        sums[:] = 0.0
        head, tail, refit = 0, 1, 12
        stack[0, 0], stack[0, 1] = sj, si
        label[sj, si] = regions
        while head < tail:
            j, i = stack[head, 0], stack[head, 1]
            head += 1
            x, y, z = points[j, i, 0] - bx, points[j, i, 1] - by, points[j, i, 2] - bz
            member[n, 0], member[n, 1] = j, i
            n += 1
            add_point(sums, x, y, z)
            if n >= refit:
                refit = int(n * 1.5)
                a, b, c, offset, _ = plane_of(sums)
                if a * nx + b * ny + c * nz < 0:
                    a, b, c, offset = -a, -b, -c, -offset
                if a * nx + b * ny + c * nz > 0.9:
                    nx, ny, nz, plane = a, b, c, offset
            for way in range(4):
                v = j + (1 if way == 0 else -1 if way == 1 else 0)
                u = i + (1 if way == 2 else -1 if way == 3 else 0)
                if v < 0 or v >= height or u < 0 or u >= width or not mask[v, u] or label[v, u] != -1:
                    continue
                x, y, z = points[v, u, 0] - bx, points[v, u, 1] - by, points[v, u, 2] - bz
                if abs(nx * x + ny * y + nz * z - plane) > tolerance[v, u]:
                    continue
                if normal[v, u, 0] * nx + normal[v, u, 1] * ny + normal[v, u, 2] * nz < cosine:
                    continue
                if separation(points, j, i, v, u) > 4 * jump[v, u] * jump[v, u]:
                    continue
                label[v, u] = regions
                stack[tail, 0], stack[tail, 1] = v, u
                tail += 1
        if n < smallest:
            for k in range(n):
                label[member[k, 0], member[k, 1]] = -2 if k == 0 else -1
        else:
            regions += 1
    for j in range(height):
        for i in range(width):
            label[j, i] = max(label[j, i], -1)
    return label, regions


@njit(cache=True, nogil=True)
def reassign(points, mask, label, normal, offset, tolerance, jump, rounds):
    """Let pixels at borders change to, and free ones join, the neighbouring region of the nearest plane, in place."""
    height, width = mask.shape
    for _ in range(rounds):
        changed = 0
        for j in range(height):
            for i in range(width):
                if not mask[j, i]:
                    continue
                own = label[j, i]
                best, choice = tolerance[j, i], -1
                if own >= 0:
                    choice = own
                    best = 0.8 * abs(normal[own, 0] * points[j, i, 0] + normal[own, 1] * points[j, i, 1]
                                     + normal[own, 2] * points[j, i, 2] - offset[own])  # fmt: skip
                for way in range(4):
                    v = j + (1 if way == 0 else -1 if way == 1 else 0)
                    u = i + (1 if way == 2 else -1 if way == 3 else 0)
                    if v < 0 or v >= height or u < 0 or u >= width:
                        continue
                    k = label[v, u]
                    if k < 0 or k == own:
                        continue
                    if separation(points, j, i, v, u) > 4 * jump[v, u] * jump[v, u]:
                        continue
                    r = abs(normal[k, 0] * points[j, i, 0] + normal[k, 1] * points[j, i, 1]
                            + normal[k, 2] * points[j, i, 2] - offset[k])  # fmt: skip
                    if r < best:
                        best, choice = r, k
                if choice != own and choice >= 0:
                    label[j, i] = choice
                    changed += 1
        if changed == 0:
            break


class Patches(NamedTuple):
    """Planar pieces of the surface above the floor."""

    label: np.ndarray  # (H, W) int32, patch of each pixel or -1
    normal: np.ndarray  # (P, 3) float64 unit, towards the camera
    offset: np.ndarray  # (P,) float64: normal . point.
    pixels: np.ndarray  # (P,) int64, how many
    centre: np.ndarray  # (P, 3) float64
    residual: np.ndarray  # (P,) float64, root mean square distance to the plane in metres
    touching: np.ndarray  # (P, P) int64, pairs of neighbouring pixels without a jump in depth between two patches


@njit(cache=True, nogil=True)
def fit_regions(points, label, regions, origin):
    """Return normal (P, 3) towards the origin, offset (P,), count, centre, residual of all regions."""
    sums = np.zeros((regions, 10))
    for j in range(label.shape[0]):
        for i in range(label.shape[1]):
            if label[j, i] >= 0:
                add_point(sums[label[j, i]], points[j, i, 0], points[j, i, 1], points[j, i, 2])
    normal, centre = np.zeros((2, regions, 3))
    offset, residual = np.zeros((2, regions))
    for k in range(regions):
        if sums[k, 0] == 0.0:
            continue
        centre[k] = sums[k, 1:4] / sums[k, 0]
        a, b, c, beyond, value = plane_of(sums[k])
        side = 1.0 if a * origin[0] + b * origin[1] + c * origin[2] > beyond else -1.0
        normal[k, 0], normal[k, 1], normal[k, 2] = side * a, side * b, side * c
        offset[k], residual[k] = side * beyond, np.sqrt(value)
    return normal, offset, sums[:, 0].astype(np.int64), centre, residual


def touching_pixels(points: np.ndarray, label: np.ndarray, regions: int, jump: np.ndarray) -> np.ndarray:
    """Return (P, P) int64: pairs of pixels of two regions, one or two apart, without a jump in depth."""
    touching = np.zeros((regions, regions), np.int64)
    for axis, step in product(range(2), (1, 2)):
        here, there = ((slice(None),) * axis + (part,) for part in (slice(-step), slice(step, None)))
        a, b = label[here], label[there]
        apart = np.square(points[there] - points[here]).sum(axis=-1)
        met = (a >= 0) & (b >= 0) & (a != b) & (apart < ((1.0 + step) * jump[here]) ** 2)
        np.add.at(touching, (a[met], b[met]), 1)
    return touching + touching.T


SMALLEST = 8  # pixels that a patch must have, and half of them when its pixels were assigned anew


def find_patches(
    points: np.ndarray, mask: np.ndarray, origin: np.ndarray, sigma: np.ndarray, footprint: np.ndarray
) -> Patches:
    """Segment the surface into planar patches.

    points : (H, W, 3) float64, floor frame (any finite numbers where mask is False).
    mask : (H, W) bool, pixels to segment; sigma : (H, W) noise in metres; footprint : (H, W) size of a pixel in metres.
    """
    jump = np.ascontiguousarray(2.5 * footprint + 3 * sigma)
    tolerance = np.ascontiguousarray(3.0 * sigma)
    normal, offset, error = local_planes(points, mask, origin, jump, 2)
    normal, quality = sharpen(points, mask, normal, offset, error, 2, tolerance)
    order = np.argsort(quality.ravel(), kind="stable")
    order = order[quality.ravel()[order] < 1e8].astype(np.int64)
    label, regions = grow(points, mask, normal, quality, order, tolerance, jump, np.cos(np.radians(22)), SMALLEST)
    for _ in range(2):
        plane_normal, plane_offset, count, centre, residual = fit_regions(points, label, regions, origin)
        reassign(points, mask, label, plane_normal, plane_offset, tolerance, jump, 4)
    # reassignment can leave a region with next to nothing: number the others anew
    alive = np.bincount(label[label >= 0], minlength=regions) >= SMALLEST // 2
    number = np.append(np.where(alive, np.cumsum(alive) - 1, -1), -1).astype(np.int32)
    label, regions = np.ascontiguousarray(number[label]), int(alive.sum())
    plane_normal, plane_offset, count, centre, residual = fit_regions(points, label, regions, origin)
    return Patches(label, plane_normal, plane_offset, count, centre, residual,
                   touching_pixels(points, label, regions, jump))  # fmt: skip


@njit(cache=True, nogil=True)
def straightest(depth, mask):
    """Return (H, W) the square of the metres by which each pixel of a mask (H, W) lies off its two neighbours along a
    row, a column or a diagonal, where that is least; inf where none has both in the mask, 0 outside it.

    Along a plane inverse depth is affine, and along an edge any surface is nearly straight. Independent noise leaves
    1.5 variances along one line.
    """
    height, width = mask.shape
    found = np.zeros((height, width))
    for j in range(height):
        for i in range(width):
            if not mask[j, i]:
                continue
            found[j, i] = np.inf
            for way in range(4):
                down, across = (0, 1, 1, 1)[way], (1, 0, 1, -1)[way]
                if min(j - down, i - abs(across)) < 0 or j + down >= height or i + abs(across) >= width:
                    continue
                if not (mask[j - down, i - across] and mask[j + down, i + across]):
                    continue
                between = 2.0 / (1.0 / depth[j - down, i - across] + 1.0 / depth[j + down, i + across])
                found[j, i] = min(found[j, i], (depth[j, i] - between) ** 2)
    return found
