"""Jumps between trees: reparent, an object hung elsewhere where it is in the world; birth, death, exchange."""

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from derender.scene.graph import SceneGraph, Vertex
from derender.scene.shapes import shapes
from derender.structures.jumps.base import Applied, Move, Vocabulary, log_uniform_choice, moves
from derender.structures.jumps.charts import OwnChart, Rest, draw_rest, log_rest
from derender.structures.jumps.reparametrise import (
    Slot,
    allowed,
    carry,
    group,
    hung_from,
    release,
    renamed,
    same_freedom,
    slot_of,
    table_of,
)

if TYPE_CHECKING:
    from derender.structures.jumps.reparametrise import PosedBox


class Rehang(NamedTuple):
    """name : the object; slot : where to; rest : what its present numbers lack; rotation : index into the group."""

    name: str
    slot: Slot
    rest: Rest
    rotation: int


class Reparametrise(Move):
    """An object becomes another description of the same posed box; subclasses say which (`slots`).

    Choices: the object among n grown ones; the slot among those offered; the rest of its present chart; the rotation R
    of its axes among the k that the new slot allows.

        log q = -log n - log |slots| + log q(rest) - log k,      log J : see `reparametrise`.

    Back, the object is the same, its old slot one of those offered from the new scene, the rest what the new chart
    dropped, and R's inverse one of the k' that the old slot allows.
    """

    def slots(self, words: Vocabulary, graph: SceneGraph, name: str) -> list[Slot]:
        """Return where the object may go, its present slot left out."""
        raise NotImplementedError

    def rotations(self, words: Vocabulary, graph: SceneGraph, name: str, slot: Slot) -> np.ndarray:
        """Return the group (K, 3, 3), the same back as forth."""
        return group(graph.vertex(name).shape, words.shapes[slot.kind].type)

    def keeps_axes(self, graph: SceneGraph, name: str) -> bool:
        """Return whether the axes' names must stay, for the sake of what the object carries."""
        return False

    def draw(self, rng: np.random.Generator, words: Any, graph: Any) -> Any:
        names = words.grown(graph)
        if not names:
            return None
        name = names[int(rng.random() * len(names))]
        slots = self.slots(words, graph, name)
        if not slots:
            return None
        slot = slots[int(rng.random() * len(slots))]
        own = own_chart(words, graph, name)
        if own is None:
            return None
        rest = draw_rest(rng, own)
        _, _, places = self._places(words, graph, name, slot, rest)
        if not len(places):
            return None
        return Rehang(name, slot, rest, int(places[int(rng.random() * len(places))]))

    def _places(
        self, words: Vocabulary, graph: SceneGraph, name: str, slot: Slot, rest: Rest
    ) -> "tuple[PosedBox, np.ndarray, np.ndarray]":
        """Return the posed box, the group, and the indices of the rotations that the slot allows."""
        rotations = self.rotations(words, graph, name, slot)
        table = table_of(words, graph, slot)
        posed = release(words, graph, graph.vertex(name), rest)
        if table is None:
            return posed, rotations, np.zeros(0, int)
        good = allowed(words, graph, slot, table, posed.pose, rotations)
        if self.keeps_axes(graph, name):
            good &= np.array([np.array_equal(r, np.eye(3)) for r in rotations])
        return posed, rotations, np.flatnonzero(good)

    def log_choice(self, words: Any, graph: Any, choice: Any) -> float:
        names = words.grown(graph)
        slots = self.slots(words, graph, choice.name)
        own = own_chart(words, graph, choice.name)
        if own is None or choice.slot not in slots:
            return -np.inf
        _, _, places = self._places(words, graph, choice.name, choice.slot, choice.rest)
        if choice.rotation not in places:
            return -np.inf
        total = log_uniform_choice(len(names)) + log_uniform_choice(len(slots)) + log_uniform_choice(len(places))
        return total + log_rest(choice.rest, own)

    def apply(self, words: Any, graph: Any, choice: Any) -> Applied | None:
        name, slot = choice.name, choice.slot
        posed, rotations, _ = self._places(words, graph, name, slot, choice.rest)
        rotation = rotations[choice.rotation]
        pose, extents = renamed(posed.pose, posed.extents, rotation)
        table = table_of(words, graph, slot)
        if table is None:
            return None
        found = hung_from(words, graph, name, slot, table, posed._replace(pose=pose, extents=extents))
        if found is None:
            return None
        vertex, rest, element = found
        carried = carry(words, graph, name, vertex, rotation)
        if carried is None:
            return None
        new, log_jacobian = carried
        undo = int(np.argmin(np.abs(rotations - rotation.T).sum(axis=(1, 2))))
        back = Rehang(name, slot_of(words, graph, name), rest, undo)
        return Applied(new, back, posed.log_element - element + log_jacobian)


