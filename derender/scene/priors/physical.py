"""What an object may say besides its geometry: what it is made of, how it moves, whether it is fixed.

    red: {shape: ..., density: 700, friction: {uniform: [0.2, 0.6]}, elasticity: 0.3, velocity: [0.5, 0, 0]}

An image says nothing of these, so that they are no unknowns of inference: a distribution is kept as it is written, and
drawn from wherever the scene is sampled or simulated.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from derender.registry import Parameter
from derender.scene.codec.yaml_tree import Node, Section
from derender.scene.distributions import Distribution, distributions
from derender.scene.graph import SceneGraph
from derender.scene.priors.reading import read_value
from derender.scene.priors.values import check_range

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
