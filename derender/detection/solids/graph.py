"""From a State to a SceneGraph: names, contact types and faces, slack dropped where contacts hold."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from derender.detection.solids.image import rotation_of
from derender.detection.solids.interpenetration import penetration
from derender.detection.solids.state import FLOOR, Solid, State
from derender.detection.solids.support import LEAST_GAP, touches
from derender.errors import DerenderError
from derender.results.posterior import StructurePosterior
from derender.scene.contacts import contacts
from derender.scene.contacts.kinds import ON_A_FACE
from derender.scene.graph import ROOT, Contact, SceneGraph, Vertex, floating, vertex_of
from derender.scene.pose import from_axes
from derender.scene.solids import KINDS, SPHERE

FLOOR_NAME = "floor"
SHAPES = {KINDS[name]: name for name in ("box", "sphere", "cylinder")}
# Contacts that hold to these are written as holding exactly; others say where the solid is by their slack, exactly.
GAP, TILT = 0.004, np.radians(2.0)
EXACT = 1e-9  # metres
FAR_FROM_ANY = 0.06  # metres by which a contact and a pose differ that is not by it
TILTS = ("tilt", "tilt_x", "tilt_y")


def pose_of(row: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4), object to floor frame, of a row."""
    # a sphere may be turned as one likes: so that its contact needs no turn
    axes = np.diag([1.0, -1.0, -1.0]) if int(row[0]) == SPHERE else rotation_of(row)
    return from_axes(axes.T, row[10:13])


def shape_of(solid: Solid) -> str:
    """Return the name of a solid's shape."""
    return "cube" if solid.cube else SHAPES[solid.kind]


def names_of(state: State) -> list[str]:
    """Return a name for each solid: its shape and a number, see `State.in_order`."""
    counts: dict[str, int] = {}
    names = [""] * len(state)
    for k in state.in_order():
        shape = shape_of(state[k])
        counts[shape] = counts.get(shape, 0) + 1
        names[k] = f"{shape}_{counts[shape]}"
    return names


def order_of(parents: list[int]) -> list[int]:
    """Return the solids with parents first; an edge that would close a circle is cut (its child goes on the floor)."""
    placed: list[int] = []
    waiting = list(range(len(parents)))
    while waiting:
        ready = [k for k in waiting if parents[k] == FLOOR or parents[k] in placed]
        if not ready:
            parents[waiting[0]] = FLOOR
            continue
        placed += ready
        waiting = [k for k in waiting if k not in ready]
    return placed


def scene_graph(
    state: State, floor_pose: np.ndarray, names: list[str] | None = None, may_float: bool = False,
    given: Mapping[int, Vertex] | None = None,
) -> SceneGraph:  # fmt: skip
    """Return the scene graph of a state, its solids called `names` (default: see names_of).

    Each solid hangs on its parent by the contact that fits its pose best; a contact that holds to 4 mm and 2 degrees is
    made exact, one that does not keeps the rest as slack. Where none fits, and over a gap in which something that is
    not seen must stand, the solid floats under the root. Where it `may_float`, what nothing holds floats,
    however near it is to the floor. given : the vertices of solids of known shapes, floating under the root.
    """
    parents = list(state.parents)
    order = order_of(parents)
    names = names_of(state) if names is None else names
    graph = SceneGraph(np.asarray(floor_pose, float), (Vertex(FLOOR_NAME, "plane", {}, ROOT, Contact("6dof")),))
    for k in order:
        row = state.rows[k]
        vertex = (given or {}).get(k) or vertex_of(names[k], shape_of(state[k]), row[13:16], floating(pose_of(row)))
        parent = FLOOR_NAME if parents[k] == FLOOR else names[parents[k]]
        if not (may_float and parents[k] == FLOOR and np.isnan(state.bottoms[k])):
            on = None if parents[k] == FLOOR else state.rows[parents[k]]
            faces = ("+z", "-z") if upright(row) and (on is None or upright(on)) else (None, None)
            contact = best_contact(graph.add(vertex), names[k], parent, row, on, *faces)
            if contact is not None:
                vertex = replace(vertex, parent=parent, contact=contact if k in parents else without(contact, "roll"))
        graph = graph.add(vertex)
    return graph


