"""Where the faces of real solids are, given where a real sensor shows them: each is off by some millimetres.

A face is where it appears less an offset, normal with the standard deviation `faces` of the prior's file: neither is a
real face as even as many pixels tell where it is, nor a sensor free of a slow bias. Nothing else tells the offsets, so
a draw of where the faces are is a draw of where they appear, by the walk, and one of the offsets; the floor under the
solids has one too. Only of a cube do its faces say something of each other's: see `chart.apparent_cube_log_density`.
The height of what stands on something is off by the standard deviation `resting`.

A face that looks away from the camera is told by the silhouette alone, which sensors' lost returns leave open.
"""

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from derender.detection.solids.image import CENTRE
from derender.detection.solids.image import SIZE as EXTENT
from derender.detection.solids.state import FLOOR
from derender.scene.solids import BOX, CYLINDER, SPHERE
from derender.structures.draws.chart import (
    EQUAL,
    HELD,
    KIND,
    LEAST_EXTENT,
    PARENT,
    SIZE,
    VERTICAL,
    Chart,
    X,
    Z,
    rows_at,
)

if TYPE_CHECKING:
    from derender.structures.draws.refined import Refined

RIM = np.linspace(-1.0, 1.0, 65)  # places along an edge, in halves of it, that are looked for in the image
BORDER = 2.0  # pixels along the image's border that do not tell: a prior that would have it nearer puts a face there


def at_median_unseen(refined: "Refined", best: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """Return the coordinates (D,) of the best scene (D,), hidden faces of upright boxes as far as the median of draws
    (n, D) has them, if farther, those that are seen staying where they are."""
    chart, found = refined.chart, best.copy()
    rows = rows_at(chart, best)
    boxes = (chart.flags[:, KIND] == BOX) & (chart.flags[:, EQUAL] == 0) & (chart.flags[:, VERTICAL] == 1)
    for k in np.flatnonzero(boxes):
        slot, turn = chart.slots[k], rows[k, 1:10].reshape(3, 3)
        for axis in range(3):
            out = [not rim_shows(refined, rows[k], axis, sign) for sign in (1.0, -1.0)]
            grown = float(np.median(drawn[:, slot[SIZE + axis]]) - best[slot[SIZE + axis]])
            if grown <= 0.0 or not any(out) or (axis == 2 and not chart.flags[k, HELD]):
                continue
            found[slot[SIZE + axis]] += grown
            if axis < 2:  # what is held to its support has no height of its own
                found[slot[X : X + 2]] += 0.5 * grown * (out[0] - float(out[1])) * turn[:2, axis]
    return found


def rim_shows(refined: "Refined", row: np.ndarray, axis: int, sign: float) -> bool:
    """Return whether edges of a box's face that the box itself does not hide lie within an image, in part at least."""
    turn, half = row[1:10].reshape(3, 3), 0.5 * row[EXTENT:]
    for view in refined.sensor.views:
        into, camera = view.into @ refined.chart.floor, view.camera
        eye = turn.T @ (-into[:3, :3].T @ into[:3, 3] - row[CENTRE:EXTENT])  # along the box's axes
        rim = []
        for other, end in product({0, 1, 2} - {axis}, (-1.0, 1.0)):
            if sign * eye[axis] > half[axis] or end * eye[other] > half[other]:  # one of the two faces is seen
                edge = np.tile([sign * half[axis]] * 3, (len(RIM), 1))
                edge[:, other] = end * half[other]
                edge[:, 3 - axis - other] = RIM * half[3 - axis - other]
                rim.append(edge)
        if not rim:
            continue
        x, y, z = into[:3, :3] @ (row[CENTRE:EXTENT] + np.concatenate(rim) @ turn.T).T + into[:3, 3:]
        with np.errstate(divide="ignore", invalid="ignore"):
            columns, rows = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        within = (z > 0.0) & (np.abs(columns - 0.5 * (camera.width - 1)) < 0.5 * camera.width - BORDER)
        if np.any(within & (np.abs(rows - 0.5 * (camera.height - 1)) < 0.5 * camera.height - BORDER)):
            return True
    return False


def true_faces(rng: np.random.Generator | None, chart: Chart, values: np.ndarray) -> np.ndarray:
    """Return coordinates (n, D) with the faces where they are, of some (n, D) with the faces where they appear.
    What is held to its support stays on it. rng : of the offsets; None: the most probable ones."""
    if rng is None and chart.faces == 0.0:
        return values
    values, many = values.copy(), len(values)

    def offsets(deviation, *shape):
        """Return (n, *shape) offsets with this standard deviation."""
        zero = rng is None or deviation == 0.0
        return np.zeros((many, *shape)) if zero else deviation * rng.standard_normal((many, *shape))

    floor, lifted = offsets(chart.faces), np.zeros((len(chart.flags), many))  # of the floor, and of each top over it
    for k in chart.order:
        slot, flag, base = chart.slots[k], chart.flags[k], chart.base[k]
        pairs = offsets(chart.faces, 3, 2)  # of the faces at + and -, outwards
        resting = offsets(chart.resting) if flag[HELD] else np.zeros(many)
        grown, moved = pairs.sum(axis=2), 0.5 * (pairs[..., 0] - pairs[..., 1])
        extents = values[:, slot[SIZE:]]
        if flag[KIND] == CYLINDER:
            grown[:, 1] = grown[:, 0]
        below = lifted[flag[PARENT]] if flag[PARENT] != FLOOR else np.zeros(many)
        if flag[EQUAL] or flag[KIND] == SPHERE:  # of a cube three pairs of faces tell the side
            grown = (grown[:, :1] if flag[KIND] == SPHERE else grown.sum(axis=1, keepdims=True) / 3.0) + np.zeros(3)
            extents = extents.mean(axis=1, keepdims=True) + grown + resting[:, None]
            lifted[k] = below + extents[:, 2] - values[:, slot[SIZE + 2]]
        else:
            if flag[HELD]:  # its top is where it appears, all but an offset, over a floor that has one
                lifted[k] = pairs[:, 2, 0] + floor + resting
                grown[:, 2] = lifted[k] - below
            extents = extents + grown
        values[:, slot[SIZE:]] = np.maximum(extents, LEAST_EXTENT)
        if flag[KIND] != SPHERE:
            moved = moved @ base[1:10].reshape(3, 3).T
            for axis in range(X, Z + 1):
                if slot[axis] >= 0:
                    values[:, slot[axis]] += moved[:, axis]
    return values
