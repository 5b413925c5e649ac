"""One solid written down anew: other parent, other faces, other shape type, in the same place. The core of three moves.

A vertex and its Rest are nine coordinates of a posed box (`charts`), which is taken from one chart to another:

    (numbers, rest) -> (extents, pose) -> axes named anew by a rotation R of the box -> (numbers', rest')
    log J = log d(extents, pose)/d(numbers, rest) - log d(extents', pose')/d(numbers', rest'),

for naming axes anew and shifting by a function of the other coordinates keep volume. The rest is drawn forwards and
dropped backwards, so where the prior's contacts are ideal the pose moves by what they cannot hold: narrow normals.

R is drawn uniformly from those of the box's 24 (of a round solid: of its own two) under which the new contact's angle
lies in the prior's range and its face leans less than 45 degrees. Along the orbit of a pose that set has the same
number of elements whichever R one starts from, so back and forth its probabilities are functions of the posed box.

What stands on such a solid rides along. Where its parent's axes are named anew, its own parent face is, and its
numbers become those of the same place (their Jacobian is the ratio of area elements); where its angle then leaves
its range by a symmetry of its shape, its axes are named anew, and so on upwards.
"""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from derender.scene.contacts import contacts
from derender.scene.contacts.base import FLIP
from derender.scene.distributions import Distribution
from derender.scene.graph import Contact, SceneGraph, Vertex
from derender.scene.pose import inverse
from derender.scene.priors.values import QUATERNION, ROTATION
from derender.scene.shapes import Body, shapes
from derender.scene.shapes.base import AXES
from derender.scene.shapes.box import ROTATIONS
from derender.structures.jumps.base import Vocabulary
from derender.structures.jumps.charts import (
    LINE,
    STEEPEST,
    TILTED,
    Rest,
    all_numbers,
    chartable,
    extents_into,
    extents_of,
    free_names,
    log_extents_element,
    log_pose_element,
    scales_with_extents,
)

ROUND = np.stack([np.eye(3), np.diag([1.0, -1.0, -1.0])])
IDENTITY = np.eye(3)[None]


class Slot(NamedTuple):
    """Where a solid is to hang: kind of object, parent, contact (type, parent face, child face)."""

    kind: str
    parent: str
    choice: tuple


class PosedBox(NamedTuple):
    """A posed box. extents : (3,) metres; pose : (4, 4) object to camera; log_element : of the chart it came from."""

    extents: np.ndarray
    pose: np.ndarray
    log_element: float


def slot_of(words: Vocabulary, graph: SceneGraph, name: str) -> Slot:
    """Return where a vertex hangs."""
    vertex = graph.vertex(name)
    contact = vertex.contact
    return Slot(words.kind_of(vertex), vertex.parent, (contact.type, contact.parent_face, contact.child_face))


def table_of(words: Any, graph: SceneGraph, slot: Slot) -> Any:
    """Return the table of a slot's contact; None where the prior has none or jumps do not know its chart."""
    table = words.table(*words.seat(graph, slot.parent), words.shapes[slot.kind].type, slot.choice)
    if (
        table is None
        or not chartable(slot.choice[0], table)
        or not scales_with_extents(shapes[words.shapes[slot.kind].type])
    ):
        return None
    return table


def release(words: Vocabulary, graph: SceneGraph, vertex: Vertex, rest: Rest) -> PosedBox:
    """Return the posed box of a vertex and its rest."""
    entry = words.shapes[words.kind_of(vertex)]
    parent, contact = graph.body(vertex.parent), vertex.contact
    psi = vertex.psi
    numbers = {**all_numbers(contact, parent.shape, shapes[vertex.shape]), **rest.contact}
    faces = contact.parent_face, contact.child_face
    relative = contacts[contact.type].relative_pose(numbers, parent, vertex.body, *faces)
    element = log_pose_element(contact.type, numbers, parent, vertex.body, faces) + log_extents_element(entry, psi)
    extents = extents_of(entry, psi, rest.shape)
    pose = graph.poses()[vertex.parent] @ relative
    return PosedBox(extents, _on_its_foot(graph, pose, contact, parent, vertex, extents), element)


def _on_its_foot(
    graph: Any, pose: np.ndarray, contact: Any, parent: Any, vertex: Any, extents: np.ndarray, sign: float = 1.0
) -> np.ndarray:
    """Return the pose shifted along the parent's face so that the box with other extents stands where the solid does.

    A function of extents, sizes and rotation times a direction: as a map of positions a shift, of Jacobian one.
    """
    if contact.type == "6dof":
        return pose
    normal = (graph.poses()[vertex.parent] @ parent.face(contact.parent_face).frame)[:3, 2]
    along = np.abs(pose[:3, :3].T @ normal)
    shifted = pose.copy()
    shifted[:3, 3] += sign * 0.5 * float(along @ (extents - vertex.body.size())) * normal
    return shifted


