"""How far real solids are from ideal ones, in draws: each face lies where the image shows it only to some millimetres.

Many pixels tell where a face appears to be, far better than a real face is even, or a real sensor free of bias. So the
place of a face is the apparent one, which the walk draws, less an offset of its own, normal with the discrepancy as
its standard deviation; nothing else tells the offsets, so that a draw of both is a draw of one and a draw of the other.
The floor under the solids, which nobody sees, is off in the same way from where it appears to be beside them.
"""

import numpy as np

from derender.detection.solids.graph import order_of
from derender.detection.solids.image import rotation_of
from derender.detection.solids.polish import FREE
from derender.detection.solids.state import FLOOR
from derender.scene.solids import BOX, SPHERE

LEAST_SIZE = 0.004  # metres


def with_offsets(rng, rows, state, discrepancy):
    """Return rows (N, ROW) of a draw with offsets drawn for each face; what is held to its support stays on it.

    Parameters
    ----------
    rows : (N, ROW) as the walk left them. state : State of their structure. discrepancy : metres.
    """
    rows = rows.copy()
    lifts = np.zeros(len(rows))  # of the tops
    floor = discrepancy * rng.standard_normal()  # how much lower it is under them all than it appears beside them
    for k in order_of(list(state.parents)):
        row, kind, parent = rows[k], int(rows[k][0]), state.parents[k]
        held = not np.isnan(state.bottoms[k])
        offsets = discrepancy * rng.standard_normal((3, 2))  # of the faces at + and -, outwards
        whole = kind == SPHERE or state.cubes[k]  # all extents are one number
        if whole:
            offsets[:] = offsets[0].sum() / 2.0
        elif kind != BOX:
            offsets[1] = offsets[0]
        up, down = (0, 1) if rotation_of(row)[2, 2] > 0 else (1, 0)
        if held and (kind == SPHERE or state.forms[k] != FREE):
            offsets[2, up] += offsets[2, down] if whole else 0.0
            offsets[2, down] = 0.0
            if parent == FLOOR and not whole:
                offsets[2, up] += floor
        row[13:16] = np.maximum(row[13:16] + offsets.sum(axis=1), LEAST_SIZE)
        row[10:13] += rotation_of(row) @ (0.5 * (offsets[:, 0] - offsets[:, 1]))
        carried = lifts[parent] if held and parent >= 0 else 0.0
        row[12] += carried
        lifts[k] = carried + offsets[2, up]
    return rows
