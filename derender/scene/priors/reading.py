"""Reading numbers, distributions, shapes, contacts, and what objects are made of, from the nodes of a scene file.

    red: {shape: ..., density: 700, friction: {uniform: [0.2, 0.6]}, elasticity: 0.3, velocity: [0.5, 0, 0]}

An image says nothing of such numbers, so that they are no unknowns of inference: a distribution is kept as it is
written, and drawn from wherever the scene is sampled or simulated.
"""

import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from derender.errors import DerenderError, at_fault
from derender.registry import Parameter, suggest
from derender.scene.codec.yaml_tree import List, Node, Section
from derender.scene.contacts import contacts
from derender.scene.distributions import Categorical, Distribution, distributions
from derender.scene.graph import SceneGraph
from derender.scene.priors.objects import (
    ON,
    QUATERNION,
    RESTING,
    ROTATION,
    TOP,
    ContactRule,
    ShapePrior,
    Value,
    check_range,
)
from derender.scene.shapes import shapes


def read_value(node: Node, unit: str = "") -> Value:
    """Read a number in `unit`, or a distribution over it such as {uniform: [0, 90 deg]}."""
    if not isinstance(node, Section):
        return node.number(unit)
    distribution = read_distribution(node, unit)
    if not isinstance(distribution, Distribution) or distribution.discrete or distribution.size != 1:
        raise node.fault(
            f"{distribution.name} is no distribution over a length, an angle or a share", "see derender types"
        )
    return distribution


def read_distribution(node: Node, unit: str = "") -> Any:
    """Read {name: parameters}; the parameters are a list, one number, or {name: number}."""
    name, detail = node.section().only()
    if name not in distributions:
        raise node.fault(f"no distribution is called {name!r}", suggest(name, distributions))
    kind = distributions[name]
    if name == "categorical":
        raise node.fault("here stands a choice, not a number", "give a distribution over numbers, such as uniform")
    if isinstance(detail, Section):
        detail.allow(*kind.names)
        given = [detail.get(key) for key in kind.names]
        while given and given[-1] is None:
            given.pop()
        nodes = [detail[key] if item is None else item for key, item in zip(kind.names, given, strict=False)]
    elif isinstance(detail, List):
        nodes = detail.sequence()
    else:
        nodes = [] if detail.plain() is None else [detail]
    units = ["" if key in kind.dimensionless else unit for key in kind.names]
    numbers = [item.number(units[k] if k < len(units) else "") for k, item in enumerate(nodes)]
    with at_fault(detail.where):
        return kind(*numbers)


def read_categorical(node: Node, choices: Iterable[str] | None = None) -> Categorical:
    """Read {categorical: {choice: weight}} or {categorical: [choice, ...]}."""
    name, detail = node.section().only()
    if name != "categorical":
        raise node.fault(f"{name!r} is no distribution over choices", "write {categorical: {a: 0.5, b: 0.5}}")
    choices = list(choices) if choices is not None else None
    weights: dict[str, float] = {}
    if isinstance(detail, Section):
        for key, item in detail.items():
            if choices is not None and key not in choices:
                raise item.fault(f"{key!r} is no choice here", suggest(key, choices))
            weights[key] = item.number(lower=0.0)
    else:
        for item in detail.sequence():
            weights[item.text(choices)] = 1.0
    with at_fault(detail.where):
        return Categorical(weights)


def read_count(node: Node) -> Any:
    """Read a whole number, or a distribution over whole numbers from 0 up: how many."""
    if not isinstance(node, Section):
        return Categorical({node.integer(lower=0, upper=1000): 1.0})
    name, detail = node.section().only()
    if name == "categorical":
        weights = {}
        for key, item in detail.section().items():
            if not key.isdigit() or int(key) > 1000:
                raise item.fault(f"{key!r} is no number of objects", "write {0: 0.5, 1: 0.5}")
            weights[int(key)] = item.number(lower=0.0)
        with at_fault(detail.where):
            return Categorical(weights)
    count = read_distribution(node)
    if not count.discrete or count.support[0] < 0:
        raise node.fault(
            f"{name} is no distribution over how many", "use poisson, geometric, uniform-integer, categorical"
        )
    if count.mean() > 1000:
        raise node.fault(f"{count.mean():g} objects on average are too many", "stay below 1000")
    return count


