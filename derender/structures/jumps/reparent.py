"""Reparent: an object is hung elsewhere, on another parent, face or contact type, where it is in the world."""

from typing import NamedTuple

import numpy as np

from derender.scene.shapes import shapes
from derender.structures.jumps.base import Applied, Move, moves
from derender.structures.jumps.charts import Rest, draw_rest, log_rest
from derender.structures.jumps.reparametrise import (
    Slot,
    allowed,
    carry,
    group,
    hung_from,
    release,
    renamed,
    slot_of,
    table_of,
)
from derender.structures.jumps.vocabulary import log_uniform_choice


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

    def slots(self, words, graph, name) -> list[Slot]:
        """Return where the object may go, its present slot left out."""
        raise NotImplementedError

    def rotations(self, words, graph, name, slot) -> np.ndarray:
        """Return the group (K, 3, 3), the same back as forth."""
        return group(graph.vertex(name).shape, words.shapes[slot.kind].type)

    def keeps_axes(self, graph, name) -> bool:
        """Return whether the axes' names must stay, for the sake of what the object carries."""
        return False

    def draw(self, rng, words, graph):
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
        rest = draw_rest(rng, *own)
        _, _, places = self._places(words, graph, name, slot, rest)
        if not len(places):
            return None
        return Rehang(name, slot, rest, int(places[int(rng.random() * len(places))]))

    def _places(self, words, graph, name, slot, rest):
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

    def log_choice(self, words, graph, choice):
        names = words.grown(graph)
        slots = self.slots(words, graph, choice.name)
        own = own_chart(words, graph, choice.name)
        if own is None or choice.slot not in slots:
            return -np.inf
        _, _, places = self._places(words, graph, choice.name, choice.slot, choice.rest)
        if choice.rotation not in places:
            return -np.inf
        total = log_uniform_choice(len(names)) + log_uniform_choice(len(slots)) + log_uniform_choice(len(places))
        return total + log_rest(choice.rest, *own)

    def apply(self, words, graph, choice):
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


def own_chart(words, graph, name):
    """Return what `draw_rest` asks of a vertex's present chart; None where jumps do not know it."""
    vertex = graph.vertex(name)
    slot = slot_of(words, graph, name)
    table = table_of(words, graph, slot)
    if table is None:
        return None
    parent = graph.body(vertex.parent).shape
    return slot.choice[0], parent, shapes[vertex.shape], slot.choice[1:], table, words.shapes[slot.kind]


def slots_on(words, graph, parent: str, kind: str) -> list[Slot]:
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

    def slots(self, words, graph, name):
        vertex = graph.vertex(name)
        out = {name, vertex.parent, *graph.descendants(name)}
        lifted = graph  # what may bear does not depend on the object itself, which is no parent of its parents
        kind = words.kind_of(vertex)
        return [
            slot for parent in words.bearers(lifted) if parent not in out
            for slot in slots_on(words, lifted, parent, kind)
        ]  # fmt: skip


@moves.register("change-face")
class ChangeFace(Reparametrise):
    """Let an object touch its parent by other faces, or in another way, where it is."""

    def slots(self, words, graph, name):
        own = slot_of(words, graph, name)
        return [slot for slot in slots_on(words, graph, own.parent, own.kind) if slot != own]


@moves.register("change-shape")
class ChangeShape(Reparametrise):
    """Make an object one of another kind, touching its parent in any way that the prior allows for that kind.

    What it carries keeps its numbers, in fractions of the new face, so its axes must keep their names; a leaf's need
    not. That nothing is carried is as true after as before.
    """

    weight = 2.0

    def slots(self, words, graph, name):
        own = slot_of(words, graph, name)
        kinds = words.kinds(graph, own.parent)
        others = [] if kinds is None else [kind for kind in kinds.choices if kind != own.kind]
        return [slot for kind in others for slot in slots_on(words, graph, own.parent, kind)]

    def keeps_axes(self, graph, name):
        return bool(graph.children(name))
