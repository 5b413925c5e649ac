"""Steps in which a depth image is informative, in the coordinates of a chart (chart.py)."""

import numpy as np

from derender.structures.draws.chart import FLOOR_WAYS, SIZE, TURN, VERTICAL

PIVOTS = np.array([(0, 0, 0), (1, 1, 0), (1, -1, 0), (-1, 1, 0), (-1, -1, 0)])  # half sides from the centre


def directions(chart, count, solids=None):
    """Return (M, D) steps in which a depth image is informative, for a vector of `count` coordinates, in metres.

    Those of some solids only, or of all (None).

    Each face moved while the opposite one stays, shifts, turns about the centre and about the four corners of the
    ground plan, edges of a cube scaled about a corner.
    """
    found = []
    for k in range(len(chart.flags)) if solids is None else solids:
        slot, flag, base = chart.slots[k], chart.flags[k], chart.base[k]
        rotation = base[1:10].reshape(3, 3)

        def shifted(vector, move, slot=slot):
            for i in range(3):
                if slot[i] >= 0:
                    vector[slot[i]] += move[i]
            return vector

        for axis in range(3):
            if slot[axis] >= 0:
                found.append(shifted(np.zeros(count), np.eye(3)[axis]))
            found.append(shifted(np.zeros(count), rotation[:, axis]))
        sizes = sorted({int(s) for s in slot[SIZE:]})
        for index in sizes:
            axes = [i for i in range(3) if slot[SIZE + i] == index]
            for signs in np.ndindex(*([2] * len(axes))):
                vector = np.zeros(count)
                vector[index] = 1.0
                for axis, sign in zip(axes, signs, strict=True):
                    shifted(vector, (sign - 0.5) * rotation[:, axis])
                found.append(vector)
        for axis in range(3):
            index = slot[TURN + axis]
            if index < 0:
                continue
            about = np.array([0.0, 0.0, 1.0]) if flag[VERTICAL] else rotation[:, axis]
            radius = 0.5 * float(np.linalg.norm(base[13:16]))
            corners = (0.5 * base[13:16] * PIVOTS) @ rotation.T
            for move in np.cross(about, -corners) / radius:
                vector = np.zeros(count)
                vector[index] = 1.0 / radius
                found.append(shifted(vector, move))
    for axis in range(FLOOR_WAYS):
        vector = np.zeros(count)
        vector[count - FLOOR_WAYS + axis] = 0.1
        found.append(vector)
    kept = [v for v in found if np.abs(v).max() > 1e-9]
    return np.array(kept)
