"""How firmly an image and the prior hold a structure's coordinates: the precision of a normal about a mode.

An image J of derivatives is the difference of two renders half a pixel apart on either side. Inside a silhouette
residuals are Gauss-Newton's: J J' / sigma^2. At a depth step s of a point-sampled image the likelihood changes only
when an edge crosses a pixel's centre, which tells where the edge is to some tenth of a pixel: its noise is taken as
sqrt(sigma^2 + s^2 / SHARP). This is for steps to be made from: what a walk meets corrects it.
"""

import math
from typing import Any

import numpy as np

from derender.compilation.cache import call_for_nothing, njit
from derender.detection.solids.image import ROW
from derender.detection.solids.interpenetration import gap_between, lowest
from derender.detection.solids.state import FLOOR
from derender.render.blur import blur
from derender.render.raycast.engine import Views, engine_of_view, propose_in, settle_in
from derender.render.raycast.lane_names import LANES
from derender.render.raycast.region import DRAWN, SCORED
from derender.render.raycast.state import BLUR, CANDIDATE, CURRENT, DEPTH, HEIGHT, PAD, REGIONS, WIDTH, EngineState
from derender.scene.pose import compose
from derender.structures.draws.chart import (
    FLOOR_WAYS,
    HELD,
    PARENT,
    SIZE,
    TURN,
    Chart,
    camera_poses,
    place_rows,
    rows_at,
)
from derender.structures.draws.sensor import Sensor
from derender.structures.draws.steps import touched_by_each

SHARP = 100.0  # a pixel at an edge tells where that is to a tenth of a pixel
APART = 0.5  # pixels from the mode to either side
FLOOR_APART = 5e-4  # metres and radians
LOOSE, LOOSE_TURN = 0.01, 0.2  # metres and radians: of what the image does not hold
HAIR = 1e-5  # metres and radians, of differences of the prior's distances


class Curvature:
    """What small moves do to the images.
    views : Views at `values` (D,), the coordinates of a mode; they are there again after each call.
    """

    def __init__(self, views: Views, chart: Chart, sensor: Sensor, values: np.ndarray) -> None:
        self.chart, self.values = chart, values
        self.images = [ImageCurvature(engine_of_view(views, number), chart, view, values)
                       for number, view in enumerate(sensor.views)]  # fmt: skip

    def precision(self, members: list[int]) -> np.ndarray:
        """Return the (n, n) precision of the coordinates `members`, those others held."""
        total = np.zeros((len(members), len(members)))
        for image in self.images:
            derivatives = image.derivatives(members)
            total += (derivatives @ derivatives.T).astype(float)
        size, turns = len(self.values), self.chart.slots[:, TURN:SIZE]
        loose = np.full(size, LOOSE)
        loose[turns[turns >= 0]] = loose[size - FLOOR_WAYS :] = LOOSE_TURN
        return total + np.diag(loose[members] ** -2.0) + contact_precision(self.chart, self.values, members)


class ImageCurvature:
    """What small moves do to one image. engine : EngineState of its view; sensor : Sensor of it alone."""

    def __init__(self, engine: EngineState, chart: Chart, sensor: Sensor, values: np.ndarray) -> None:
        self.engine, self.chart, self.values, self.into = engine, chart, values, sensor.into
        height, width = sensor.observed.shape
        pixels = slice(PAD, PAD + width)
        self.weight = np.zeros(engine.images.shape[1:], np.float32)
        base = engine.images[DEPTH + CURRENT][:height, pixels].astype(float)
        self.weight[:height, pixels] = np.sqrt(weights(sensor, blur(base, sensor.values["blur"])))
        # half a pixel at the depth of each coordinate's solid
        self.apart = np.full(len(values), FLOOR_APART)
        floor = sensor.into @ chart.floor
        for slot, row in zip(chart.slots, chart.base, strict=True):
            depth = floor[2, :3] @ row[10:13] + floor[2, 3]
            far = APART * max(depth, 0.1) / sensor.camera.fx
            self.apart[slot[slot >= 0]] = far
            turns = slot[TURN:SIZE]
            self.apart[turns[turns >= 0]] = far / (0.5 * np.linalg.norm(row[13:15]))

    def derivatives(self, members: Any) -> np.ndarray:
        """Return (n, K) float32, the image's derivatives by the coordinates `members` in deviations of the noise, of
        all pixels at which one is not 0."""
        members = np.asarray(members, np.int64)
        touched = touched_by_each(self.chart, np.eye(len(self.values))[:, members])
        images = np.zeros((len(members), *self.weight.shape), np.float32)
        top, bottom = write_derivatives(self.engine, self.chart, self.values, np.ascontiguousarray(self.into), members,
                                        self.apart[members], touched, self.weight, images)  # fmt: skip
        return images[:, top:bottom].reshape(len(members), -1)


