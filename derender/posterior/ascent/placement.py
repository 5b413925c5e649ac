"""From the free numbers of a scene graph to placed solids and their motions, compiled: Eq. 1 and its derivative.

Eq. 7-9: a contact's parameter moves the vertex and all that descends from it by one rigid motion. The motions are found
by central differences of Eq. 1 itself (numbers of order one in float64: exact to 1e-9), so that every contact type,
slack,
and the way sizes enter through (u, v) need no derivative of their own. The image's derivative is exact and never
differenced.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from derender.compilation.cache import njit
from derender.errors import DerenderError
from derender.posterior.ascent.domain import Domain
from derender.registry import suggest
from derender.render.raycast.records import MOTION
from derender.scene.contacts import contacts
from derender.scene.contacts.compiled import FEATURE_CODES, FRAME, SLOTS, compose, relative_pose
from derender.scene.graph import SceneGraph
from derender.scene.shapes import shapes

STEP = 1e-6  # of the differences: metres, radians, or shares
SMALLEST = 1e-3  # metres: no extent is moved below this


class Placement(NamedTuple):
    """A graph as arrays, and where its free numbers go. N vertices, P free numbers, S solids.

    Attributes
    ----------
    root : (4, 4) float64. parent : (N,) int64, -1 for the root. kind : (N,) int64, of solids or FRAME.
    contact, parent_face, child_face : (N,) int64 codes of contacts.compiled. phi : (N, SLOTS), size : (N, 3) float64.
    solid : (N,) int64, index among the solids or -1.
    vertex : (P,) int64. slot : (P,) int64, of phi, or -1 for a number of the shape. growth : (P, 3) float64, extents
        per
        unit of it; base : (P,) its value in `size`.
    poses : (N + 1, 4, 4), extents : (N, 3), work : (4, 4), phis : (N, SLOTS) float64, scratch.
    """

    root: np.ndarray
    parent: np.ndarray
    kind: np.ndarray
    contact: np.ndarray
    parent_face: np.ndarray
    child_face: np.ndarray
    phi: np.ndarray
    size: np.ndarray
    solid: np.ndarray
    vertex: np.ndarray
    slot: np.ndarray
    growth: np.ndarray
    base: np.ndarray
    poses: np.ndarray
    extents: np.ndarray
    work: np.ndarray
    phis: np.ndarray


def new_placement(graph: SceneGraph, addresses: Sequence[str]) -> tuple[Placement, np.ndarray, Domain]:
    """Return the graph's arrays, the present values of the free numbers, and their domain.

    addresses : such as "red.contact.theta", "red.side".

    Raises DerenderError for an address that is not there or a contact type that has no compiled form.
    """
    names = graph.names
    index = {name: n for n, name in enumerate(names)}
    count, free = len(names), len(addresses)
    phi, size, solid = np.zeros((count, SLOTS)), np.zeros((count, 3)), np.full(count, -1)
    codes = np.full((5, count), -1)
    parameters = []
    for n, vertex in enumerate(graph.vertices):
        contact = contacts[vertex.contact.type]
        if contact.compiled_code is None:
            raise DerenderError(
                f"{vertex.contact.type} has no compiled form", f"{vertex.name}.contact", "use --method mcmc"
            )
        shape, parent = shapes[vertex.shape], graph.body(vertex.parent).shape
        faces = vertex.contact.parent_face, vertex.contact.child_face
        parameters.append(contact.parameters(parent, shape, *faces))
        for k, parameter in enumerate(parameters[n]):
            phi[n, k] = vertex.contact.values.get(parameter.name, parameter.default or 0.0)
        extents = vertex.body.size()
        size[n] = 0.0 if extents is None else extents
        kind = FRAME if shape.solid_kind is None else shape.solid_kind
        codes[:, n] = (
            index.get(vertex.parent, -1),
            kind,
            contact.compiled_code,
            FEATURE_CODES[faces[0]],
            FEATURE_CODES[faces[1]],
        )
    for place, name in enumerate(graph.solid_names):
        solid[index[name]] = place
    vertex_of, slot, growth, base = np.zeros(free, np.int64), np.full(free, -1), np.zeros((free, 3)), np.zeros(free)
    values, lower, upper, period = np.zeros(free), np.zeros(free), np.zeros(free), np.zeros(free)
    for p, address in enumerate(addresses):
        name, _, rest = address.partition(".")
        if name not in index:
            raise DerenderError(f"no number is called {address!r}", remedy=suggest(name, names))
        n = vertex_of[p] = index[name]
        vertex = graph.vertices[n]
        known = parameters[n] if rest.startswith("contact.") else shapes[vertex.shape].parameters
        wanted = rest.removeprefix("contact.")
        found = [k for k, parameter in enumerate(known) if parameter.name == wanted]
        if not found:
            raise DerenderError(f"no number is called {address!r}", remedy=suggest(wanted, [q.name for q in known]))
        parameter = known[found[0]]
        lower[p], upper[p] = parameter.lower, parameter.upper
        period[p] = parameter.period or 0.0
        if rest.startswith("contact."):
            slot[p] = found[0]
            values[p] = phi[n, found[0]]
        else:
            psi = vertex.psi
            values[p] = base[p] = psi[found[0]]
            more = psi.copy()
            more[found[0]] += 1.0  # extents are affine in the shape's numbers
            body = vertex.body
            growth[p] = np.asarray(body.shape.size(more, body.options)) - size[n]
            lower[p] = max(lower[p], SMALLEST / max(growth[p].max(), 1e-9))
    placement = Placement(  # type: ignore[call-arg]
        np.ascontiguousarray(graph.root_pose, np.float64),
        *(np.ascontiguousarray(row, np.int64) for row in codes),
        phi,
        size,
        solid.astype(np.int64),
        vertex_of,
        slot.astype(np.int64),
        growth,
        base,
        np.zeros((count + 1, 4, 4)),
        np.zeros((count, 3)),
        np.zeros((4, 4)),
        np.zeros((count, SLOTS)),
    )
    return placement, values, Domain(lower, upper, period)


@njit(cache=True, nogil=True)
def place(placement, values, poses, sizes):
    """Write the poses (S, 4, 4) and sizes (S, 3) of the solids at these values (P,) of the free numbers."""
    count = placement.parent.shape[0]
    placement.phis[:] = placement.phi
    placement.extents[:] = placement.size
    for p in range(values.shape[0]):
        n = placement.vertex[p]
        if placement.slot[p] >= 0:
            placement.phis[n, placement.slot[p]] = values[p]
        else:
            for k in range(3):
                placement.extents[n, k] += placement.growth[p, k] * (values[p] - placement.base[p])
    placement.poses[count] = placement.root
    nothing = np.zeros(3)
    for n in range(count):
        up = placement.parent[n]
        relative_pose(
            placement.contact[n],
            placement.kind[up] if up >= 0 else FRAME,
            placement.extents[up] if up >= 0 else nothing,
            placement.kind[n],
            placement.extents[n],
            placement.parent_face[n],
            placement.child_face[n],
            placement.phis[n],
            placement.work,
        )
        compose(placement.poses[up if up >= 0 else count], placement.work, placement.poses[n])
        s = placement.solid[n]
        if s >= 0:
            poses[s] = placement.poses[n]
            sizes[s] = placement.extents[n]


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
