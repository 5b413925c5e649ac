"""The pose that one frame gives to something that moves as a whole: Levenberg-Marquardt on the image, compiled.

What moves is a set of solids and a frame that goes with them: one thing and its pose, or all that rests, and with it
the camera. Its coordinates are a shift of the frame's origin, a turn about it (both in camera axes) and, of one thing,
the growth of its extents along `ties` (a cube's three are one number). The energy is the misfit of the antialiased
image, divided by the number of pixels that tell as much as one independent one, and a normal prior on these coordinates
about where the frame is expected.
"""

import math

import numpy as np

from derender.compilation.cache import njit
from derender.render.raycast.canvas import FACE_BITS, NOTHING
from derender.render.raycast.normal_equations import LIMIT, MOTION, compare_rows, cost, normal_equations
from derender.sampling.descent import damped_step, solve_positive

RIGID = 6  # coordinates of a rigid motion
SMALLEST = 0.003  # metres: no extent becomes less
LONGEST, WIDEST = 0.05, 0.5  # metres and radians of one step: the image is linear over less
RAISED, LOWERED = 8.0, 0.2  # what a failed and a good step do to the damping
MOST_DAMPING = 1e5
# The mean of f (1 - f) over f in [0, 1] is one sixth, but pixels along one straight edge are off alike, all of them
# where it runs along a row: a dozen count as two.
EDGE = 1.0
BEYOND = 3  # pixels: a step takes the two beside it, and blur or a slanted outline one more
HIDES = 3.0  # standard deviations: what reaches in is nearer than what it hides by more than noise
FAR_OFF = 3.5  # standard deviations: of normal noise one pixel in two thousand


@njit(cache=True, nogil=True)
def look(misfit, observed, spread):
    """Compare another image (H, W), 0 where nothing returned, with what is drawn; spread : (H, W) standard deviations,
    infinite where a pixel does not count."""
    height, width = misfit.observed.shape
    for row in range(height):
        for column in range(width):
            depth = observed[row, column]
            misfit.observed[row, column] = depth
            sigma = spread[row, column]
            misfit.precision[row, column] = 1.0 / (sigma * sigma) if depth > 0.0 else 0.0
    compare_rows(misfit, 0, height)


@njit(cache=True, nogil=True)
def _beside(observed, row, column, down, right):
    """Return by how much the nearest return in a direction is off a pixel's depth, and how many steps away it is; 0 for
    none."""
    for far in range(1, BEYOND + 1):
        i, j = row + far * down, column + far * right
        if not (0 <= i < observed.shape[0] and 0 <= j < observed.shape[1]):
            break
        if observed[i, j] > 0.0:
            return abs(observed[i, j] - observed[row, column]), far
    return 0.0, 0


@njit(cache=True, nogil=True)
def spread_of(observed, floor, growth, least, spread):
    """Write the standard deviation (H, W) of each pixel of an observed image (H, W), metres, 0 where nothing returned.

    Beside the sensor's noise, floor + growth z^2, a pixel at a depth step s shows one side of it or the other, where
    the model shows their mean by area: it is off by some share of s, with variance s^2 / EDGE. Sensors lose pixels at
    steps: the other side is that of the nearest return within BEYOND pixels.
    """
    height, width = observed.shape
    for row in range(height):
        for column in range(width):
            depth = observed[row, column]
            sigma = max(floor + growth * depth * depth, least)
            step = 0.0
            if depth > 0.0:
                amid = 0 < row < height - 1 and 0 < column < width - 1
                for way in range(4):
                    down, right = (1 if way != 0 else 0), (1 if way == 0 else way - 2)
                    if amid:  # nearly everywhere both neighbours are returns
                        after, before = observed[row + down, column + right], observed[row - down, column - right]
                        if after > 0.0 and before > 0.0:
                            step = max(step, abs(abs(after - depth) - abs(before - depth)))
                            continue
                    first, near = _beside(observed, row, column, down, right)
                    second, far = _beside(observed, row, column, -down, -right)
                    if near > 0 and far > 0:  # what a slope does on both sides is no step
                        step = max(step, abs(first / near - second / far) * max(near, far))
            step = max(step - 3.0 * sigma, 0.0)
            spread[row, column] = math.sqrt(sigma * sigma + step * step / EDGE)


