"""What a prior over scene graphs is (A.1); where a scene stands before the camera; the prior of a fixed set of objects.

A prior samples graphs and gives their density under the stock measure. In that of a fixed set of objects numbers may be
distributions, faces and parents may be open.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from graphlib import CycleError, TopologicalSorter
from typing import Any

import numpy as np

from derender.registry import suggest
from derender.scene.codec.yaml_tree import Node
from derender.scene.contacts import contacts
from derender.scene.distributions import Categorical, Distribution
from derender.scene.graph import ROOT, SceneGraph, Vertex
from derender.scene.pose import from_quaternion, quaternion, rotation_x, rotation_z, translation
from derender.scene.priors.objects import (
    QUATERNION,
    SAME,
    ContactPrior,
    ShapePrior,
    Value,
    draw,
    draw_vertex,
    fault,
    top_face,
)
from derender.scene.priors.terms import Term, sample_until_allowed, total_log_density
from derender.scene.shapes import shapes

PLACE = ("root.x", "root.y", "root.z")
ROTATED = f"root.{QUATERNION}"


class RootPrior:
    """Prior on the root's pose (4, 4), root to camera: of coordinates, each a number or a distribution, by address."""

    parts: Mapping[str, Any] = {}

    def pose(self, values: Mapping[str, Any]) -> np.ndarray:
        """Return the pose of coordinates by address; those not given are the fixed ones."""
        raise NotImplementedError

    def values(self, pose: np.ndarray) -> dict[str, Any]:
        """Return the coordinates of a pose by address, free and fixed ones."""
        return {}

    def numbers(self, pose: np.ndarray) -> dict[str, float]:
        """Return the same, a rotation as its four numbers: "root.qw" to "root.qz"."""
        found = self.values(pose)
        return found | {f"root.q{axis}": x for axis, x in zip("wxyz", found.pop(ROTATED, ()), strict=False)}

    def log_density(self, pose: np.ndarray) -> float:
        """Return the log density of a pose; -inf where no free coordinates give it."""
        values, free = self.values(pose), self.free_addresses()
        if np.abs(self.pose({key: values[key] for key in free}) - pose).max() > SAME:
            return -math.inf
        return sum((law.log_density(values[key]) for key, law in free.items()), 0.0)

    def sample(self, rng: np.random.Generator | None) -> np.ndarray:
        """Return a pose drawn."""
        drawn = {key: part if isinstance(part, tuple) else draw(part, rng) for key, part in self.parts.items()}
        return written(self.pose(drawn))

    def free_addresses(self) -> dict[str, Distribution]:
        """Return the distributions among the coordinates, by address."""
        return {key: part for key, part in self.parts.items() if isinstance(part, Distribution)}


def written(pose: np.ndarray) -> np.ndarray:
    """Return a pose within rounding of `pose` that survives a quaternion bit for bit, so that a file can hold it."""
    for _ in range(30):
        again = from_quaternion(quaternion(pose), pose[:3, 3])
        if np.array_equal(again, pose):
            break
        pose = again
    return pose


class FixedRoot(RootPrior):
    """One pose, (4, 4)."""

    def __init__(self, pose: np.ndarray) -> None:
        self._pose = np.array(pose, dtype=float)

    def sample(self, rng: np.random.Generator | None) -> np.ndarray:
        return self._pose.copy()

    def pose(self, values: Mapping[str, Any]) -> np.ndarray:
        return self._pose.copy()


class FreeRoot(RootPrior):
    """Position x, y, z (metres, numbers or distributions) and a rotation (a quaternion, or uniform over all).

    position : three values.
    rotation : (4,) unit quaternion (w, x, y, z), or the distribution uniform-rotation.
    """

    def __init__(self, position: tuple[Value, Value, Value], rotation: tuple[float, ...] | Distribution) -> None:
        self.parts = {**dict(zip(PLACE, position, strict=True)), ROTATED: rotation}

    def values(self, pose: np.ndarray) -> dict[str, Any]:
        return {**dict(zip(PLACE, pose[:3, 3].tolist(), strict=True)), ROTATED: tuple(quaternion(pose).tolist())}

    def pose(self, values: Mapping[str, Any]) -> np.ndarray:
        coordinates = {**self.parts, **values}
        return from_quaternion(coordinates[ROTATED], [coordinates[key] for key in PLACE])