def read_shape(node: Node, folder: Path, extra: tuple[str, ...] = (), name: str | None = None) -> ShapePrior:
    """Read a shape: its name, or {type: name, parameter: number or distribution, option: ...}.

    `extra` are keys that the caller reads itself; `name` stands in for `type` where that is left out.
    """
    if isinstance(node, Section):
        kind, other = node["type"].text(shapes) if "type" in node or name is None else name, ", or give its type"
    else:
        kind, other = node.text(shapes) if node.plain() is not None or name is None else name, ""
        node = Section(node.file, node.line, node.address)
    if kind not in shapes:
        raise node.fault(f"no shape is called {kind!r}", suggest(kind, shapes) + other)
    shape = shapes[kind]
    names = [parameter.name for parameter in shape.parameters]
    node.allow("type", *names, *shape.options, *extra)
    values: dict[str, Value] = {}
    for parameter in shape.parameters:
        item = node.get(parameter.name)
        if item is not None:
            values[parameter.name] = read_value(item, parameter.unit)
            check_range(values[parameter.name], parameter, item, strict=True)
        elif parameter.default is None:
            raise node.fault(f"the {parameter.name} of the {kind} is missing", f"add {parameter.name}: 0.1 or so")
    options = {key: _option(key, node[key], folder) for key in shape.options if key in node}
    if "file" in shape.options and "file" not in options:
        raise node.fault(f"a {kind} needs its file", "add file: PATH")
    if shape.options:
        try:
            shape.check([parameter.default or 1.0 for parameter in shape.parameters], options)  # reads a mesh
        except DerenderError as error:
            place = next((node[key] for key in shape.options if key in node), node)
            what = f"{error.where or options['file']}: {error.what}" if "file" in options else error.what
            raise place.fault(what, error.remedy) from None
    return ShapePrior(kind, values, options)


def _option(key: str, node: Node, folder: Path) -> Any:
    if key == "file":
        if "\0" in node.text():
            raise node.fault("the path holds a null character", "write the path of a mesh")
        return os.path.realpath(folder / node.text())
    if key == "hull":
        return node.boolean()
    return node.plain()


def read_rules(node: Node, name: str | None = None) -> tuple[ContactRule, ...]:
    """Read one contact of an open-universe prior: a rule, or for `on` one for each way to rest on the parent's top."""
    if not isinstance(node, Section):
        if node.plain() is not None:
            raise node.fault("here stands no section", "write {} or {parent_face: +z, ...}")
        node = Section(node.file, node.line, node.address)
    kind = node["type"].text([*contacts, ON]) if "type" in node or name is None else name
    if kind not in contacts and kind != ON:
        raise node.fault(f"no contact is called {kind!r}", suggest(kind, [*contacts, ON]) + ", or give its type")
    values, places = read_contact_values(node, kind, ("type", "weight", "parents", "children"))
    parents, children = (_names(node.get(key)) for key in ("parents", "children"))
    weight = node["weight"].number(lower=0.0, upper=1e6) if "weight" in node else 1.0
    on, by = (read_face(node.get(key)) for key in ("parent_face", "child_face"))
    on = TOP if kind == ON and on is None else on
    rule = ContactRule(kind, weight, on, by, values, parents, children, True, {**places, "": node})
    return tuple(replace(rule, type=each) for each in RESTING) if kind == ON else (rule,)


def _names(node: Node | None) -> tuple[str, ...] | None:
    return None if node is None else tuple(item.text(shapes) for item in node.sequence())


def read_face(node: Node | None) -> Any:
    """Read a face: None where nothing is said, a name, or a categorical over names."""
    if node is None:
        return None
    return read_categorical(node) if isinstance(node, Section) else node.text()


def read_contact_values(node: Section, kind: str, extra: tuple[str, ...]) -> tuple[dict[str, Any], dict[str, Node]]:
    """Read the numbers of a contact, each with its place; refuse keys that no contact of this kind has."""
    known = contact_parameters(kind)
    keys = [key for key in known if key not in ROTATION]
    rotation = [QUATERNION, "position"] if ROTATION[0] in known else []
    node.allow("parent_face", "child_face", *extra, *keys, *rotation)
    values: dict[str, Any] = {}
    places: dict[str, Node] = {}
    for key in keys:
        if key in node:
            values[key], places[key] = read_value(node[key], known[key].unit), node[key]
    if "position" in node:
        for key, item in zip("xyz", node["position"].sequence(3), strict=True):
            if key in values:
                raise item.fault(f"both position and {key} are given", "give one of them")
            values[key], places[key] = read_value(item, "m"), item
    if QUATERNION in node:
        values[QUATERNION] = read_rotation(node[QUATERNION])
    return values, places


