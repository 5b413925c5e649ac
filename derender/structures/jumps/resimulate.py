"""Moves of one object's free numbers: drawn anew from the prior, or by a normal step."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from derender.scene.contacts import contacts
from derender.scene.distributions import Distribution
from derender.scene.graph import ROOT, SceneGraph, Vertex
from derender.scene.pose import from_quaternion, from_rotation_vector, inverse, quaternion
from derender.scene.priors.values import QUATERNION, ROTATION
from derender.structures.jumps.base import Applied, Move, Vocabulary, log_uniform_choice, moves
from derender.structures.jumps.charts import LINE, TILTED, all_numbers, log_pose_element

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

    Scene and choices exchange numbers, J = 1:
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
        return Applied(replace(graph, vertices=vertices), back, 0.0)


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
    shift has Jacobian one, a turn keeps Haar's measure.
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
            return Applied(replace(graph, root_pose=words.prior.root.pose(values)), back, 0.0)
        vertex = graph.vertex(choice.name)
        old = read(vertex, choice.steps)
        new = {key: moved(old[key], step, laws[key]) for key, step in choice.steps.items()}
        if any(key[0] == "shape" and not value > 1e-6 for key, value in new.items()):
            return None
        return self.place(words, graph, write(vertex, new), back)

    def place(self, words: Vocabulary, graph: SceneGraph, vertex: Vertex, back: Shift) -> Applied | None:
        """Return the scene with the vertex in its new place."""
        vertices = tuple(vertex if other.name == vertex.name else other for other in graph.vertices)
        return Applied(replace(graph, vertices=vertices), back, 0.0)


def _width(graph: SceneGraph, name: str, key: tuple[str, str], scale: float) -> float:
    """Return the standard deviation of a step of a number: metres, or the turn or share that moves a solid so far."""
    if name == ROOT:
        return scale if key[1] in ("root.x", "root.y", "root.z", "root.distance") else scale / (10.0 * ARM)
    return scale if unit_of(graph, graph.vertex(name), key) == "m" else scale / ARM


@moves.register("slide")
class Slide(Wiggle):
    """Shift one object in its contact while what stands on it stays where it is in the world.

    As `wiggle`, of the contact's numbers alone, of objects that carry something. Each child's numbers become those of
    the same pose on the moved face, for fixed steps a bijection:
    log J = sum over children of log d(pose)/d(numbers) before - the same after (see `charts`), the rest unchanged.
    """

    weight = 2.0

    def objects(self, words: Vocabulary, graph: SceneGraph) -> list[str]:
        carried = {vertex.parent for vertex in graph.vertices if vertex.contact.type in TILTED + LINE}
        return [name for name in words.grown(graph) if name in carried and self.laws(words, graph, name)]

    def laws(self, words: Vocabulary, graph: SceneGraph, name: str) -> Any:
        return {key: law for key, law in words.free_numbers(graph, name).items() if key[0] == "contact"}

    def place(self, words: Any, graph: Any, vertex: Any, back: Any) -> Applied | None:
        alone = replace(graph, vertices=tuple(vertex if o.name == vertex.name else o for o in graph.vertices))
        poses, total, changed = graph.poses(), 0.0, {}
        moved_pose = alone.poses()[vertex.name]
        for name in graph.children(vertex.name):
            child = graph.vertex(name)
            contact, body, parent = child.contact, child.body, vertex.body
            table, faces = words.table_of(graph, child), (contact.parent_face, contact.child_face)
            if table is None or contact.type not in TILTED + LINE:
                return None
            before = all_numbers(contact, parent.shape, body.shape)
            found = contacts[contact.type].invert(inverse(moved_pose) @ poses[name], parent, body, *faces)
            if found.outside > 1e-9 or found.angle > 1e-9:
                return None
            after = dict(found.values)
            values = dict(contact.values)
            for key, value in after.items():
                law = table.get(key)
                if isinstance(law, Distribution):
                    values[key] = moved(value, 0.0, law)
                    if key == "theta" and abs(math.remainder(values[key] - value, math.tau)) > 1e-9:
                        return None  # folding would turn the child's axes
                    after[key] = values[key]
                elif key not in ("theta", "roll") and abs(value - before[key]) > 1e-9:
                    return None  # the contact would no longer hold
                elif key in ("theta", "roll"):
                    after[key] = value
            total += log_pose_element(contact.type, before, parent, body, faces)
            total -= log_pose_element(contact.type, after, parent, body, faces)
            changed[name] = replace(child, contact=replace(contact, values=values))
        vertices = tuple(changed.get(other.name, other) for other in alone.vertices)
        return Applied(replace(alone, vertices=vertices), back, total)
