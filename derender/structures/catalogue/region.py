"""Where scenes of a catalogue may lie: centres in view, and each turn under one of its names.

The prior spreads solids over the whole endless floor, and where nobody looks they would wander off. A turn by a quarter
gives a box with other names for its edges; the prior counts each box once, so turns stay within an eighth of a base.
"""

import numpy as np

from derender.detection.solids.image import ROW
from derender.scene.solids import BOX
from derender.structures.draws.chart import KIND, SIZE, TURN, VERTICAL, Chart, camera_poses, place_rows

BESIDE = 0.25  # of the image's width and height by which a centre may lie beside it
BEHIND = 1.5  # times the deepest pixel
EIGHTH = 0.25 * np.pi


def folded(chart: Chart, values: np.ndarray) -> np.ndarray:
    """Return the coordinates (D,) of the same scene with the turns of standing boxes within an eighth of their bases.

    A quarter turn changes the names of the two level edges; cubes have one for all. It is a symmetry of the density.
    """
    values = values.copy()
    for flags, slots, base in zip(chart.flags, chart.slots, chart.base, strict=True):
        turn = slots[TURN + 2]
        if flags[KIND] != BOX or not flags[VERTICAL] or turn < 0:
            continue
        quarters = int(np.rint(values[turn] / (2.0 * EIGHTH)))
        values[turn] -= quarters * 2.0 * EIGHTH
        if quarters % 2:
            upright = int(np.argmax(np.abs(base[7:10])))
            one, other = (slots[SIZE + axis] for axis in range(3) if axis != upright)
            values[one], values[other] = values[other], values[one]
    return values


class Region:
    """Which coordinates count as scenes, for the camera and the depths of a Sensor."""

    def __init__(self, sensor) -> None:
        self.camera = sensor.camera
        self.deepest = BEHIND * float(np.nanmax(sensor.observed))

    def holds(self, chart: Chart, values: np.ndarray) -> bool:
        """Return whether coordinates (D,) are inside."""
        turns = chart.slots[:, TURN:SIZE]
        if (np.abs(values[turns[turns >= 0]]) > EIGHTH).any():
            return False
        count, camera = len(chart.flags), self.camera
        rows, poses, sizes = np.empty((count, ROW)), np.empty((count + 1, 4, 4)), np.empty((count + 1, 3))
        place_rows(chart, values, rows)
        camera_poses(chart, values, rows, poses, sizes)
        x, y, z = poses[1:, :3, 3].T
        if not ((z > 0.0) & (z < self.deepest)).all():
            return False
        column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        aside = np.abs(column - 0.5 * camera.width) < (0.5 + BESIDE) * camera.width
        return bool((aside & (np.abs(row - 0.5 * camera.height) < (0.5 + BESIDE) * camera.height)).all())