class LookedAtRoot(RootPrior):
    """The camera looks at the root's origin from a distance, `elevation` above the root's horizontal plane.

    With z_root up, camera to root is pose = Rz(roll) T(0, 0, distance) Rx(pi/2 + elevation) Rz(azimuth): at azimuth 0
    the root's x points to the right of the image and its y away from the camera.

    distance : metres, positive.  elevation, azimuth, roll : radians.  Each a number or a distribution.
    """

    KEYS = ("distance", "elevation", "azimuth", "roll")

    def __init__(self, distance: Value, elevation: Value, azimuth: Value = 0.0, roll: Value = 0.0) -> None:
        values = (distance, elevation, azimuth, roll)
        self.parts = {f"root.{key}": value for key, value in zip(self.KEYS, values, strict=True)}

    def values(self, pose: np.ndarray) -> dict[str, Any]:
        """Return distance, elevation in [-pi/2, pi/2], azimuth and roll: a z-x-z Euler triple of the rotation."""
        elevation = math.asin(min(max(-pose[2, 2], -1.0), 1.0))
        roll = math.atan2(pose[0, 2], -pose[1, 2])
        azimuth = math.atan2(pose[2, 0], pose[2, 1])
        distance, tilt, around, about = self.parts
        return {distance: pose[2, 3], tilt: elevation, around: _turned(azimuth, self.parts[around]),
                about: _turned(roll, self.parts[about])}  # fmt: skip

    def pose(self, values: Mapping[str, Any]) -> np.ndarray:
        coordinates = {**self.parts, **values}
        distance, elevation, azimuth, roll = (coordinates[key] for key in self.parts)
        return (
            rotation_z(roll) @ translation(0, 0, distance) @ rotation_x(math.pi / 2 + elevation) @ rotation_z(azimuth)
        )


def _turned(angle: float, value: Value) -> float:
    """Return an angle by whole turns as near as can be to the middle of a value's range."""
    if isinstance(value, float):
        middle = value
    else:
        low, high = value.support
        middle = 0.5 * (low + high) if math.isfinite(low) and math.isfinite(high) else value.mean()
    return float(angle + 2 * math.pi * round((middle - angle) / (2 * math.pi)))


class Prior(ABC):
    """A probability distribution over scene graphs.

    The stock measure is the counting measure on structures (vertices in their order, edges, shape and contact types),
    times Lebesgue measure on each free number and Haar measure of total mass one on each free rotation.  Objects are
    told apart by their place in the graph, not by their name: names never change a density.
    """

    constraints: tuple[Term, ...] = ()  # terms that multiply the density; with them it is known up to a constant

    def sample(self, rng: np.random.Generator) -> SceneGraph:
        """Return one graph drawn from the prior."""
        return sample_until_allowed(rng, self.sample_unconstrained, self.constraints)

    @abstractmethod
    def sample_unconstrained(self, rng: np.random.Generator) -> SceneGraph:
        """Return one graph drawn by what its objects say alone, whatever the terms say of it."""

    def log_density(self, graph: SceneGraph) -> float:
        """Return log p(G), -inf where the prior is zero."""
        total = self.unconstrained_log_density(graph)
        return total + total_log_density(self.constraints, graph) if self.constraints and total > -math.inf else total

    @abstractmethod
    def unconstrained_log_density(self, graph: SceneGraph) -> float:
        """Return log p(G) by what its objects say alone."""

    @abstractmethod
    def free_addresses(self, graph: SceneGraph) -> dict[str, Distribution]:
        """Return the distribution of each free number given the structure of `graph`, by address.

        A free rotation is one address, ``NAME.contact.quat_wxyz``, with the distribution `uniform-rotation`.
        Fixed numbers are absent.  The product of these densities is the continuous part of p(G).
        """

    def log_orderings(self, graph: SceneGraph) -> float:
        """Return the log of the number of equally likely orders in which this prior could have listed the same objects.

        ``log_density + log_orderings`` is the density of the scene as a set of objects without an order.
        """
        return 0.0


@dataclass(frozen=True)
class TreeObject:
    """One named object."""

    name: str
    shape: ShapePrior
    contact: ContactPrior
    parent: str | Categorical = ROOT  # name of another object, "root", or a `Categorical` over such names
    supports: tuple[str, ...] = ()  # names of further objects on which it rests (a bridge)
    place: Node | None = None  # where it stands in its file

    @property
    def parents(self) -> tuple[str, ...]:
        return self.parent.choices if isinstance(self.parent, Categorical) else (self.parent,)


def in_order(objects: tuple[TreeObject, ...]) -> tuple[TreeObject, ...]:
    """Return the objects with every possible parent before its children, else as given.

    Raises DerenderError : a parent that is missing, or a cycle.
    """
    by_name = {item.name: item for item in objects}
    for item in objects:
        for parent in (*item.parents, *item.supports):
            if parent != ROOT and parent not in by_name:
                what = f"the parent {parent!r} of {item.name} is no object"
                raise fault(item.place, what, suggest(parent, [*by_name, ROOT]))
    sorter = TopologicalSorter({item.name: {*item.parents, *item.supports} - {ROOT} for item in objects})
    try:
        sorter.prepare()
    except CycleError as error:
        circle = " on ".join(reversed(error.args[1]))  # it names what comes before, we what stands on it
        what = f"the parents go round in a circle: {circle}"
        raise fault(by_name[error.args[1][0]].place, what, "let one rest on root or a floor") from None
    rank = {name: number for number, name in enumerate(by_name)}
    ordered: list[TreeObject] = []
    while sorter.is_active():
        ready = sorted(sorter.get_ready(), key=rank.__getitem__)
        ordered += [by_name[name] for name in ready]
        sorter.done(*ready)
    return tuple(ordered)


