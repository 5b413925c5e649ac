"""Priors on shape parameters, p_s(psi)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from derender.scene.codec.yaml_tree import Node
from derender.scene.distributions import Distribution
from derender.scene.graph import Vertex
from derender.scene.priors.values import Value, check_range, default_value, draw, fault, log_density
from derender.scene.shapes import shapes


@dataclass(frozen=True)
class ShapePrior:
    """A shape type, what is fixed about it, and the distribution of its parameters.

    Attributes
    ----------
    type : name of a registered shape.
    values : number or distribution by parameter name; one that is left out takes its default, which must exist.
    options : what is no number: a mesh's file, mass, friction.
    weight : relative probability among the shapes of an open-universe prior.
    """

    type: str
    values: Mapping[str, Value] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    weight: float = 1.0
    _table: tuple[tuple[str, Value], ...] = field(init=False, repr=False, compare=False)
    _identity: tuple = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        table = []
        known = {parameter.name for parameter in shapes[self.type].parameters}
        for name in self.values:
            if name not in known:
                raise fault(None, f"the shape {self.type} has no parameter {name!r}")
        for parameter in shapes[self.type].parameters:
            value = self.values.get(parameter.name, parameter.default)
            if value is None:
                value = default_value(parameter)
            if value is None:
                raise fault(None, f"the {parameter.name} of the {self.type} is missing")
            value = float(value) if isinstance(value, int | float) else value
            check_range(value, parameter, strict=True)
            table.append((parameter.name, value))
        object.__setattr__(self, "_table", tuple(table))
        object.__setattr__(self, "_identity", identity(self.options))

    def sample(self, rng) -> dict[str, float]:
        """Return a draw of psi by name."""
        return {name: draw(value, rng) for name, value in self._table}

    def matches(self, vertex: Vertex) -> bool:
        """Say whether a vertex is of this shape type and, for a mesh, of the same mesh."""
        return vertex.shape == self.type and identity(vertex.options) == self._identity

    def log_density(self, vertex: Vertex) -> float:
        """Return log p_s(psi) of a vertex that `matches`."""
        total = 0.0
        parameters = vertex.parameters
        for name, value in self._table:
            if name not in parameters:
                return -math.inf
            total += log_density(value, parameters[name])
        return total

    def free(self) -> dict[str, Distribution]:
        """Return the distributions among the values, by parameter name."""
        return {name: value for name, value in self._table if isinstance(value, Distribution)}


def draw_vertex(rng, name: str, prior: ShapePrior, contacts, parent: str, shape: str, top: str | None) -> Vertex:
    """Return a new object, its numbers and its contact drawn.

    contacts : the ContactPrior; shape, top : type and upper face of what it hangs on, see `tree.seat`.
    """
    parameters = prior.sample(rng)
    contact = contacts.sample(rng, shape, prior.type, top)
    return Vertex(name, prior.type, parameters, parent, contact, dict(prior.options))


def identity(options: Mapping[str, Any]) -> tuple:
    """Return what tells two meshes apart; masses and colours do not."""
    return (str(options["file"]), bool(options.get("hull", True))) if "file" in options else ()


def check_places(shape: str, values: Mapping[str, Value], places: Mapping[str, Node]) -> None:
    """Check values against the ranges of a shape's parameters, with the place of each in its file."""
    for parameter in shapes[shape].parameters:
        if parameter.name in values:
            check_range(values[parameter.name], parameter, places.get(parameter.name), strict=True)