@njit(cache=True, nogil=True)
def write_derivatives(engine, chart, values, into, members, apart, touched, weight, images):
    """Write the blurred image's derivatives by some coordinates: differences of two renders on either side.

    engine : EngineState at `values` (D,), as it is again afterwards. into : (4, 4), see Sensor.
    members : (n,) int64, the coordinates. apart : (n,), how far to either side. touched : (n, 1 + N) bool, which solids
        move.
    weight : (H, P) float32 of each pixel. images : (n, H, P) float32 of zeros, padded as the engine's; written.

    Returns the first row in which one is not 0, and the row after the last.
    """
    settings, count = engine.settings, len(chart.flags)
    height, width = settings[HEIGHT], settings[WIDTH]
    current, candidate = engine.images[DEPTH + CURRENT], engine.images[DEPTH + CANDIDATE]
    change, trial = np.zeros(weight.shape, np.float32), values.copy()
    rows, poses, sizes = np.empty((count, ROW)), np.empty((count + 1, 4, 4)), np.empty((count + 1, 3))
    seen, indices = np.zeros((count + 1, 4, 4)), np.empty(count + 1, np.int64)
    first, last = height, np.int64(0)
    for n in range(len(members)):
        left, right, top, bottom = width, np.int64(0), height, np.int64(0)
        for way in (np.float32(1.0), np.float32(-1.0)):
            trial[members[n]] = values[members[n]] + way * apart[n]
            place_rows(chart, trial, rows)
            camera_poses(chart, trial, rows, poses, sizes)
            moved = np.int64(0)
            for k in range(count + 1):
                if touched[n, k]:
                    indices[moved] = k
                    compose(into, poses[k], seen[moved])
                    for i in range(3):
                        sizes[moved, i] = sizes[k, i]
                    moved += 1
            propose_in(engine, moved, indices, seen, sizes)
            for number in range(settings[REGIONS]):
                drawn, scored = engine.regions[DRAWN, number], engine.regions[SCORED, number]
                begin = 0 if drawn[0] == 0 else drawn[0] + PAD  # with the replicated edges
                end = (drawn[1] if drawn[1] < width else width + LANES) + PAD
                for row in range(drawn[2], drawn[3]):
                    for column in range(begin, end):
                        change[row, column] += way * (candidate[row, column] - current[row, column])
                left, right = min(left, scored[0]), max(right, scored[1])
                top, bottom = min(top, scored[2]), max(bottom, scored[3])
            settle_in(engine, CURRENT)
        trial[members[n]] = values[members[n]]
        if left >= right:
            continue
        limit_at_border(change, weight, height, width)
        right = left + (right - left + LANES - 1) // LANES * LANES
        call_for_nothing(settings[BLUR], change, images[n], engine.taps, left + PAD, right + PAD, top,
                         bottom, height)  # fmt: skip
        for row in range(top, bottom):
            for column in range(left + PAD, right + PAD):
                images[n, row, column] *= weight[row, column] / np.float32(2.0 * apart[n])
            for column in range(change.shape[1]):
                change[row, column] = 0.0
        first, last = min(first, top), max(last, bottom)
    return min(first, last), last


@njit(cache=True, nogil=True, borrows=True)
def limit_at_border(change, weight, height, width):
    """Limit a change of the image (H, P) where the picture ends, in place, to what an edge tells anywhere: one that a
    move brings in shows in no neighbour, so that `weights` take no account of its step."""
    last = PAD + width - 1
    for row in range(height):
        inner, column = 0 < row < height - 1, 0
        while column < change.shape[1]:
            known = weight[row, min(max(column, PAD), last)]
            most = np.float32(math.sqrt(SHARP)) / known if known > 0.0 else np.float32(0.0)
            change[row, column] = min(max(change[row, column], -most), most)
            column = last if inner and column == PAD else column + 1


def weights(sensor: Sensor, base: np.ndarray) -> np.ndarray:
    """Return (H, W) the precision of each pixel's residual, given the model's depth (H, W); 0 where none returned."""
    growth = sensor.values.get("sigma_growth", 0.0)
    return precision_of_pixels(sensor.observed, base, sensor.values["sigma"], growth, sensor.worth)


@njit(cache=True, nogil=True)
def precision_of_pixels(observed, base, sigma, growth, worth):
    """As `weights`; noise is sigma + growth depth^2, of which each pixel tells the share `worth`."""
    height, width = base.shape
    found = np.zeros((height, width))
    for j in range(height):
        for i in range(width):
            if not observed[j, i] > 0.0:
                continue
            step, here = 0.0, base[j, i]
            for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):  # what a slope does on both sides is no step
                one = base[min(j + down, height - 1), min(max(i + right, 0), width - 1)]
                other = base[max(j - down, 0), min(max(i - right, 0), width - 1)]
                step = max(step, abs(abs(one - here) - abs(other - here)))
            found[j, i] = worth / ((sigma + growth * here**2) ** 2 + step**2 / SHARP)
    return found


def contact_precision(chart: Chart, values: np.ndarray, members: list[int]) -> np.ndarray:
    """Return the (n, n) precision that comes from solids which are not held but stand on something all the same."""
    total = np.zeros((len(members), len(members)))
    if chart.floating or chart.flags[:, HELD].all():
        return total

    for k in np.flatnonzero(chart.flags[:, HELD] == 0):
        parent = int(chart.flags[k, PARENT])
        slope = np.zeros(len(members))
        for n, member in enumerate(members):
            for way in (1.0, -1.0):
                trial = values.copy()
                trial[member] += way * HAIR
                rows = rows_at(chart, trial)
                gap = lowest(rows[k]) if parent == FLOOR else gap_between(rows[k], rows[parent])
                slope[n] += way * gap / (2.0 * HAIR)
        total += np.outer(slope, slope) / chart.slack**2
    return total