@njit(cache=True, nogil=True)
def energy_at(misfit, poses, sizes, frame, expected, grown, usual, ties, information, temper, offset):
    """Return the energy of a placement, and write how far it is from what was expected into offset (P,)."""
    for i in range(3):
        offset[i] = frame[i, 3] - expected[i, 3]
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        total = 0.0
        for c in range(3):
            total += 0.5 * (frame[j, c] * expected[i, c] - frame[i, c] * expected[j, c])
        offset[3 + axis] = total
    for g in range(ties.shape[0]):
        total = weight = 0.0
        for i in range(3):
            total += ties[g, i] * (sizes[grown, i] - usual[i])
            weight += ties[g, i]
        offset[RIGID + g] = total / weight
    prior = 0.0
    for p in range(offset.shape[0]):
        for q in range(offset.shape[0]):
            prior += 0.5 * offset[p] * information[p, q] * offset[q]
    return cost(misfit, poses, sizes) / temper + prior


@njit(cache=True, nogil=True)
def move_by(poses, sizes, members, frame, grown, ties, step):
    """Move the members and their frame by a step (P,), in place."""
    angle = math.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
    turn = np.eye(3)
    if angle > 1e-12:
        x, y, z = step[3] / angle, step[4] / angle, step[5] / angle
        c, s = math.cos(angle), math.sin(angle)
        turn[0, 0], turn[0, 1], turn[0, 2] = c + x * x * (1 - c), x * y * (1 - c) - z * s, x * z * (1 - c) + y * s
        turn[1, 0], turn[1, 1], turn[1, 2] = y * x * (1 - c) + z * s, c + y * y * (1 - c), y * z * (1 - c) - x * s
        turn[2, 0], turn[2, 1], turn[2, 2] = z * x * (1 - c) - y * s, z * y * (1 - c) + x * s, c + z * z * (1 - c)
    pivot = frame[:3, 3].copy()
    moved = np.empty((3, 4))
    for k in range(-1, members.shape[0]):
        if k >= 0 and not members[k]:
            continue
        pose = frame if k < 0 else poses[k]
        for i in range(3):
            for j in range(4):
                total = 0.0
                for c in range(3):
                    total += turn[i, c] * (pose[c, j] - (pivot[c] if j == 3 else 0.0))
                moved[i, j] = total + (pivot[i] + step[i] if j == 3 else 0.0)
        for i in range(3):
            for j in range(4):
                pose[i, j] = moved[i, j]
    for g in range(ties.shape[0]):
        for i in range(3):
            sizes[grown, i] = max(sizes[grown, i] + ties[g, i] * step[RIGID + g], SMALLEST)


@njit(cache=True, nogil=True)
def motions_of(members, frame, grown, ties, motions):
    """Write the motion (P, N, MOTION) of each solid per unit of each coordinate."""
    motions[:] = 0.0
    x, y, z = frame[0, 3], frame[1, 3], frame[2, 3]
    for k in range(members.shape[0]):
        if not members[k]:
            continue
        for i in range(3):
            motions[i, k, i] = 1.0
            motions[3 + i, k, 3 + i] = 1.0
        motions[3, k, 1], motions[3, k, 2] = z, -y  # minus the turn's axis times the pivot
        motions[4, k, 0], motions[4, k, 2] = -z, x
        motions[5, k, 0], motions[5, k, 1] = y, -x
    for g in range(ties.shape[0]):
        for i in range(3):
            motions[RIGID + g, grown, 6 + i] = ties[g, i]


@njit(cache=True, nogil=True)
def fit(misfit, poses, sizes, members, frame, expected, grown, usual, ties, information, temper, rounds, tolerance,
        curvature):  # fmt: skip
    """Move what moves to where the energy is least, in place; return (energy, steps taken).

    misfit : Misfit. poses : (N, 4, 4), sizes : (N, 3) of all solids, written.
    members : (N,) bool, what moves. frame : (4, 4), goes with it, written. expected : (4, 4), the prior's mean of it.
    grown : index of the thing that may grow; usual : (3,) the prior's mean of its extents; ties : (G, 3).
    information : (6 + G, 6 + G), precision of the prior. temper : pixels worth one independent one.
    rounds : most sets of normal equations. tolerance : nats; a smaller gain ends it.
    curvature : (6 + G, 6 + G), written: precision of the coordinates given the image and the prior.
    """
    count, solids = information.shape[0], poses.shape[0]
    motions = np.empty((count, solids, MOTION))
    gradient, hessian = np.zeros(count), np.zeros((count, count))
    offset, step, held = np.zeros(count), np.zeros(count), np.zeros(count, np.bool_)
    limits = np.array([LONGEST, WIDEST])
    kept_poses, kept_sizes, kept_frame = poses.copy(), sizes.copy(), frame.copy()
    value = energy_at(misfit, poses, sizes, frame, expected, grown, usual, ties, information, temper, offset)
    damping, taken, gained = 1e-4, 0, 0.0
    for _ in range(rounds):
        motions_of(members, frame, grown, ties, motions)
        normal_equations(misfit, poses, sizes, motions, True, gradient, hessian)
        for p in range(count):
            gradient[p] /= temper
            for q in range(count):
                curvature[p, q] = hessian[p, q] / temper + information[p, q]
                gradient[p] += information[p, q] * offset[q]
        taken += 1
        gained = -1.0
        kept_poses[:], kept_sizes[:], kept_frame[:] = poses, sizes, frame
        while damping < MOST_DAMPING:
            foreseen = damped_step(curvature, gradient, damping, held, limits, step)
            if math.isnan(foreseen):
                damping = max(damping * RAISED, 1e-3)
                continue
            if foreseen < tolerance:
                break
            move_by(poses, sizes, members, frame, grown, ties, step)
            trial = energy_at(misfit, poses, sizes, frame, expected, grown, usual, ties, information, temper, offset)
            if trial < value:
                gained, value = value - trial, trial
                damping = max(damping * LOWERED, 1e-6)
                break
            poses[:], sizes[:], frame[:] = kept_poses, kept_sizes, kept_frame
            damping = max(damping * RAISED, 1e-3)
        if gained < tolerance:
            break
    if gained < 0.0:  # the misfit must know where things are now
        value = energy_at(misfit, poses, sizes, frame, expected, grown, usual, ties, information, temper, offset)
    return value, taken


