"""Reading and writing a vertex's free numbers by (part, name), a rotation as one of them."""

import math
from collections.abc import Mapping
from dataclasses import replace

from derender.scene.contacts import contacts
from derender.scene.graph import SceneGraph, Vertex
from derender.scene.pose import from_quaternion, from_rotation_vector, quaternion
from derender.scene.priors.values import QUATERNION, ROTATION

Key = tuple[str, str]  # ("shape" or "contact", name of the number)


def read(vertex: Vertex, keys) -> dict[Key, float | tuple[float, ...]]:
    """Return a vertex's numbers by key; those that the vertex leaves out are 0."""
    found: dict[Key, float | tuple[float, ...]] = {}
    for part, name in keys:
        if part == "shape":
            found[part, name] = vertex.parameters[name]
        elif name == QUATERNION:
            found[part, name] = tuple(vertex.contact.values[key] for key in ROTATION)
        else:
            found[part, name] = vertex.contact.values.get(name, 0.0)
    return found


def write(vertex: Vertex, numbers: Mapping[Key, float | tuple[float, ...]]) -> Vertex:
    """Return the vertex with numbers changed."""
    parameters, values = dict(vertex.parameters), dict(vertex.contact.values)
    for (part, name), value in numbers.items():
        if part == "shape":
            parameters[name] = value  # type: ignore[assignment]
        elif name == QUATERNION:
            values.update(zip(ROTATION, map(float, value), strict=True))  # type: ignore[arg-type]
        else:
            values[name] = value  # type: ignore[assignment]
    return replace(vertex, parameters=parameters, contact=replace(vertex.contact, values=values))


def unit_of(graph: SceneGraph, vertex: Vertex, key: Key) -> str:
    """Return "m", "rad" or "" for a number of a vertex."""
    part, name = key
    if part == "shape":
        return next(p.unit for p in vertex.body.shape.parameters if p.name == name)
    if name == QUATERNION:
        return "rad"
    faces = vertex.contact.parent_face, vertex.contact.child_face
    known = contacts[vertex.contact.type].parameters(graph.body(vertex.parent).shape, vertex.body.shape, *faces)
    return next(p.unit for p in known if p.name == name)


def moved(value, step, law):
    """Return a number shifted by `step`, on a circle where it is an angle over one; a rotation turned by a vector (3,).

    Both keep the stock measure and are undone by the opposite step.
    """
    if isinstance(value, tuple):
        return tuple(map(float, quaternion(from_quaternion(value) @ from_rotation_vector(step))))
    new = value + step
    if law.name in ("uniform", "von-mises"):
        low, high = law.support
        if any(abs(high - low - math.tau / order) < 1e-9 for order in (1, 2, 4)):
            new = low + (new - low) % (high - low)
    return new
