"""Where the faces of real solids are, given where a real sensor shows them: each is off by some millimetres.

Many pixels tell where a face appears to be, far better than a real face is even, or a real sensor free of a slow bias.
So a face is where it appears less an offset, normal with the standard deviation `faces` of the prior's file. Nothing
else tells the offsets, so a draw of where the faces are is a draw of where they appear, by the walk, and one of the
offsets. The floor under the solids, which nobody sees, is off in the same way from where it appears beside them. Only
of a cube do its faces say something of each other's offsets: see `chart.apparent_cube_log_density`.
"""

import numpy as np

from derender.detection.solids.state import FLOOR
from derender.scene.solids import CYLINDER, SPHERE
from derender.structures.draws.chart import EQUAL, HELD, KIND, LEAST_EXTENT, PARENT, SIZE, X, Z


def true_faces(rng, chart, values):
    """Return coordinates (n, D) with the faces where they are, of some (n, D) with the faces where they appear.

    What is held to its support stays on it. rng : of the offsets; None: the most probable ones.
    """
    if chart.faces == 0.0:
        return values
    values, many = values.copy(), len(values)

    def offsets(*shape):
        """Return (n, *shape) offsets of faces."""
        return np.zeros((many, *shape)) if rng is None else chart.faces * rng.standard_normal((many, *shape))

    floor, lifted = offsets(), np.zeros((len(chart.flags), many))  # of the floor, and of each top over it
    for k in chart.order:
        slot, flag, base = chart.slots[k], chart.flags[k], chart.base[k]
        pairs = offsets(3, 2)  # of the faces at + and -, outwards
        grown, moved = pairs.sum(axis=2), 0.5 * (pairs[..., 0] - pairs[..., 1])
        extents = values[:, slot[SIZE:]]
        if flag[KIND] == CYLINDER:
            grown[:, 1] = grown[:, 0]
        below = lifted[flag[PARENT]] if flag[PARENT] != FLOOR else np.zeros(many)
        if flag[EQUAL] or flag[KIND] == SPHERE:  # of a cube three pairs of faces tell the side
            grown = (grown[:, :1] if flag[KIND] == SPHERE else grown.sum(axis=1, keepdims=True) / 3.0) + np.zeros(3)
            extents = extents.mean(axis=1, keepdims=True) + grown
            lifted[k] = below + extents[:, 2] - values[:, slot[SIZE + 2]]
        else:
            if flag[HELD]:  # its top is where it appears, all but an offset, over a floor that has one
                lifted[k] = pairs[:, 2, 0] + floor
                grown[:, 2] = lifted[k] - below
            extents = extents + grown
        values[:, slot[SIZE:]] = np.maximum(extents, LEAST_EXTENT)
        if flag[KIND] != SPHERE:
            moved = moved @ base[1:10].reshape(3, 3).T
            for axis in range(X, Z + 1):
                if slot[axis] >= 0:
                    values[:, slot[axis]] += moved[:, axis]
    return values