def read_rotation(node: Node) -> Any:
    """Read four numbers [w, x, y, z] or `uniform-rotation`."""
    if isinstance(node, List):
        parts = [item.number() for item in node.sequence(4)]
        norm = math.sqrt(math.fsum(part * part for part in parts))
        if not abs(norm - 1.0) < 0.01:
            raise node.fault(f"the quaternion has length {norm:.3g}", "give a unit quaternion [w, x, y, z]")
        return tuple(parts) if abs(norm - 1.0) < 1e-12 else tuple(part / norm for part in parts)
    if isinstance(node, Section):
        name, _ = node.only()
        if name != "uniform-rotation":
            raise node.fault(f"{name!r} is no distribution over rotations", "write uniform-rotation")
    else:
        node.text(["uniform-rotation"])
    return distributions["uniform-rotation"]()


@cache
def contact_parameters(kind: str) -> dict[str, Parameter]:
    """Return every parameter that contacts of a kind have for some pair of shapes, by name."""
    found: dict[str, Parameter] = {}
    for each in RESTING if kind == ON else (kind,):
        for parent in shapes:
            for child in shapes:
                for faces in contacts[each].choices(shapes[parent], shapes[child])[:1]:
                    for parameter in contacts[each].parameters(shapes[parent], shapes[child], *faces):
                        found.setdefault(parameter.name, parameter)
    return found


NUMBERS = {
    "mass": Parameter("mass", "kg", 1e-9, 1e9),
    "density": Parameter("density", "", 1e-6, 1e9),  # kg / m^3
    "friction": Parameter("friction", "", 0.0, 1e3),
    "elasticity": Parameter("elasticity", "", 0.0, 0.99),
}
# Velocities in the axes of the root, per second.
VECTORS = {"velocity": "m", "angular_velocity": "rad"}
PHYSICAL = (*NUMBERS, *VECTORS, "fixed")


def read_physical(node: Node) -> dict[str, Any]:
    """Read what an object is made of and how it moves, as plain data; {} where nothing is said."""
    if not isinstance(node, Section):
        return {}
    if "mass" in node and "density" in node:
        raise node["density"].fault("both mass and density are given", "give one of them")
    found: dict[str, Any] = {}
    for key, parameter in NUMBERS.items():
        if key in node:
            value = read_value(node[key], parameter.unit)
            check_range(value, parameter, node[key])
            found[key] = _plain(value)
    for key, unit in VECTORS.items():
        if key in node:
            found[key] = [_plain(read_value(item, unit)) for item in node[key].sequence(3)]
    if "fixed" in node:
        found["fixed"] = node["fixed"].boolean()
    return found


def drawn(options: Mapping[str, Any], rng: np.random.Generator | None) -> dict[str, Any]:
    """Return an object's options with numbers in place of distributions: draws, or their means without `rng`."""
    found = dict(options)
    for key in (*NUMBERS, *VECTORS):
        if key in found:
            value = found[key]
            is_vector = isinstance(value, list | tuple)
            found[key] = [_number(item, rng) for item in value] if is_vector else _number(value, rng)
    return found


def is_drawn(options: Mapping[str, Any]) -> bool:
    """Return whether one of an object's physical numbers is a distribution."""
    values = [options[key] for key in (*NUMBERS, *VECTORS) if key in options]
    flat = [item for value in values for item in (value if isinstance(value, list) else [value])]
    return any(isinstance(item, Mapping) for item in flat)


def with_drawn_matter(graph: SceneGraph, rng: np.random.Generator) -> SceneGraph:
    """Return the graph with every mass, friction ... drawn."""
    return replace(graph, vertices=tuple(replace(v, options=drawn(v.options, rng)) for v in graph.vertices))


def _plain(value: float | Distribution) -> Any:
    return {value.name: list(value.parameters)} if isinstance(value, Distribution) else value


def _number(value: Any, rng: np.random.Generator | None) -> float:
    if not isinstance(value, Mapping):
        return float(value)
    ((name, parameters),) = value.items()
    distribution = distributions[name](*parameters)
    return float(distribution.mean() if rng is None else distribution.sample(rng))  # type: ignore[union-attr]