def hung_from(
    words: Vocabulary, graph: SceneGraph, name: str, slot: Slot, table: Any, posed: PosedBox
) -> tuple[Vertex, Rest, float] | None:
    """Return (vertex, rest, log element) of a posed box in a slot, the inverse of `release`; None if out of range."""
    entry = words.shapes[slot.kind]
    parent = graph.body(slot.parent)
    psi, rest_shape = extents_into(entry, posed.extents)
    parameters = {key: float(x) for (key, _), x in zip(entry._table, psi, strict=True)}
    bare = Vertex(name, entry.type, parameters, slot.parent, Contact(*slot.choice), dict(entry.options))
    pose = _on_its_foot(graph, posed.pose, bare.contact, parent, bare, posed.extents, -1.0)
    body = bare.body
    relative = inverse(graph.poses()[slot.parent]) @ pose
    found = contacts[slot.choice[0]].invert(relative, parent, body, *slot.choice[1:])
    if found.outside > 1e-9 or found.angle > 1e-9:
        return None
    numbers = dict(found.values)
    values, rest = {}, {}
    for key, value in table.items():
        if key == QUATERNION:
            values.update({part: numbers.pop(part) for part in ROTATION})
        elif isinstance(value, Distribution):
            values[key] = numbers.pop(key)
        else:
            values[key] = value
    rest = numbers  # what is left is fixed or absent in the prior
    if "theta" in values and isinstance(table.get("theta"), Distribution):
        low, high = angle_range(table["theta"])
        values["theta"] = low + (values["theta"] - low) % math.tau
        if not values["theta"] < high:
            return None
    faces = slot.choice[1:]
    complete = {**values, **rest}
    element = log_pose_element(slot.choice[0], complete, parent, body, faces) + log_extents_element(entry, psi)
    vertex = replace(bare, contact=Contact(*slot.choice, values))  # type: ignore[call-arg]
    return vertex, Rest(rest, rest_shape), element


def angle_range(law: Distribution) -> tuple[float, float]:
    """Return [low, high): the chart of an angle with this prior, at most one turn."""
    low, high = law.support
    if not (math.isfinite(low) and math.isfinite(high)):
        return law.mean() - math.pi, law.mean() + math.pi
    return low, min(high, low + math.tau)


def group(first: str, second: str) -> np.ndarray:
    """Return the (K, 3, 3) rotations by which the axes of a solid may be named anew as one shape becomes another."""
    boxes = {"box", "cube"}
    if first == second and first not in boxes:
        return ROUND if first == "cylinder" else IDENTITY
    if {first, second} <= boxes | {"cylinder", "sphere"}:
        return ROTATIONS
    return IDENTITY


def allowed(
    words: Vocabulary,
    graph: SceneGraph,
    slot: Slot,
    table: dict[str, Distribution | float],
    pose: np.ndarray,
    rotations: np.ndarray,
) -> np.ndarray:
    """Return (K,) bool: under which rotations of its axes a posed box can hang in a slot, by its angles."""
    kind = slot.choice[0]
    shape = words.shapes[slot.kind].type
    if kind == "6dof" or shape == "sphere":
        return np.ones(len(rotations), bool)
    parent = graph.body(slot.parent)
    on = parent.face(slot.choice[1]).frame[:3, :3]
    by = Body(shapes[shape], np.ones(len(shapes[shape].parameters)), words.shapes[slot.kind].options)
    feature = by.face(slot.choice[2]).frame[:3, :3] @ FLIP[:3, :3]
    turned = (on.T @ graph.poses()[slot.parent][:3, :3].T @ pose[:3, :3]) @ rotations @ feature
    if kind in LINE:
        angle = np.arctan2(turned[:, 1, 0], turned[:, 0, 0])
        good = np.abs(turned[:, 2, 0]) < STEEPEST
    else:
        angle = np.arctan2(turned[:, 1, 0] - turned[:, 0, 1], turned[:, 0, 0] + turned[:, 1, 1])  # the twist about z
        good = turned[:, 2, 2] > STEEPEST
    law = table.get("theta")
    if isinstance(law, Distribution):
        low, high = angle_range(law)
        good &= (angle - low) % math.tau < high - low
    return good