@dataclass(frozen=True)
class TreePrior(Prior):
    """Fixed objects under a root."""

    root: RootPrior  # prior on the root's pose
    objects: tuple[TreeObject, ...]  # sorted so that parents come first
    constraints: tuple[Term, ...] = ()  # terms that multiply the density; with them it is known up to a constant
    gravity: tuple[float, float, float] = (0.0, 0.0, -1.0)  # of the scenes, see `SceneGraph`
    by_name: Mapping[str, TreeObject] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "objects", in_order(self.objects))
        object.__setattr__(self, "by_name", {item.name: item for item in self.objects})
        self._check()

    def _check(self) -> None:
        """Build every contact table once, so that faults show when the file is read and not at the third draw."""
        tops: dict[str, set] = {ROOT: {None}}
        for item in self.objects:
            tops[item.name], own = set(), item.shape.type
            for parent in item.parents:
                shape = self.shape_of(parent)
                for top in tops[parent]:
                    found = item.contact.choices(shape, own, top)
                    if found is None:
                        wanted = " or ".join(sorted({rule.type for rule in item.contact.rules}))
                        what = f"no {wanted} contact with these faces holds a {own} on a {shape}"
                        can = [name for name in contacts if contacts[name].choices(shapes[shape], shapes[own])]
                        never = f"nothing holds it on {parent}: choose another parent"
                        raise fault(item.place, what, f"on {parent} it can have {', '.join(can)}" if can else never)
                    tops[item.name] |= {top_face(own, choice[0], choice[2]) for choice in found[0].choices}

    def shape_of(self, name: str) -> str:
        """Return the shape type of an object or the root."""
        return "frame" if name == ROOT else self.by_name[name].shape.type

    @property
    def fixed(self) -> bool:
        """Whether there is nothing left to choose: the prior is one scene."""
        return not self.root.free_addresses() and all(
            not isinstance(item.parent, Categorical)
            and not item.shape.free()
            and item.contact.fixed(self.shape_of(item.parent), item.shape.type)
            for item in self.objects
        )

    def sample_unconstrained(self, rng: np.random.Generator) -> SceneGraph:
        root_pose = self.root.sample(rng)
        vertices = tuple(self.sample_vertices(rng).values())
        return SceneGraph(root_pose=root_pose, vertices=vertices, gravity=self.gravity)

    def sample_vertices(self, rng: np.random.Generator) -> dict[str, Vertex]:
        """Return the objects' vertices by name, drawn in order."""
        vertices: dict[str, Vertex] = {}
        for item in self.objects:
            parent = item.parent.sample(rng) if isinstance(item.parent, Categorical) else item.parent
            drawn = draw_vertex(rng, item.name, item.shape, item.contact, parent, *seat(vertices, parent))
            vertices[item.name] = replace(drawn, supports=item.supports)
        return vertices

    def unconstrained_log_density(self, graph: SceneGraph) -> float:
        vertices = {vertex.name: vertex for vertex in graph.vertices}
        if vertices.keys() != self.by_name.keys():
            return -math.inf
        total = self.root.log_density(graph.root_pose)
        for item in self.objects:
            if total == -math.inf:
                return total
            total += self.object_log_density(item, vertices)
        return total

    def object_log_density(self, item: TreeObject, vertices: Mapping[str, Vertex]) -> float:
        """Return the log density of one object's parent, shape parameters and contact, given those before it."""
        vertex = vertices[item.name]
        if vertex.parent not in item.parents or tuple(vertex.supports) != item.supports:
            return -math.inf
        total = item.parent.log_density(vertex.parent) if isinstance(item.parent, Categorical) else 0.0
        return total + vertex_log_density(item.shape, item.contact, vertices, item.name)

    def free_addresses(self, graph: SceneGraph) -> dict[str, Distribution]:
        vertices = {vertex.name: vertex for vertex in graph.vertices}
        free = self.root.free_addresses()
        for item in self.objects:
            free.update(vertex_addresses(item.shape, item.contact, vertices, item.name))
        return free


def seat(vertices: Mapping[str, Vertex], parent: str) -> tuple[str, str | None]:
    """Return the shape type and the upward face of a parent."""
    if parent == ROOT:
        return "frame", None
    vertex = vertices[parent]
    return vertex.shape, top_face(vertex.shape, vertex.contact.type, vertex.contact.child_face)


def vertex_log_density(shape: ShapePrior, contact: ContactPrior, vertices: Mapping[str, Vertex], name: str) -> float:
    """Return the log density of one object's shape parameters and contact, given its parent; -inf of another shape."""
    vertex = vertices[name]
    if not shape.matches(vertex):
        return -math.inf
    parent_shape, top = seat(vertices, vertex.parent)
    return shape.log_density(vertex) + contact.log_density(vertex.contact, parent_shape, vertex.shape, top)


def vertex_addresses(
    shape: ShapePrior, contact: ContactPrior, vertices: Mapping[str, Vertex], name: str
) -> dict[str, Distribution]:
    """Return the distributions of one object's free numbers by address."""
    vertex = vertices[name]
    free = {f"{name}.{key}": value for key, value in shape.free().items()}
    parent_shape, top = seat(vertices, vertex.parent)
    for key, value in contact.free(vertex.contact, parent_shape, vertex.shape, top).items():
        free[f"{name}.contact.{key}"] = value
    return free
