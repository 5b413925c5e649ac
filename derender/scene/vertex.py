"""One object of a scene graph: its shape, its contact, and where the two put it."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.scene.contacts import contacts
from derender.scene.contacts.base import Inverse
from derender.scene.shapes import Body, shapes
from derender.scene.solids import MESH, Solids

NAME = re.compile(r"[^\W_][\w -]{0,63}")  # of an object: a part of an address, safe to print
RESERVED = ("root", "likelihood", "camera")  # that addresses begin with besides objects
ROOT = "root"

# What is left of a slack number after a pose went through matrices: below this it is none.
ROUNDING = 1e-11
RADIUS = 0.1  # metres at which the angles of what has no extent count


def is_name(name: object) -> bool:
    """Return whether this may name an object."""
    return isinstance(name, str) and NAME.fullmatch(name) is not None and name not in RESERVED


@dataclass(frozen=True)
class Contact:
    """How a vertex touches its parent: c_i and phi_i.

    Attributes
    ----------
    type : registered contact type.
    parent_face, child_face : names of the features that touch, or None (`6dof`).
    values : phi by name, slack included where it is not zero; what is missing has its default.
    """

    type: str
    parent_face: str | None = None
    child_face: str | None = None
    values: Mapping[str, float] = field(default_factory=dict)

    @property
    def faces(self) -> tuple[str, str]:
        """The parent's and the child's, of a contact that has them."""
        assert self.parent_face is not None and self.child_face is not None, self.type
        return self.parent_face, self.child_face


@dataclass(frozen=True)
class Vertex:
    """One object: s_i, psi_i, pi(i), c_i, phi_i.

    Attributes
    ----------
    name : unique in the graph; not "root".
    shape : registered shape type.
    parameters : psi by name.
    parent : name of the parent, or "root".
    contact : the contact with the parent.
    options : mesh file, hull, mass, friction, colour ... : what is not a parameter.
    supports : names of further vertices on which it rests (a bridge's second tower); see `constraints`.
    """

    name: str
    shape: str
    parameters: Mapping[str, float] = field(default_factory=dict)
    parent: str = ROOT
    contact: Contact = Contact("6dof")
    options: Mapping[str, Any] = field(default_factory=dict)
    supports: tuple[str, ...] = ()

    @property
    def body(self) -> Body:
        """The shape with its numbers."""
        shape = shapes[self.shape]
        return Body(shape, self.psi, self.options)

    @property
    def psi(self) -> np.ndarray:
        """The (P,) shape parameters in the order of the shape's type; NaN where one is missing."""
        given = self.parameters
        values = [given.get(p.name, p.default) for p in shapes[self.shape].parameters]
        return np.array([np.nan if value is None else value for value in values], dtype=float)


def relative_pose(vertex: Vertex, parent: Body, child: Body | None = None) -> np.ndarray:
    """Return the (4, 4) pose of a vertex in the object axes of its parent's body."""
    contact = vertex.contact
    child = vertex.body if child is None else child
    faces = contact.parent_face, contact.child_face
    return contacts[contact.type].relative_pose(contact.values, parent, child, *faces)


def nearest_contact(
    relative: np.ndarray,
    parent: Body,
    child: Body,
    type: str,
    parent_face: str | None = None,
    child_face: str | None = None,
) -> tuple[Contact, Inverse]:
    """Return the contact of one type that is nearest to the (4, 4) pose of child in parent, and its residuals.

    Among the faces not given those win that need the least slack, an angle counting as its arc at the child's radius.
    """
    kind = contacts[type]
    reach = child.size()
    radius = RADIUS if reach is None else 0.5 * float(np.linalg.norm(reach))
    best: tuple[float, Contact, Inverse] | None = None
    for on, by in kind.choices(parent.shape, child.shape):
        if (parent_face is not None and on != parent_face) or (child_face is not None and by != child_face):
            continue
        found = kind.invert(relative, parent, child, on, by)
        angles = [x for name, x in found.slack.items() if name.startswith("tilt")]
        cost = (
            found.outside + abs(found.slack.get("gap", 0.0)) + radius * (np.hypot(*[0, 0, *angles][-2:]) + found.angle)
        )
        if best is None or cost < best[0]:
            slack = {name: value for name, value in found.slack.items() if abs(value) > ROUNDING}
            best = (cost, Contact(type, on, by, {**found.phi, **slack}), found)
    if best is None:
        kind.default_choice(parent.shape, child.shape)
        raise DerenderError(f"{parent_face!r} and {child_face!r} cannot be in {type} contact")
    return best[1], best[2]


def solids_of(vertices: list[Vertex], poses: Mapping[str, np.ndarray]) -> Solids:
    """Return vertices with extent as flat arrays; a mesh that several share appears once."""
    count = len(vertices)
    kind, mesh = np.zeros(count, np.int32), np.full(count, -1, np.int32)
    pose, size = np.zeros((count, 4, 4)), np.zeros((count, 3))
    meshes: list[tuple[np.ndarray, np.ndarray]] = []
    places: dict[Any, int] = {}
    for index, vertex in enumerate(vertices):
        body = vertex.body
        pose[index] = poses[vertex.name]
        drawn_as, size[index], own = body.drawn()
        assert drawn_as is not None, "a frame is no solid"
        kind[index] = drawn_as
        if own is not None:
            pose[index] = pose[index] @ own
        if kind[index] == MESH:
            key, arrays = body.shape.drawn_mesh(body.psi, body.options)
            if key not in places:
                places[key] = len(meshes)
                meshes.append(arrays)
            mesh[index] = places[key]
    return Solids(kind, pose, size, mesh, tuple(meshes))
