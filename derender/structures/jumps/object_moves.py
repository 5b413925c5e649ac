"""The moves: an object's free numbers drawn anew from the prior, or shifted by normal steps; birth and death.

Numbers, and how one steps among them, are those of a scene of fixed structure (`posterior/target.py`).
"""

import math
from typing import Any, NamedTuple

import numpy as np

from derender.posterior.space import Block, Space
from derender.scene.graph import SceneGraph, Vertex
from derender.structures.jumps.base import Applied, Move, Vocabulary, log_uniform_choice, moves


def ranges(ends: np.ndarray, members: tuple[int, ...]) -> np.ndarray:
    """Return the places of some unknowns among values (ends = Space.offsets) or tangents (Space.directions)."""
    return np.concatenate([np.arange(ends[i], ends[i + 1]) for i in members])


class Numbers(NamedTuple):
    """block : of the space, such as "red.contact"; values : its new ones."""

    block: str
    values: tuple[float, ...]


@moves.register("resimulate")
class Resimulate(Move):
    """Draw all free numbers of one object's contact, or of its shape, from their priors.

    Scene and choices exchange numbers:
    log ratio = log posterior(G') - log posterior(G) + log p(old numbers) - log p(new numbers).
    """

    def draw(self, rng: np.random.Generator, words: Vocabulary, graph: SceneGraph) -> Numbers | None:
        target = words.coordinates(graph)
        if target is None:
            return None
        block = target.space.blocks[int(rng.random() * len(target.space.blocks))]
        values = target.values(graph)
        for i in block.unknowns:
            target.space.resample(rng, values, i)
        return Numbers(block.name, tuple(values[ranges(target.space.offsets, block.unknowns)].tolist()))

    def log_choice(self, words: Vocabulary, graph: SceneGraph, choice: Numbers) -> float:
        space: Space = words.coordinates(graph).space
        total, at = log_uniform_choice(len(space.blocks)), 0
        for i in space.block(choice.block).unknowns:
            law = space.unknowns[i].distribution
            total += law.log_density(choice.values[at] if law.size == 1 else choice.values[at : at + law.size])
            at += law.size
        return total

    def apply(self, words: Vocabulary, graph: SceneGraph, choice: Numbers) -> Applied:
        target = words.coordinates(graph)
        old = target.values(graph)
        new, places = old.copy(), ranges(target.space.offsets, target.space.block(choice.block).unknowns)
        new[places] = choice.values
        return Applied(target.graph(new), choice._replace(values=tuple(old[places].tolist())))


SHORTEST, LONGEST = 3e-4, 0.3  # of the prior's spread: length of a step, drawn evenly in its logarithm


class Shift(NamedTuple):
    """name : of the object or "root"; members : its unknowns; share : of the prior's spread; tangent : the step."""

    name: str
    members: tuple[int, ...]
    share: float
    tangent: np.ndarray


@moves.register("wiggle")
class Wiggle(Move):
    """Shift some numbers of one object by normals of a random scale; all that stands on it rides along.

    Choices: the object, or the root; a scale, evenly in its logarithm; all its numbers or one of them; the steps. Back
    are the opposite steps of the same scale: normals are even and circles and rotations have no boundary, so the q
    cancel; a shift keeps lengths, a turn Haar's measure.
    """

    weight = 12.0
    even = True

    def objects(self, space: Space) -> dict[str, tuple[int, ...]]:
        """Return the unknowns of each object, and of the root, by name."""
        found: dict[str, tuple[int, ...]] = {}
        for i, unknown in enumerate(space.unknowns):
            name = unknown.address.partition(".")[0]
            found[name] = (*found.get(name, ()), i)
        return found

    def draw(self, rng: np.random.Generator, words: Vocabulary, graph: SceneGraph) -> Shift | None:
        target = words.coordinates(graph)
        if target is None:
            return None
        space, objects = target.space, list(self.objects(target.space).items())
        name, members = objects[int(rng.random() * len(objects))]
        share = SHORTEST * (LONGEST / SHORTEST) ** rng.random()
        if rng.random() < 0.5:
            members = (members[int(rng.random() * len(members))],)
        spread = space.scales[ranges(space.directions, members)]
        return Shift(name, members, share, share * spread * rng.standard_normal(len(spread)))

    def log_choice(self, words: Vocabulary, graph: SceneGraph, choice: Shift) -> float:
        space: Space = words.coordinates(graph).space
        objects = self.objects(space)
        width = choice.share * space.scales[ranges(space.directions, choice.members)]
        ways = 0.5 * (choice.members == objects[choice.name]) + 0.5 * (len(choice.members) == 1) / len(
            objects[choice.name]
        )
        return (
            log_uniform_choice(len(objects))
            + math.log(ways)
            - float(np.sum(0.5 * (choice.tangent / width) ** 2 + np.log(width)))
        )

    def apply(self, words: Vocabulary, graph: SceneGraph, choice: Shift) -> Applied:
        target = words.coordinates(graph)
        moved = target.space.move(target.values(graph), Block("", choice.members), choice.tangent)
        return Applied(target.graph(moved), choice._replace(tangent=-choice.tangent))


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
