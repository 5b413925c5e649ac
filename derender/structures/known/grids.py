"""Several known boxes of one size that look like one: cartons on a pallet, flush or a few millimetres apart.

The search for solids of unknown sizes takes them for one large box. Where its sides are whole multiples of a known
box's, in one of the ways in which that may lie, the box may be a grid of these.
"""

from itertools import permutations

import numpy as np

from derender.detection.solids.image import make_row, rotation_of
from derender.scene.solids import BOX

GAP = 0.006  # metres between neighbours, at most
INEXACT = 0.01  # metres by which a large box's sides may be wrong
LEVEL = 0.99  # cosine of the large box's tilt
MOST = 64  # of cells


def cells_of(row, known):
    """Return the rows (N, ROW) of the boxes of one known size that a box may consist of, lowest first; (0, ROW): none.

    Of ways to lie that fit, the one whose gaps are narrowest. row : (ROW,) of the large box, floor frame.
    """
    none = np.empty((0, len(row)))
    rotation = rotation_of(row)
    if int(row[0]) != BOX or known.body.shape.solid_kind != BOX or abs(rotation[2, 2]) < LEVEL:
        return none
    fitting = []
    for axes in permutations(range(3)):  # along the large box's axes
        piece = known.size[list(axes)]
        count = np.maximum(np.rint((row[13:16] + INEXACT) / (piece + 0.5 * GAP)), 1.0)
        spare = row[13:16] - count * piece
        if np.all(spare > -INEXACT) and np.all(spare < (count - 1.0) * GAP + INEXACT) and 1 < count.prod() <= MOST:
            fitting.append((float(np.abs(spare).sum()), axes, count.astype(int)))
    if not fitting:
        return none
    _, axes, count = min(fitting, key=lambda each: each[0])
    turn = rotation[:, np.argsort(axes)]  # columns: the known box's own axes
    turn[:, 2] *= np.sign(np.linalg.det(turn))
    piece = known.size[list(axes)]
    gap = np.maximum(row[13:16] - count * piece, 0.0) / np.maximum(count - 1, 1)
    cells = []
    for place in sorted(np.ndindex(*count), key=lambda each: each[2] * rotation[2, 2]):
        offset = (np.array(place) - 0.5 * (count - 1)) * (piece + gap)
        cells.append(make_row(BOX, turn, row[10:13] + rotation @ offset, known.size))
    return np.array(cells)