def own_chart(words: Vocabulary, graph: SceneGraph, name: str) -> OwnChart | None:
    """Return the present chart of a vertex; None where jumps do not know it."""
    vertex = graph.vertex(name)
    slot = slot_of(words, graph, name)
    table = table_of(words, graph, slot)
    if table is None:
        return None
    parent = graph.body(vertex.parent).shape
    return OwnChart(slot.choice[0], parent, shapes[vertex.shape], slot.choice[1:], table, words.shapes[slot.kind])


def slots_on(words: Vocabulary, graph: SceneGraph, parent: str, kind: str) -> list[Slot]:
    """Return every slot of a kind on a parent."""
    kinds = words.kinds(graph, parent)
    if kinds is None or kind not in kinds.probabilities:
        return []
    choices = words.contacts(graph, parent, kind)
    return [] if choices is None else [Slot(kind, parent, choice) for choice in choices.choices]


@moves.register("reparent")
class Reparent(Reparametrise):
    """Hang an object on another parent: floating or in contact, on the floor or on a neighbour."""

    weight = 2.0

    def slots(self, words: Vocabulary, graph: SceneGraph, name: str) -> list[Slot]:
        vertex = graph.vertex(name)
        out = {name, vertex.parent, *graph.descendants(name)}
        kind = words.kind_of(vertex)
        return [
            slot for parent in words.bearers(graph) if parent not in out
            for slot in slots_on(words, graph, parent, kind)
        ]  # fmt: skip


@moves.register("change-face")
class ChangeFace(Reparametrise):
    """Let an object touch its parent by other faces, or in another way, where it is."""

    def slots(self, words: Vocabulary, graph: SceneGraph, name: str) -> list[Slot]:
        own = slot_of(words, graph, name)
        return [slot for slot in slots_on(words, graph, own.parent, own.kind) if slot != own]


@moves.register("change-shape")
class ChangeShape(Reparametrise):
    """Make an object one of another kind, touching its parent in any way that the prior allows for that kind.

    What it carries keeps its numbers, in fractions of the new face, so its axes must keep their names; a leaf's need
    not. That nothing is carried is as true after as before.
    """

    weight = 2.0

    def slots(self, words: Vocabulary, graph: SceneGraph, name: str) -> list[Slot]:
        own = slot_of(words, graph, name)
        kinds = words.kinds(graph, own.parent)
        others = [] if kinds is None else [kind for kind in kinds.choices if kind != own.kind]
        return [slot for kind in others for slot in slots_on(words, graph, own.parent, kind)]

    def keeps_axes(self, graph: SceneGraph, name: str) -> bool:
        return bool(graph.children(name))


class Pair(NamedTuple):
    """The two neighbours' names."""

    lower: str
    upper: str


@moves.register("exchange")
class Exchange(Move):
    """The solids of a parent and its child exchange places: shape types, sizes and options; contacts stay as they are.

    The pair is one of the edges between grown objects, of which there are as many after as before, and it is its own
    way back; sizes only change places and offsets stay fractions of the faces, J = 1:
    log ratio = log posterior(G') - log posterior(G).
    """

    weight = 0.5

    def _pairs(self, words: Vocabulary, graph: SceneGraph) -> list[Pair]:
        grown = set(words.grown(graph))
        return [Pair(vertex.parent, vertex.name) for vertex in graph.vertices if grown >= {vertex.parent, vertex.name}]

    def draw(self, rng: np.random.Generator, words: Any, graph: Any) -> Any:
        pairs = self._pairs(words, graph)
        return pairs[int(rng.random() * len(pairs))] if pairs else None

    def log_choice(self, words: Any, graph: Any, choice: Any) -> float:
        pairs = self._pairs(words, graph)
        return log_uniform_choice(len(pairs)) if choice in pairs else -math.inf

    def apply(self, words: Any, graph: Any, choice: Any) -> Applied | None:
        lower, upper = graph.vertex(choice.lower), graph.vertex(choice.upper)
        changed = {
            lower.name: replace(lower, shape=upper.shape, parameters=upper.parameters, options=upper.options),
            upper.name: replace(upper, shape=lower.shape, parameters=lower.parameters, options=lower.options),
        }
        new = replace(graph, vertices=tuple(changed.get(vertex.name, vertex) for vertex in graph.vertices))
        touched = {*choice, *graph.children(choice.lower), *graph.children(choice.upper)}
        return Applied(new, choice, 0.0) if same_freedom(words, graph, new, touched) else None


class Birth(NamedTuple):
    """vertex : to be added."""

    vertex: Vertex


class Death(NamedTuple):
    """name : of the leaf to be removed."""

    name: str


@moves.register("birth-death")
class BirthDeath(Move):
    """With probability one half each: add an object drawn from the proposal b, or remove one leaf of the l there are.

    The choices of a birth are the new vertex itself, so the map only moves numbers between scene and choices, J = 1:

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
            return Applied(graph.add(choice.vertex), Death(choice.vertex.name), 0.0)
        return Applied(graph.remove(choice.name), Birth(graph.vertex(choice.name)), 0.0)
