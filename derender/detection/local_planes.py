"""Planes through the neighbours of each pixel; each pixel takes the best window that holds it."""

import numpy as np

from derender.compilation.cache import njit


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