def face_after(name: str | None, rotation: np.ndarray) -> str | None:
    """Return what a face is called once the axes are named anew: a direction d becomes R^T d."""
    if name is None or name[0] not in "+-" or len(name) != 2:
        return name
    axis, sign = AXES.index(name[1]), 1.0 if name[0] == "+" else -1.0
    direction = sign * rotation[axis]
    place = int(np.argmax(np.abs(direction)))
    return ("+" if direction[place] > 0 else "-") + AXES[place]


def renamed(pose: np.ndarray, extents: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (pose, extents) of the same box with axes named anew: pose R, |R^T| extents."""
    new = pose.copy()
    new[:3, :3] = pose[:3, :3] @ rotation
    return new, np.abs(rotation.T) @ extents


def carry(
    words: Vocabulary, graph: SceneGraph, name: str, new: Vertex, rotation: np.ndarray
) -> tuple[SceneGraph, float] | None:
    """Return the graph after `name` became `new`, its axes named anew by R, all above it riding along, and log J."""
    changed = {name: new}
    turned = {name: rotation}
    total = 0.0
    if np.array_equal(rotation, np.eye(3)):
        new_graph = graph.exchange(changed)
        return (new_graph, 0.0) if same_freedom(words, graph, new_graph, graph.children(name)) else None
    for below in graph.descendants(name):
        vertex = graph.vertex(below)
        turn = turned.get(vertex.parent)
        if turn is None:
            continue
        done = _ride(words, graph, vertex, changed[vertex.parent], turn)
        if done is None:
            return None
        changed[below], own, log_jacobian = done
        total += log_jacobian
        if own is not None:
            turned[below] = own
    return graph.exchange(changed), total


def same_freedom(words: Any, old: SceneGraph, new: SceneGraph, names: Any) -> bool:
    """Return whether the contacts of some vertices have the same free numbers in both graphs, by the prior."""
    for name in names:
        tables = [words.table_of(graph, graph.vertex(name)) for graph in (old, new)]
        if None in tables or len({free_names(table) for table in tables}) > 1:
            return False
    return True


def _ride(words, graph, vertex, parent: Vertex, turn) -> tuple[Vertex, np.ndarray | None, float] | None:
    """Return a child in the same place on a parent whose axes are named anew, its own rotation if any, and log J."""
    from derender.scene.priors.tree import top_face

    contact = vertex.contact
    old_parent, body = graph.body(vertex.parent), vertex.body
    relative = graph.relative_pose(vertex.name)
    new_relative = relative.copy()
    new_relative[:3] = turn.T @ relative[:3]
    face = face_after(contact.parent_face, turn)
    choice = (contact.type, face, contact.child_face)
    old_table = words.table_of(graph, vertex)
    top = top_face(parent.shape, parent.contact.type, parent.contact.child_face)
    table = words.table(parent.shape, top, vertex.shape, choice)
    if old_table is None or table is None or contact.type not in TILTED + LINE:
        return None
    if {k for k, v in old_table.items() if isinstance(v, Distribution)} != {
        k for k, v in table.items() if isinstance(v, Distribution)
    }:
        return None
    old_numbers = all_numbers(contact, old_parent.shape, body.shape)
    found = contacts[contact.type].invert(new_relative, parent.body, body, face, contact.child_face)
    if found.outside > 1e-9 or found.angle > 1e-9:
        return None
    numbers, own = dict(found.values), None
    law = table.get("theta")
    if isinstance(law, Distribution):
        low, high = angle_range(law)
        order = body.shape.face_order(contact.child_face)
        period = math.tau / order if math.isfinite(order) else math.tau
        theta = low + (numbers["theta"] - low) % math.tau
        if not theta < high:
            if abs(high - low - period) > 1e-9 or contact.type in LINE:
                return None  # the range is no period: no one-to-one way to fold
            steps = math.floor((theta - low) / period)
            theta -= steps * period
            numbers["theta"] = theta
            folded = {**numbers}
            pose = contacts[contact.type].relative_pose(folded, parent.body, body, face, contact.child_face)
            own = np.round(new_relative[:3, :3].T @ pose[:3, :3])
            again = contacts[contact.type].invert(pose, parent.body, body, face, contact.child_face)
            numbers = {**again.values, "theta": theta}
        numbers["theta"] = theta
    element = log_pose_element(contact.type, old_numbers, old_parent, body, (contact.parent_face, contact.child_face))
    element -= log_pose_element(contact.type, numbers, parent.body, body, (face, contact.child_face))
    values = {key: numbers[key] if isinstance(value, Distribution) else value for key, value in table.items()}
    return replace(vertex, contact=Contact(*choice, values)), own, element
