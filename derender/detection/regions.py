"""Regions of pixels that lie on one plane: grown from the best pixels on, then mended at their borders."""

import numpy as np

from derender.compilation.cache import njit
from derender.detection.local_planes import add_point, plane_of, separation


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