def best_contact(
    graph: SceneGraph, name: str, parent: str, row: np.ndarray, carrier: np.ndarray | None = None,
    on: str | None = None, by: str | None = None,
) -> Contact | None:  # fmt: skip
    """Return the contact with `parent` that reproduces a pose with the least slack, made exact where near.

    None where the solid is far from any, unless it touches its carrier: it leans on it with as much slack as that
    takes, such as a face against an edge, which no contact can say.

    carrier : the parent's row, None for a floor. on, by : the parent's and the child's face, None for any; of a floor
        it is +z.
    """
    on = "+z" if parent == FLOOR_NAME else on
    near = [fit for fit in fits(graph, name, parent, row, lambda kind: [(on, by)]) if fit.missed < GAP]
    best = min((fit for fit in near if fit.missed < EXACT or fit.tilt < TILT), key=lambda fit: fit.cost, default=None)
    if best is not None and best.cost < FAR_FROM_ANY and best.gap < LEAST_GAP:
        if best.tilt > TILT:
            return best.contact
        return without(best.contact, *TILTS) if best.gap >= GAP else without(best.contact, *TILTS, "gap")
    if carrier is None or not touches(row, carrier):
        return None
    bodies = graph.body(parent).shape, graph.vertex(name).body.shape
    leaning = [fit for fit in fits(graph, name, parent, row, lambda kind: contacts[kind].choices(*bodies))
               if fit.missed < EXACT]  # fmt: skip
    return min(leaning, key=lambda fit: fit.cost).contact if leaning else None


class Fit(NamedTuple):
    """A Contact with slack, its gap and tilt, by how many metres it still misses the pose, and all of that together."""

    contact: Contact
    gap: float
    tilt: float
    missed: float
    cost: float


def fits(graph: SceneGraph, name: str, parent: str, row: np.ndarray, faces: Any) -> Iterator[Any]:
    """Yield the Fit of each kind of contact by each of its (parent's face, child's face) that faces(kind) returns."""
    reach = 0.5 * float(np.linalg.norm(row[13:16]))
    for place, kind in enumerate(ON_A_FACE):
        for on, by in faces(kind):
            try:
                contact, left = graph.nearest_contact(name, parent, kind, on, by)
            except DerenderError:
                continue
            gap = abs(contact.values.get("gap", 0.0))
            tilt = float(np.linalg.norm([contact.values.get(t, 0.0) for t in TILTS]))
            missed = left.outside + reach * left.angle
            yield Fit(contact, gap, tilt, missed, gap + reach * tilt + missed + 0.002 * place)


def without(contact: Contact, *names: str) -> Contact:
    """Return a contact without these numbers; without `roll` a cylinder may be turned about its axis as one likes."""
    return replace(contact, values={name: value for name, value in contact.values.items() if name not in names})


def upright(row: np.ndarray) -> bool:
    """Whether a solid with ends stands on one of them: then that is the face by which it touches what is below."""
    return int(row[0]) != SPHERE and row[9] > 1.0 - 1e-12


def turns_freely(vertex: Vertex) -> bool:
    """Whether a round face touches what bears an object: then all angles of the contact are as good."""
    face = vertex.contact.child_face
    return face is not None and math.isinf(vertex.body.shape.face_order(face))


def without_floor(part: StructurePosterior) -> StructurePosterior:
    """Return a StructurePosterior without the floor that never was: what is left floats under the root."""
    if FLOOR_NAME not in part.graph.names or part.graph.children(FLOOR_NAME):
        return part
    return replace(part, graph=part.graph.remove(FLOOR_NAME))


def matched_names(state: State, reference: State, names: list[str]) -> list[str]:
    """Return names for a state's solids: those of the reference solids that they are, new ones for the others.

    They are the same if they enter each other by half of what is thinnest, however far a hidden side reaches; the
    nearest first.
    """
    pairs = []
    for k, row in enumerate(state.rows):
        for j, other in enumerate(reference.rows):
            if penetration(row, other) > 0.5 * min(row[13:16].min(), other[13:16].min()):
                pairs.append((float(np.linalg.norm(row[10:13] - other[10:13])), k, names[j]))
    result, used = [""] * len(state), set()
    for _, k, name in sorted(pairs):
        if not result[k] and name not in used:
            result[k] = name
            used.add(name)
    fresh = 1
    for k in range(len(state)):
        if not result[k]:
            while f"solid_{fresh}" in names or f"solid_{fresh}" in used:
                fresh += 1
            result[k] = f"solid_{fresh}"
            used.add(result[k])
    return result


def structure_key(state: State, names: list[str]) -> tuple[tuple[str, int, bool, int, str], ...]:
    """Return what tells two structures apart: each solid's name, kind, cube or not, form, and its support's name."""
    return tuple(sorted(
        (names[k], int(state.rows[k][0]), state.cubes[k], state.forms[k],
         "floor" if state.parents[k] == FLOOR else names[state.parents[k]])
        for k in range(len(state))
    ))  # fmt: skip
