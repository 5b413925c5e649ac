"""From draws of coordinates (chart.py) to a graph's numbers by address, compiled."""

import numpy as np
from numba import njit

from derender.inference.structure.chart import camera_poses, place_rows
from derender.inference.structure.image import ROW
from derender.inference.structure.state import FLOOR
from derender.model.contacts import contacts
from derender.model.contacts.compiled import FEATURE_CODES, SLOTS, invert
from derender.model.scene import ROOT
from derender.model.shapes import shapes
from derender.model.solids import PLANE

# How much of a full extent each shape's numbers are, and of which axis.
EXTENTS = {"cube": ((0, 1.0),), "box": ((0, 1.0), (1, 1.0), (2, 1.0)), "sphere": ((0, 0.5),),
           "cylinder": ((0, 0.5), (2, 1.0))}  # fmt: skip
NO_PARENT = -2  # hangs on the root: 6dof in the floor's axes


@njit(cache=True, nogil=True)
def contact_numbers(chart, draws, parents, codes, phi, sizes, root):
    """Write what each draw (D,) of (n, D) means as contacts.

    Parameters
    ----------
    parents : (N,) int64: index of a solid, FLOOR (-1) or NO_PARENT. codes : (N, 3) int64: contact, parent's face,
        child's face.
    phi : (n, N, SLOTS), sizes : (n, N, 3), root : (n, 4, 4) float64, written: numbers, extents, floor to camera.
    """
    count = len(chart.flags)
    rows, poses, extents = np.empty((count, ROW)), np.empty((count + 1, 4, 4)), np.empty((count + 1, 3))
    here, above, relative = np.eye(4), np.eye(4), np.eye(4)
    for n in range(len(draws)):
        place_rows(chart, draws[n], rows)
        camera_poses(chart, draws[n], rows, poses, extents)
        root[n] = poses[0]
        for k in range(count):
            for i in range(3):
                sizes[n, k, i] = rows[k, 13 + i]
                here[i, 3] = rows[k, 10 + i]
                for j in range(3):
                    here[i, j] = rows[k, 1 + 3 * i + j]
            parent = parents[k]
            relative[:] = here
            kind, size = PLANE, np.zeros(3)
            if parent >= 0:
                kind, size = int(rows[parent, 0]), rows[parent, 13:16].copy()
                for i in range(3):
                    above[i, 3] = rows[parent, 10 + i]
                    for j in range(3):
                        above[i, j] = rows[parent, 1 + 3 * i + j]
                for i in range(3):
                    for j in range(4):
                        relative[i, j] = 0.0
                        for m in range(3):
                            relative[i, j] += above[m, i] * (here[m, j] - (above[m, 3] if j == 3 else 0.0))
            invert(codes[k, 0], kind, size, int(rows[k, 0]), rows[k, 13:16].copy(), codes[k, 1], codes[k, 2],
                   relative, phi[n, k])  # fmt: skip


def numbers_of_draws(chart, draws, graph, names):
    """Return (addresses, values (n, P), periods (P,), root poses (n, 4, 4)) of draws (n, D) of the graph's structure.

    names : of the solids in the chart's order. Numbers that the graph's contacts leave out (slack) are left out.
    """
    count, total = len(names), len(draws)
    parents, codes = np.empty(count, np.int64), np.empty((count, 3), np.int64)
    for k, name in enumerate(names):
        vertex = graph.vertex(name)
        contact = vertex.contact
        above = NO_PARENT if vertex.parent == ROOT else FLOOR
        parents[k] = names.index(vertex.parent) if vertex.parent in names else above
        codes[k] = (contacts[contact.type].compiled_code, FEATURE_CODES[contact.parent_face],
                    FEATURE_CODES[contact.child_face])  # fmt: skip
    phi, sizes, root = np.zeros((total, count, SLOTS)), np.empty((total, count, 3)), np.empty((total, 4, 4))
    contact_numbers(chart, np.ascontiguousarray(draws), parents, codes, phi, sizes, root)
    found: dict[str, np.ndarray] = {}
    periods: dict[str, float | None] = {}
    for k, name in enumerate(names):
        vertex = graph.vertex(name)
        contact = vertex.contact
        for parameter, (axis, share) in zip(shapes[vertex.shape].parameters, EXTENTS[vertex.shape], strict=True):
            found[f"{name}.{parameter.name}"] = share * sizes[:, k, axis]
        on = graph.body(vertex.parent).shape
        slots = contacts[contact.type].parameters(on, shapes[vertex.shape], contact.parent_face, contact.child_face)
        for slot, parameter in enumerate(slots):
            if parameter.name in contact.values:
                address = f"{name}.contact.{parameter.name}"
                found[address] = phi[:, k, slot]
                periods[address] = 2.0 * np.pi if parameter.name == "theta" else None
    addresses = tuple(a for a in graph.numbers() if a in found)
    values = np.stack([found[a] for a in addresses], axis=1) if addresses else np.empty((total, 0))
    return addresses, values, tuple(periods.get(a) for a in addresses), root


__all__ = ["contact_numbers", "numbers_of_draws"]
