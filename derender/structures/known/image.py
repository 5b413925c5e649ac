"""How well an object of known shape explains the image, drawn by its triangles; its pose refined: compiled.

As in image.py and polish.py of solids/, in the floor frame. An object is the row of what stands for it, a proxy, whose
rotation and centre are its own.
"""

import numpy as np

from derender.compilation.cache import njit
from derender.detection.solids.image import pixels_within
from derender.detection.solids.misfit import LIMIT, WALL, change_within
from derender.detection.solids.polish import resting_energy
from derender.render.raycast.depth import fill_triangle
from derender.sampling.metropolis import compiled_adapted_scale, compiled_log_threshold

STEPS = 6  # kinds of steps: along three axes, about three axes
SHORTEST, LONGEST = 5e-5, 0.03  # metres between which a step's standard deviation is adapted
ACCEPTANCE, GAIN = 0.25, 0.3  # wanted share of accepted steps; change of a log scale for one that is wrong by 1


@njit(cache=True, nogil=True)
def project(image, vertices, row, points):
    """Fill points (V, 4) with pixel column, row, inverse depth, height over the floor; return (i0, i1, j0, j1).

    The rectangle is empty where a vertex lies behind the camera.
    """
    p = image.projection
    left, right, top, bottom = 1e30, -1e30, 1e30, -1e30
    height, width = image.depth.shape
    for k in range(vertices.shape[0]):
        a, b, c = vertices[k, 0], vertices[k, 1], vertices[k, 2]
        x = row[1] * a + row[2] * b + row[3] * c + row[10]
        y = row[4] * a + row[5] * b + row[6] * c + row[11]
        z = row[7] * a + row[8] * b + row[9] * c + row[12]
        w = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
        points[k, 3] = z
        if w < 1e-3:
            return 0, 0, 0, 0
        u = (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / w
        v = (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / w
        points[k, 0], points[k, 1], points[k, 2] = u, v, 1.0 / w
        left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
    return pixels_within(left, right, top, bottom, height, width)


@njit(cache=True, nogil=True)
def rasterise(triangles, points, i0, i1, j0, j1, buffer):
    """Fill the rectangle of buffer (H, W) with the inverse depth of projected triangles, 0 where there is none.

    Triangles are wound counter-clockwise seen from outside; those that face away are left out.
    """
    for j in range(j0, j1):
        for i in range(i0, i1):
            buffer[j, i] = 0.0
    for k in range(triangles.shape[0]):
        a, b, c = triangles[k, 0], triangles[k, 1], triangles[k, 2]
        if (points[b, 0] - points[a, 0]) * (points[c, 1] - points[a, 1]) > (
            (points[c, 0] - points[a, 0]) * (points[b, 1] - points[a, 1])
        ):
            continue  # it faces away
        fill_triangle(buffer, points[a, 0], points[a, 1], points[a, 2], points[b, 0], points[b, 1], points[b, 2],
              points[c, 0], points[c, 1], points[c, 2], i0, i1, j0, j1)  # fmt: skip


@njit(cache=True, nogil=True)
def draw_known(image, vertices, triangles, row, index, depth, label):
    """Draw one object into depth and label (H, W), in place."""
    points = np.empty((vertices.shape[0], 4))
    buffer = np.empty(depth.shape)
    i0, i1, j0, j1 = project(image, vertices, row, points)
    rasterise(triangles, points, i0, i1, j0, j1, buffer)
    for j in range(j0, j1):
        for i in range(i0, i1):
            if buffer[j, i] > 0.0 and 1.0 / buffer[j, i] < depth[j, i]:
                depth[j, i] = 1.0 / buffer[j, i]
                label[j, i] = index


@njit(cache=True, nogil=True)
def known_misfit(image, vertices, triangles, row, depth, misfit, points, buffer):
    """Return (change of the misfit when the object is added to a scene, height of its lowest vertex).

    points (>= V, 4) and buffer (H, W) are scratch.
    """
    height, width = image.depth.shape
    i0, i1, j0, j1 = project(image, vertices, row, points)
    low = 1e30
    for k in range(vertices.shape[0]):
        low = min(low, points[k, 3])
    if i0 >= i1 or j0 >= j1:
        return 0.0, low
    rasterise(triangles, points, i0, i1, j0, j1, buffer)
    if image.taps.size == 1:
        total = 0.0
        for j in range(j0, j1):
            for i in range(i0, i1):
                weight = image.weight[j, i]
                if weight > 0.0 and buffer[j, i] * depth[j, i] > 1.0:
                    r = image.depth[j, i] - 1.0 / buffer[j, i]
                    total += min(r * r * weight, LIMIT) - misfit[j, i]
        return total, low
    radius = image.taps.size - 1
    left, right = max(i0 - 2 * radius, 0), min(i1 + 2 * radius, width)
    top, bottom = max(j0 - 2 * radius, 0), min(j1 + 2 * radius, height)
    window = np.empty((bottom - top, right - left))
    for j in range(top, bottom):
        for i in range(left, right):
            z = depth[j, i]
            if i0 <= i < i1 and j0 <= j < j1 and buffer[j, i] > 0.0:
                z = min(z, 1.0 / buffer[j, i])
            window[j - top, i - left] = min(z, WALL)
    return change_within(image, window, left, top, i0, i1, j0, j1, misfit), low


@njit(cache=True, nogil=True)
def rotate_about(row, axis, angle):
    """Turn an object about an axis of the floor frame through its centre, in place."""
    c, s = np.cos(angle), np.sin(angle)
    a, b = 1 + 3 * ((axis + 1) % 3), 1 + 3 * ((axis + 2) % 3)
    for column in range(3):
        x, y = row[a + column], row[b + column]
        row[a + column], row[b + column] = c * x - s * y, s * x + c * y


@njit(cache=True, nogil=True)
def walk_known(rng, image, vertices, triangles, start, others, skip, depth, misfit, base, slack, tilt, scale, rounds,
               heat):  # fmt: skip
    """Return (row, energy) of the best that one object meets on an annealed walk from `start` (ROW,), the rest of the
    scene held still.

    Steps: along the floor's x, y, z; turns about the vertical and about the floor's x and y through the centre.

    others : (N, ROW), what it must not enter, of which `skip` is left out. depth, misfit : (H, W) of the scene without
        it. base : height that its lowest point is held to, NaN for none.
    tilt : standard deviation of the radians by which it leans from the way it was said to lie.
    scale : (6,) metres, standard deviation of each step (turns: times 8 rad/m), changed in place. heat : temperature at
        the start, falling to 0.
    """
    row, trial, best, least = start.copy(), start.copy(), start.copy(), np.inf
    energy = np.inf
    down = 7 + np.argmax(np.abs(row[7:10]))
    points, buffer = np.empty((vertices.shape[0], 4)), np.empty(image.depth.shape)
    for k in range(-1, rounds):  # the first time it is where it begins
        move, step = 0, 0.0
        if k >= 0:
            move = int(STEPS * rng.random())
            step = scale[move] * rng.standard_normal()
        trial[:] = row
        if move < 3:
            trial[10 + move] += step
        else:
            rotate_about(trial, 2 if move == 3 else move - 4, 8.0 * step)
        change, low = known_misfit(image, vertices, triangles, trial, depth, misfit, points, buffer)
        lean = np.arccos(min(abs(trial[down]), 1.0))
        new = change + (resting_energy(trial, low, others, skip, base, slack) + 0.5 * (lean / tilt) ** 2)
        temperature = heat * (1.0 - k / rounds)
        accepted = k < 0 or compiled_log_threshold(rng) * temperature < energy - new
        if accepted:
            row[:] = trial
            energy = new
            if energy < least:
                best[:] = row
                least = energy
        if k >= 0:
            adapted = compiled_adapted_scale(scale[move], 1.0 if accepted else 0.0, ACCEPTANCE, GAIN)
            scale[move] = min(max(adapted, SHORTEST), LONGEST)
    return best, least