@njit(cache=True, nogil=True)
def hides(off, floor, usual):
    """Whether a pixel that is `off` standard deviations from what is drawn shows what reaches in before that.

    floor : the pixel's exp(-limit). usual : that of a pixel where nothing reaches in.
    """
    return off < -HIDES and floor > usual


@njit(cache=True, nogil=True)
def pixels_of(misfit, counts, limit):
    """Write of each solid (N, 4): pixels that show it, those of them with a return, those off by more than `limit`
    standard deviations nearer to the camera, and those farther from it. Pixels that show what reaches in before it are
    none of these."""
    counts[:] = 0.0
    code = misfit.canvas.code
    height, width = code.shape
    usual = math.exp(-misfit.numbers[LIMIT])
    for row in range(height):
        for column in range(width):
            here = code[row, column]
            if here == NOTHING:
                continue
            k = here >> FACE_BITS
            precision = misfit.precision[row, column]
            off = (misfit.observed[row, column] - misfit.blurred[row, column]) * math.sqrt(precision)
            if hides(off, misfit.floor[row, column], usual):
                continue
            counts[k, 0] += 1.0
            if precision > 0.0:
                counts[k, 1] += 1.0
                if off < -limit:
                    counts[k, 2] += 1.0
                elif off > limit:
                    counts[k, 3] += 1.0


@njit(cache=True, nogil=True)
def cost_about(misfit, k, margin):
    """Return (cost, pixels with a return, those of them that are off) of solid k's rectangle and `margin` pixels about
    it."""
    height, width = misfit.observed.shape
    rectangle = misfit.canvas.rectangle[k]
    total, count, off, usual = 0.0, 0.0, 0.0, math.exp(-misfit.numbers[LIMIT])
    for row in range(max(rectangle[2] - margin, 0), min(rectangle[3] + margin, height)):
        for column in range(max(rectangle[0] - margin, 0), min(rectangle[1] + margin, width)):
            precision = misfit.precision[row, column]
            if precision > 0.0:
                r = misfit.blurred[row, column] - misfit.observed[row, column]
                floor = misfit.floor[row, column] if r > 0.0 else usual
                if hides(-r * math.sqrt(precision), floor, usual):
                    continue
                total -= math.log((math.exp(-min(0.5 * precision * r * r, 700.0)) + floor) / (1.0 + floor))
                count += 1.0
                if precision * r * r > FAR_OFF * FAR_OFF:
                    off += 1.0
    return total, count, off


@njit(cache=True, nogil=True)
def score_of(misfit, poses, sizes, members, frame, temper, hessian):
    """Return the gain in nats that a best rigid motion of the members would bring, to second order.

    `cost` must have been called last for this placement. hessian : (6, 6), written.
    """
    motions, gradient = np.empty((RIGID, poses.shape[0], MOTION)), np.zeros(RIGID)
    step, held, none = np.zeros(RIGID), np.zeros(RIGID, np.bool_), np.zeros((0, 3))
    motions_of(members, frame, 0, none, motions)
    normal_equations(misfit, poses, sizes, motions, True, gradient, hessian)
    for p in range(RIGID):
        gradient[p] /= temper
        for q in range(RIGID):
            hessian[p, q] /= temper
        hessian[p, p] += 1.0  # a metre, a radian: for what the image does not tell
    if not solve_positive(hessian, gradient, held, step):
        return 0.0
    gain = 0.0
    for p in range(RIGID):
        gain -= 0.5 * step[p] * gradient[p]
    return gain
