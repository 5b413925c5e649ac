"""The scene graph of Definition 2.1: a tree of solids, each placed on its parent by a contact; poses by Eq. 1."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.registry import Parameter, suggest
from derender.scene.contacts import contacts
from derender.scene.contacts.kinds import Inverse
from derender.scene.pose import inverse
from derender.scene.shapes import Body, shapes
from derender.scene.solids import MESH, Solids

ROOT = "root"

# What is left of a slack number after a pose went through matrices: below this it is none.
ROUNDING = 1e-11
RADIUS = 0.1  # metres at which the angles of what has no extent count


@dataclass(frozen=True)
class Contact:
    """How a vertex touches its parent: c_i and phi_i.

    parent_face, child_face : names of the features that touch, or None (`6dof`).
    values : phi by name, slack included where it is not zero; what is missing has its default.
    """

    type: str  # registered contact type
    parent_face: str | None = None
    child_face: str | None = None
    values: Mapping[str, float] = field(default_factory=dict)

    @property
    def faces(self) -> tuple[str, str]:
        """The parent's and the child's, of a contact that has them."""
        assert self.parent_face is not None and self.child_face is not None, self.type
        return self.parent_face, self.child_face

    @property
    def named_faces(self) -> dict[str, Any]:
        """Those that it has, by the keys of files and JSON."""
        faces = {"parent_face": self.parent_face, "child_face": self.child_face}
        return {key: face for key, face in faces.items() if face is not None}


@dataclass(frozen=True)
class Vertex:
    """One object: s_i, psi_i, pi(i), c_i, phi_i.

    options : mesh file, hull, mass, friction, colour ... : what is not a parameter.
    supports : names of further vertices on which it rests (a bridge's second tower); see `constraints`.
    """

    name: str  # unique in the graph; not "root"
    shape: str  # registered shape type
    parameters: Mapping[str, float] = field(default_factory=dict)  # psi by name
    parent: str = ROOT  # name of the parent, or "root"
    contact: Contact = Contact("6dof")  # the contact with the parent
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

    Raises DerenderError : the two shapes have no such contact.
    """
    kind = contacts[type]
    reach = child.size()
    radius = RADIUS if reach is None else 0.5 * float(np.linalg.norm(reach))
    best: tuple[float, Contact, Inverse] | None = None
    for on, by in kind.choices(parent.shape, child.shape):
        if (parent_face is not None and on != parent_face) or (child_face is not None and by != child_face):
            continue
        found = kind.invert(relative, parent, child, on, by)
        cost = found.outside + abs(found.gap) + radius * (found.tilt + found.angle)
        if best is None or cost < best[0]:
            slack = {name: value for name, value in found.slack.items() if abs(value) > ROUNDING}
            best = (cost, Contact(type, on, by, {**found.phi, **slack}), found)
    if best is None:
        kind.default_choice(parent.shape, child.shape)
        raise DerenderError(f"{parent_face!r} and {child_face!r} cannot be in {type} contact")
    return best[1], best[2]


def vertex_of(name: str, shape: str, size: np.ndarray, contact: Contact = Contact("6dof")) -> Vertex:
    """Return an object of a shape with full extents (3,) along its own axes, metres, under the root."""
    kind = shapes[shape]
    numbers = map(float, kind.psi_from_size(size))
    return Vertex(name, shape, dict(zip((p.name for p in kind.parameters), numbers, strict=True)), ROOT, contact)


def floating(pose: np.ndarray) -> Contact:
    """Return the 6dof contact of a pose (4, 4) under the root."""
    return Contact("6dof", values=contacts["6dof"].invert(pose, ROOT_BODY, ROOT_BODY, None, None).phi)


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


STANDARD_GRAVITY = 9.81
"""m / s^2"""
ROOT_BODY = Body(shapes["frame"])


@dataclass(frozen=True)
class Constraint:
    """An undirected relation between two objects. first, second : names of vertices; their order says nothing."""

    first: str
    second: str
    type: str = "does-not-touch"
    margin: float = 0.0  # metres that must be left between their surfaces


@dataclass(frozen=True, eq=False)
class SceneGraph:
    """A scene: the root's pose and the vertices, parents before children.

    gravity : (3,) the pull of gravity in root axes, in units of STANDARD_GRAVITY.
    """

    root_pose: np.ndarray  # (4, 4) float64, root to camera
    vertices: tuple[Vertex, ...] = ()  # the objects, in order
    gravity: tuple[float, float, float] = (0.0, 0.0, -1.0)
    constraints: tuple[Constraint, ...] = ()  # undirected relations between objects ("does not touch")

    def __post_init__(self) -> None:
        seen = {ROOT}
        for vertex in self.vertices:
            if vertex.name in seen:
                raise DerenderError(f"two objects are called {vertex.name!r}", vertex.name, "give each its own name")
            if vertex.parent not in seen:
                later = any(other.name == vertex.parent for other in self.vertices)
                what = f"the parent {vertex.parent!r} " + ("comes after its child" if later else "does not exist")
                remedy = "list parents first, without a cycle" if later else suggest(vertex.parent, seen)
                raise DerenderError(what, f"{vertex.name}.parent", remedy)
            seen.add(vertex.name)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, SceneGraph):
            return NotImplemented
        ours, theirs = (self.vertices, self.constraints), (other.vertices, other.constraints)
        same_root = np.array_equal(self.root_pose, other.root_pose) and np.array_equal(self.gravity, other.gravity)
        return bool(same_root and ours == theirs)

    __hash__ = None  # type: ignore[assignment]  # its numbers are in arrays and dicts; `structure()` can be hashed

    # ---- the tree -------------------------------------------------------------------------------------------------

    @cached_property
    def _index(self) -> dict[str, int]:
        return {vertex.name: index for index, vertex in enumerate(self.vertices)}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the vertices, in order, without the root."""
        return tuple(vertex.name for vertex in self.vertices)

    def vertex(self, name: str) -> Vertex:
        """Return the vertex called `name`; DerenderError if there is none."""
        try:
            return self.vertices[self._index[name]]
        except KeyError:
            raise DerenderError(f"no object is called {name!r}", remedy=suggest(name, self.names)) from None

    def body(self, name: str) -> Body:
        """Return shape and numbers of a vertex or of the root."""
        return ROOT_BODY if name == ROOT else self.vertex(name).body

    def children(self, name: str) -> tuple[str, ...]:
        """Return the names of the vertices whose parent is `name`."""
        return tuple(vertex.name for vertex in self.vertices if vertex.parent == name)

    def descendants(self, name: str) -> tuple[str, ...]:
        """Return the names of all vertices below `name`, in order; `name` itself is not among them."""
        below = {name}
        for vertex in self.vertices:
            if vertex.parent in below:
                below.add(vertex.name)
        return tuple(vertex.name for vertex in self.vertices if vertex.name in below and vertex.name != name)

    def path(self, j: str, i: str) -> tuple[str, ...]:
        """Return the vertices on the path from `j` up to its ancestor `i`, `i` not included (Eq. 8)."""
        walked = []
        while j != i:
            if j == ROOT:
                raise ValueError(f"{i!r} is not an ancestor")
            walked.append(j)
            j = self.vertex(j).parent
        return tuple(walked)

    def structure(self) -> tuple:
        """Return the discrete part (V, E, s, c), hashable: equal for graphs that differ in numbers only."""
        return tuple(
            (v.name, v.shape, v.parent, v.contact.type, v.contact.parent_face, v.contact.child_face, tuple(v.supports))
            for v in self.vertices
        )

    # ---- poses ----------------------------------------------------------------------------------------------------

    def poses(self) -> dict[str, np.ndarray]:
        """Return the pose (4, 4), object to camera, of every vertex by name, and of the root (Eq. 1)."""
        return dict(self._poses)

    @cached_property
    def _poses(self) -> dict[str, np.ndarray]:
        return self._placed(self.vertices, {ROOT: np.asarray(self.root_pose, dtype=float)})

    def _placed(self, vertices: Sequence[Vertex], poses: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return poses by name, and those of vertices whose parents are among them or before them (Eq. 1)."""
        bodies: dict[str, Body] = {}
        for vertex in vertices:
            bodies[vertex.name] = body = vertex.body
            parent = bodies.get(vertex.parent) or self.body(vertex.parent)
            poses[vertex.name] = poses[vertex.parent] @ relative_pose(vertex, parent, body)
        return poses

    @property
    def solid_names(self) -> tuple[str, ...]:
        """Names of the vertices that `solids` holds, in its order: all but frames."""
        return tuple(v.name for v in self.vertices if shapes[v.shape].solid_kind is not None)

    def solids(self) -> Solids:
        """Return all that has a surface as flat arrays in the camera's frame (Eq. 5)."""
        return solids_of([self.vertex(name) for name in self.solid_names], self._poses)

    def pull(self) -> np.ndarray:
        """Return the (3,) acceleration of gravity in camera axes, m / s^2."""
        return STANDARD_GRAVITY * float(np.linalg.norm(self.gravity)) * self.down()

    def down(self) -> np.ndarray:
        """Return the (3,) unit direction of gravity in camera axes."""
        gravity = np.asarray(self.gravity, dtype=float)
        down = np.asarray(self.root_pose)[:3, :3] @ (gravity if np.any(gravity) else (0.0, 0.0, -1.0))
        return down / np.linalg.norm(down)

    # ---- numbers --------------------------------------------------------------------------------------------------

    def degrees_of_freedom(self) -> int:
        """Return the number of continuous contact parameters: 15 and 24 for Figure 3. Slack counts where not zero."""
        total = 0
        for vertex in self.vertices:
            values = vertex.contact.values
            free = sum(not p.slack or values.get(p.name, 0.0) != 0.0 for p in self.contact_parameters(vertex.name))
            total += getattr(contacts[vertex.contact.type], "degrees_of_freedom", free)
        return total

    def contact_parameters(self, name: str) -> tuple[Parameter, ...]:
        """Return the parameters of a vertex's contact with its parent, in their order."""
        vertex = self.vertex(name)
        contact, parent = vertex.contact, self.body(vertex.parent).shape
        return contacts[contact.type].parameters(parent, shapes[vertex.shape], contact.parent_face, contact.child_face)

    def period(self, address: str) -> float | None:
        """Return the period of the number at an address, None of one that is no angle of a contact."""
        name, _, key = address.partition(".contact.")
        return next((p.period for p in self.contact_parameters(name) if p.name == key), None) if key else None

    def numbers(self) -> dict[str, float]:
        """Return every number that the graph gives, by address: `red.side`, `red.contact.theta`."""
        found = {}
        for vertex in self.vertices:
            found.update({f"{vertex.name}.{key}": float(value) for key, value in vertex.parameters.items()})
            found.update({f"{vertex.name}.contact.{key}": float(x) for key, x in vertex.contact.values.items()})
        return found

    def with_numbers(self, numbers: Mapping[str, float]) -> "SceneGraph":
        """Return the graph with some numbers changed, by address; an unknown object is a DerenderError."""
        changed: dict[str, Vertex] = {}
        for address, value in numbers.items():
            name, _, rest = address.partition(".")
            vertex = changed.get(name) or self.vertex(name)
            if rest.startswith("contact."):
                values = {**vertex.contact.values, rest.removeprefix("contact."): float(value)}
                changed[name] = replace(vertex, contact=replace(vertex.contact, values=values))
            else:
                changed[name] = replace(vertex, parameters={**vertex.parameters, rest: float(value)})
        return replace(self, vertices=tuple(changed.get(v.name, v) for v in self.vertices))

    # ---- changes --------------------------------------------------------------------------------------------------

    def replace(self, name: str, /, **changes: Any) -> "SceneGraph":
        """Return the graph with fields of one vertex changed, all but its name."""
        old = self.vertex(name)
        new = replace(old, **changes)
        return replace(self, vertices=tuple(new if vertex is old else vertex for vertex in self.vertices))

    def renamed(self, names: Mapping[str, str]) -> "SceneGraph":
        """Return the graph with some vertices called otherwise wherever they are named. names : new by present ones."""
        called = {name: names.get(name, name) for name in (ROOT, *self.names)}
        vertices = tuple(
            replace(v, name=called[v.name], parent=called[v.parent], supports=tuple(called[s] for s in v.supports))
            for v in self.vertices
        )
        relations = tuple(replace(c, first=called[c.first], second=called[c.second]) for c in self.constraints)
        return replace(self, vertices=vertices, constraints=relations)

    def add(self, *vertices: Vertex) -> "SceneGraph":
        """Return the graph with vertices appended; those before them stay where they are."""
        graph = replace(self, vertices=(*self.vertices, *vertices))
        if "_poses" in self.__dict__:  # what is known already: a heap grows object by object
            graph.__dict__["_poses"] = graph._placed(vertices, dict(self._poses))
        return graph

    def remove(self, name: str) -> "SceneGraph":
        """Return the graph without a vertex, its descendants, and what relations name them."""
        gone = {name, *self.descendants(self.vertex(name).name)}
        vertices = tuple(
            replace(v, supports=tuple(s for s in v.supports if s not in gone)) if gone & set(v.supports) else v
            for v in self.vertices
            if v.name not in gone
        )
        constraints = tuple(c for c in self.constraints if not gone & {c.first, c.second})
        return replace(self, vertices=vertices, constraints=constraints)

    def nearest_contact(
        self, name: str, parent: str, type: str, parent_face: str | None = None, child_face: str | None = None
    ) -> tuple[Contact, Inverse]:
        """Return the contact of a vertex with another parent that is nearest to their poses: `nearest_contact`."""
        relative = inverse(self._poses[parent]) @ self._poses[name]
        return nearest_contact(relative, self.body(parent), self.body(name), type, parent_face, child_face)
