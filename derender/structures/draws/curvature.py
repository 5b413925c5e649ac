"""How firmly an image and the prior hold a structure's coordinates: the precision of a normal about a mode.

An image J of derivatives by a coordinate is the difference of two renders half a pixel apart on either side. Inside a
silhouette residuals are those of Gauss-Newton: J J' / sigma^2. At a depth step s of a point-sampled image they are not:
the likelihood does not change until an edge crosses a pixel's centre, then at once. Such a pixel tells where an edge is
to some tenth of a pixel, however great the step: its noise is taken as sqrt(sigma^2 + s^2 / SHARP).

This is for steps to be made from: what a walk meets corrects it, and nothing that is drawn depends on it.
"""

import numpy as np

from derender.detection.solids.image import ROW
from derender.detection.solids.interpenetration import gap_between, lowest
from derender.detection.solids.state import FLOOR
from derender.render.blur import blur, blur_radius
from derender.render.raycast.engine import propose_state, settle_state
from derender.render.raycast.state import CANDIDATE, CURRENT, DEPTH, PAD
from derender.render.raycast.views import engine_of_view
from derender.structures.draws.chart import (
    FLOOR_WAYS,
    HELD,
    PARENT,
    SIZE,
    TURN,
    camera_poses,
    place_rows,
)
from derender.structures.draws.steps import touched_by_each

SHARP = 100.0  # a pixel at an edge tells where that is to a tenth of a pixel
APART = 0.5  # pixels from the mode to either side
FLOOR_APART = 5e-4  # metres and radians
LOOSE, LOOSE_TURN = 0.01, 0.2  # metres and radians: of what the image does not hold
HAIR = 1e-5  # metres and radians, of differences of the prior's distances


class Curvature:
    """What small moves do to the images.

    Parameters
    ----------
    views : Views at `values`; they are there again after each call. chart : Chart. sensor : Sensor.
    values : (D,) coordinates of a mode.
    """

    def __init__(self, views, chart, sensor, values) -> None:
        self.chart, self.values = chart, values
        self.images = [ImageCurvature(engine_of_view(views, number), chart, view, values)
                       for number, view in enumerate(sensor.views)]  # fmt: skip

    def precision(self, members):
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

    def __init__(self, engine, chart, sensor, values) -> None:
        self.engine, self.chart, self.values, self.into = engine, chart, values, sensor.into
        self.blur = sensor.values["blur"]
        self.reach = blur_radius(self.blur)
        self.pixels = slice(PAD, PAD + sensor.observed.shape[1])
        self.base = engine.images[DEPTH + CURRENT][: len(sensor.observed), self.pixels].copy()
        self.weight = np.sqrt(weights(sensor, blur(self.base.astype(float), self.blur))).astype(np.float32)
        count = len(chart.flags)
        self.rows = np.empty((count, ROW))
        self.poses, self.sizes = np.empty((count + 1, 4, 4)), np.empty((count + 1, 3))
        # half a pixel at the depth of each coordinate's solid
        self.apart = np.full(len(values), FLOOR_APART)
        floor = sensor.into @ chart.floor
        for slot, row in zip(chart.slots, chart.base, strict=True):
            depth = floor[2, :3] @ row[10:13] + floor[2, 3]
            self.apart[slot[slot >= 0]] = APART * max(depth, 0.1) / sensor.camera.fx

    def moved(self, touched, values):
        """Return (H, W) the clean depth at other coordinates of which only the solids `touched` know."""
        indices = np.flatnonzero(touched)
        place_rows(self.chart, values, self.rows)
        camera_poses(self.chart, values, self.rows, self.poses, self.sizes)
        poses = self.into @ self.poses[indices]
        propose_state(self.engine, np.int64(len(indices)), indices, poses, self.sizes[indices])
        seen = self.engine.images[DEPTH + CANDIDATE][: len(self.base), self.pixels].copy()
        settle_state(self.engine, CURRENT)
        return seen

    def derivatives(self, members):
        """Return (n, H W) float32, the image's derivatives by the coordinates `members` in deviations of the noise."""
        size, turns = len(self.values), self.chart.slots[:, TURN:SIZE]
        images = np.zeros((len(members), *self.base.shape), np.float32)
        units = np.eye(size)[:, members]
        for image, member, touched in zip(images, members, touched_by_each(self.chart, units), strict=True):
            apart = self.apart[member]
            if member in turns:
                apart /= 0.5 * np.linalg.norm(self.chart.base[np.argwhere(turns == member)[0, 0], 13:15])
            shift = apart * np.eye(size)[member]
            change = self.moved(touched, self.values + shift) - self.moved(touched, self.values - shift)
            if change.any():  # only there, and as far as the blur carries it, the derivative is not 0
                where = tuple(
                    slice(max(along[0] - self.reach, 0), along[-1] + self.reach + 1)
                    for along in (np.flatnonzero(change.any(axis=axis)) for axis in (1, 0))
                )
                image[where] = blur(change[where], self.blur) * (self.weight[where] / np.float32(2.0 * apart))
        return images.reshape(len(members), -1)


def weights(sensor, base):
    """Return (H, W) the precision of each pixel's residual, given the model's depth (H, W); 0 where none returned."""
    padded = np.pad(base, 1, mode="edge")
    height, width = base.shape
    step = np.zeros_like(base)
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):  # what a slope does on both sides is no step
        one = padded[1 + down : 1 + down + height, 1 + right : 1 + right + width] - base
        other = padded[1 - down : 1 - down + height, 1 - right : 1 - right + width] - base
        np.maximum(step, np.abs(np.abs(one) - np.abs(other)), out=step)
    noise = sensor.values["sigma"] + sensor.values.get("sigma_growth", 0.0) * base**2
    return np.where(sensor.observed > 0.0, sensor.worth / (noise**2 + step**2 / SHARP), 0.0)


def contact_precision(chart, values, members):
    """Return the (n, n) precision that comes from solids which are not held but stand on something all the same."""
    total = np.zeros((len(members), len(members)))
    if chart.floating or chart.flags[:, HELD].all():
        return total
    rows = np.empty((len(chart.flags), ROW))

    def gap_at(k, parent, values):
        place_rows(chart, values, rows)
        return lowest(rows[k]) if parent == FLOOR else gap_between(rows[k], rows[parent])

    for k in np.flatnonzero(chart.flags[:, HELD] == 0):
        parent = int(chart.flags[k, PARENT])
        slope = np.zeros(len(members))
        for n, member in enumerate(members):
            for way in (1.0, -1.0):
                trial = values.copy()
                trial[member] += way * HAIR
                slope[n] += way * gap_at(k, parent, trial) / (2.0 * HAIR)
        total += np.outer(slope, slope) / chart.slack**2
    return total
