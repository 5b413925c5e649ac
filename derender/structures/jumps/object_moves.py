"""The moves: an object's free numbers drawn anew from the prior, or shifted by normal steps; birth and death."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from derender.scene.contacts import contacts
from derender.scene.distributions import Distribution
from derender.scene.graph import ROOT, SceneGraph, Vertex
from derender.scene.pose import from_quaternion, from_rotation_vector, quaternion
from derender.scene.priors.values import QUATERNION, ROTATION
from derender.structures.jumps.base import Applied, Move, Vocabulary, log_uniform_choice, moves

Key = tuple[str, str]  # ("shape" or "contact", name of the number)


def read(vertex: Vertex, keys: dict[tuple[str, str], float]) -> dict[Key, float | tuple[float, ...]]:
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


def moved(value: Any, step: float, law: Distribution) -> Any:
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


class Numbers(NamedTuple):
    """name : of the object; part : "shape" or "contact"; values : the new numbers by key."""

    name: str
    part: str
    values: dict


@moves.register("resimulate")
class Resimulate(Move):
    """Draw all free numbers of one object's contact, or of its shape, from their priors.

    Scene and choices exchange numbers:
    log ratio = log posterior(G') - log posterior(G) + log p(old numbers) - log p(new numbers).
    """

    weight = 1.0

    def _blocks(self, words: Vocabulary, graph: SceneGraph) -> list[tuple[str, str]]:
        return [
            (name, part)
            for name in graph.names
            for part in ("shape", "contact")
            if any(key[0] == part for key in words.free_numbers(graph, name))
        ]

    def draw(self, rng: np.random.Generator, words: Any, graph: SceneGraph) -> Any:
        blocks = self._blocks(words, graph)
        if not blocks:
            return None
        name, part = blocks[int(rng.random() * len(blocks))]
        laws = words.free_numbers(graph, name)
        return Numbers(name, part, {key: law.sample(rng) for key, law in laws.items() if key[0] == part})

    def log_choice(self, words: Any, graph: SceneGraph, choice: Any) -> float:
        laws = words.free_numbers(graph, choice.name)
        total = log_uniform_choice(len(self._blocks(words, graph)))
        return total + sum(laws[key].log_density(value) for key, value in choice.values.items())

    def apply(self, words: Any, graph: SceneGraph, choice: Any) -> Applied | None:
        vertex = graph.vertex(choice.name)
        back = Numbers(choice.name, choice.part, read(vertex, choice.values))
        new = write(vertex, choice.values)
        vertices = tuple(new if other is vertex else other for other in graph.vertices)
        return Applied(replace(graph, vertices=vertices), back)


SHORTEST, LONGEST = 5e-5, 0.03  # metres of a step; drawn evenly in its logarithm
ARM = 0.05  # metres: a turn is a step's length over an arm of a typical object


class Shift(NamedTuple):
    """name : of the object or "root"; scale : metres; steps : by key, numbers or (3,) rotation vectors."""

    name: str
    scale: float
    steps: dict


@moves.register("wiggle")
class Wiggle(Move):
    """Shift some numbers of one object by normals of a random scale; all that stands on it rides along.

    Choices: the object; a scale, evenly in its logarithm; all its numbers or one of them; the steps. Back are the
    opposite steps of the same scale: normals are even and circles and rotations have no boundary, so the q cancel; a
    shift keeps lengths, a turn Haar's measure.
    """

    weight = 12.0
    even = True

    def objects(self, words: Vocabulary, graph: SceneGraph) -> list[str]:
        """Return the names of what has free numbers, the root's pose among them."""
        names = [name for name in graph.names if words.free_numbers(graph, name)]
        return ([ROOT] if words.prior.root.free_addresses() else []) + names

    def laws(self, words: Vocabulary, graph: SceneGraph, name: str) -> Any:
        """Return the prior of each number that may shift."""
        if name == ROOT:
            return {("root", key): law for key, law in words.prior.root.free_addresses().items()}
        return words.free_numbers(graph, name)

    def draw(self, rng: np.random.Generator, words: Any, graph: SceneGraph) -> Any:
        names = self.objects(words, graph)
        if not names:
            return None
        return self.steps_of(rng, words, graph, names[int(rng.random() * len(names))])

    def steps_of(self, rng: np.random.Generator, words: Vocabulary, graph: SceneGraph, name: Any) -> Shift:
        """Return steps for the numbers of one object."""
        scale = SHORTEST * (LONGEST / SHORTEST) ** rng.random()
        keys = list(self.laws(words, graph, name))
        if rng.random() < 0.5:
            keys = [keys[int(rng.random() * len(keys))]]
        steps = {}
        for key in keys:
            width = _width(graph, name, key, scale)
            turn = key[1].endswith(QUATERNION)
            steps[key] = width * rng.standard_normal(3) if turn else width * float(rng.standard_normal())
        return Shift(name, scale, steps)

    def log_choice(self, words: Any, graph: SceneGraph, choice: Any) -> float:
        laws = self.laws(words, graph, choice.name)
        if choice.name not in self.objects(words, graph) or not set(choice.steps) <= set(laws):
            return -math.inf
        total = log_uniform_choice(len(self.objects(words, graph)))
        for key, step in choice.steps.items():
            width = _width(graph, choice.name, key, choice.scale)
            total -= float(np.sum(0.5 * (np.asarray(step) / width) ** 2 + math.log(width)))
        ways = 0.5 * (len(choice.steps) == len(laws)) + 0.5 * (len(choice.steps) == 1) / len(laws)
        return total + math.log(ways) if ways > 0.0 else -math.inf

    def apply(self, words: Any, graph: SceneGraph, choice: Any) -> Applied | None:
        back = Shift(choice.name, choice.scale, {key: -step for key, step in choice.steps.items()})
        laws = self.laws(words, graph, choice.name)
        if choice.name == ROOT:
            values = dict(words.prior.root.values(graph.root_pose))
            for (_, address), step in choice.steps.items():
                values[address] = moved(values[address], step, laws["root", address])
            return Applied(replace(graph, root_pose=words.prior.root.pose(values)), back)
        vertex = graph.vertex(choice.name)
        old = read(vertex, choice.steps)
        new = {key: moved(old[key], step, laws[key]) for key, step in choice.steps.items()}
        if any(key[0] == "shape" and not value > 1e-6 for key, value in new.items()):
            return None
        shifted = write(vertex, new)
        return Applied(replace(graph, vertices=tuple(shifted if v is vertex else v for v in graph.vertices)), back)


def _width(graph: SceneGraph, name: str, key: tuple[str, str], scale: float) -> float:
    """Return the standard deviation of a step of a number: metres, or the turn or share that moves a solid so far."""
    if name == ROOT:
        return scale if key[1] in ("root.x", "root.y", "root.z", "root.distance") else scale / (10.0 * ARM)
    return scale if unit_of(graph, graph.vertex(name), key) == "m" else scale / ARM


class Birth(NamedTuple):
    """vertex : to be added."""

    vertex: Vertex


class Death(NamedTuple):
    """name : of the leaf to be removed."""

    name: str


@moves.register("birth-death")
class BirthDeath(Move):
    """With probability one half each: add an object drawn from the proposal b, or remove one leaf of the l there are.

    The choices of a birth are the new vertex itself, so the map only moves numbers between scene and choices:

        birth: log ratio = log posterior(G + v) - log posterior(G) - log l(G + v) - log b(v | G)
        death: the negative, with the vertex removed in place of v.
    """

    weight = 3.0

    def draw(self, rng: np.random.Generator, words: Any, graph: Any) -> Any:
        if rng.random() < 0.5:
            vertex = words.proposal.sample(rng, words, graph)
            return None if vertex is None else Birth(vertex)
        leaves = words.leaves(graph)
        return Death(leaves[int(rng.random() * len(leaves))]) if leaves else None

    def log_choice(self, words: Any, graph: Any, choice: Any) -> float:
        if isinstance(choice, Birth):
            return math.log(0.5) + words.proposal.log_density(words, graph, choice.vertex)
        leaves = words.leaves(graph)
        return math.log(0.5) + log_uniform_choice(len(leaves)) if choice.name in leaves else -math.inf

    def apply(self, words: Any, graph: Any, choice: Any) -> Applied | None:
        if isinstance(choice, Birth):
            return Applied(graph.add(choice.vertex), Death(choice.vertex.name))
        return Applied(graph.remove(choice.name), Birth(graph.vertex(choice.name)))
