"""From the free numbers of a scene graph to placed solids and their motions, compiled: Eq. 1 and its derivative.

Eq. 7-9: a contact's parameter moves the vertex and all that descends from it by one rigid motion. The motions are found
by central differences of Eq. 1 itself (numbers of order one in float64: exact to 1e-9), so that every contact type,
slack, and the way sizes enter through (u, v) need no derivative of their own. The image's derivative is exact and never
differenced.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from derender.compilation.cache import njit
from derender.errors import DerenderError
from derender.posterior.compiled.layout import NEXT, SHAPES, SIZES, SOLID
from derender.posterior.compiled.model import NotCompiled, contact_parameters, numbers_of, vertices_of
from derender.posterior.compiled.poses import place as place_vertex
from derender.registry import suggest
from derender.render.raycast.records import MOTION
from derender.scene.graph import SceneGraph
from derender.scene.shapes import shapes


class Domain(NamedTuple):
    """Where parameters may be. lower, upper : (P,) float64; period : (P,) float64, 0 = none (then they are ignored)."""

    lower: np.ndarray
    upper: np.ndarray
    period: np.ndarray

    def bring(self, values: np.ndarray) -> np.ndarray:
        """Return the nearest values inside."""
        around = self.period > 0.0
        period = np.where(around, self.period, 1.0)
        turned = values - period * np.floor(values / period)
        return np.where(around, turned, np.clip(values, self.lower, self.upper))


STEP = 1e-6  # of the differences: metres, radians, or shares
SMALLEST = 1e-3  # metres: no extent is moved below this


class Placement(NamedTuple):
    """A graph as arrays, and where its free numbers go. N vertices, P free numbers.

    Attributes
    ----------
    vertices, extents : as in Model; numbers, pose, relative : as in Chain (`compiled/layout.py`).
    vertex, slot : (P,) int64, row and column of `numbers` that a free number goes to.
    """

    vertices: np.ndarray
    extents: np.ndarray
    numbers: np.ndarray
    pose: np.ndarray
    relative: np.ndarray
    vertex: np.ndarray
    slot: np.ndarray


def new_placement(graph: SceneGraph, addresses: Sequence[str]) -> tuple[Placement, np.ndarray, Domain]:
    """Return the graph's arrays, the present values of the free numbers, and their domain.

    addresses : such as "red.contact.theta", "red.side".

    Raises DerenderError for an address that is not there or a contact or shape that has no compiled form.
    """
    try:
        vertices, extents = vertices_of(graph)
    except NotCompiled as what:
        raise DerenderError(f"{what} has no compiled form", remedy="use --method mcmc") from None
    names, count = graph.names, len(graph.vertices)
    numbers, pose = np.tile(numbers_of(graph), (2, 1, 1)), np.tile(np.eye(4), (2, count + 1, 1, 1))
    pose[:, count] = graph.root_pose
    vertex_of, slot = np.zeros((2, len(addresses)), np.int64)
    lower, upper, period = np.zeros((3, len(addresses)))
    for p, address in enumerate(addresses):
        name, _, rest = address.partition(".")
        if name not in names:
            raise DerenderError(f"no number is called {address!r}", remedy=suggest(name, names))
        n = vertex_of[p] = names.index(name)
        vertex, of_contact = graph.vertices[n], rest.startswith("contact.")
        known = contact_parameters(graph, vertex) if of_contact else shapes[vertex.shape].parameters
        wanted = rest.removeprefix("contact.")
        found = [k for k, parameter in enumerate(known) if parameter.name == wanted]
        if not found:
            raise DerenderError(f"no number is called {address!r}", remedy=suggest(wanted, [q.name for q in known]))
        parameter = known[found[0]]
        slot[p] = found[0] + (0 if of_contact else SHAPES)
        lower[p], upper[p], period[p] = parameter.lower, parameter.upper, parameter.period or 0.0
        if not of_contact:
            lower[p] = max(lower[p], SMALLEST / max(extents[n, found[0] + 1].max(), 1e-9))
    placement = Placement(vertices, extents, numbers, pose, np.eye(4), vertex_of, slot)
    return placement, numbers[NEXT, vertex_of, slot], Domain(lower, upper, period)


@njit(cache=True, nogil=True)
def place(placement, values, poses, sizes):
    """Write the poses (S, 4, 4) and sizes (S, 3) of the solids at these values (P,) of the free numbers."""
    vertices, numbers, pose = placement.vertices, placement.numbers, placement.pose
    for p in range(values.shape[0]):
        numbers[NEXT, placement.vertex[p], placement.slot[p]] = values[p]
    for n in range(placement.extents.shape[0]):
        place_vertex(vertices, placement.extents, numbers, pose, placement.relative, n)
        s = vertices[SOLID, n]
        if s >= 0:
            poses[s] = pose[NEXT, n]
            sizes[s] = numbers[NEXT, n, SIZES:SHAPES]


@njit(cache=True, nogil=True)
def find_motions(placement, values, motions):
    """Write the motion (P, S, MOTION) of every solid per unit of every free number."""
    solids = motions.shape[1]
    trial = values.copy()
    poses, after, before = np.empty((solids, 4, 4)), np.empty((solids, 4, 4)), np.empty((solids, 4, 4))
    sizes, larger, smaller = np.empty((solids, 3)), np.empty((solids, 3)), np.empty((solids, 3))
    place(placement, values, poses, sizes)
    scale = 0.5 / STEP
    for p in range(values.shape[0]):
        trial[p] = values[p] + STEP
        place(placement, trial, after, larger)
        trial[p] = values[p] - STEP
        place(placement, trial, before, smaller)
        trial[p] = values[p]
        for k in range(solids):
            motion = motions[p, k]
            turn = np.zeros((3, 3))
            moved = False
            for i in range(3):
                for j in range(4):
                    if after[k, i, j] != before[k, i, j]:
                        moved = True
                motion[6 + i] = (larger[k, i] - smaller[k, i]) * scale
            motion[:6] = 0.0
            if not moved:
                continue
            for i in range(3):
                for j in range(3):
                    for c in range(3):
                        turn[i, j] += (after[k, i, c] - before[k, i, c]) * scale * poses[k, j, c]
            motion[3] = 0.5 * (turn[2, 1] - turn[1, 2])
            motion[4] = 0.5 * (turn[0, 2] - turn[2, 0])
            motion[5] = 0.5 * (turn[1, 0] - turn[0, 1])
            x, y, z = poses[k, 0, 3], poses[k, 1, 3], poses[k, 2, 3]
            motion[0] = (after[k, 0, 3] - before[k, 0, 3]) * scale - (motion[4] * z - motion[5] * y)
            motion[1] = (after[k, 1, 3] - before[k, 1, 3]) * scale - (motion[5] * x - motion[3] * z)
            motion[2] = (after[k, 2, 3] - before[k, 2, 3]) * scale - (motion[3] * y - motion[4] * x)
            for c in range(MOTION):
                if abs(motion[c]) < 1e-8:
                    motion[c] = 0.0
