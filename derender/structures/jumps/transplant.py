"""Transplant: an object with all that stands on it goes to another place, on any parent, as the prior would put it."""

import math
from dataclasses import replace
from typing import NamedTuple

from derender.scene.graph import Contact
from derender.structures.jumps.base import Applied, Move, moves
from derender.structures.jumps.recast import same_freedom
from derender.structures.jumps.vocabulary import log_uniform_choice


class Place(NamedTuple):
    """name : of the stack's lowest object; parent, contact : where it is to stand."""

    name: str
    parent: str
    contact: Contact


@moves.register("transplant")
class Transplant(Move):
    """Put a whole stack elsewhere: parent each as likely, contact and its numbers from the prior.

    log q = -log n - log(bearers outside the stack) + log p(contact, numbers); the old place is the way back; numbers
    only change places, J = 1. What stands on it rides along.
    """

    weight = 1.0

    def _parents(self, words, graph, name):
        stack = {name, *graph.descendants(name)}
        kind = words.kind_of(graph.vertex(name))
        return [
            parent for parent in words.bearers(graph)
            if parent not in stack and kind in words.kinds(graph, parent).probabilities
        ]  # fmt: skip

    def draw(self, rng, words, graph):
        names = words.grown(graph)
        if not names:
            return None
        name = names[int(rng.random() * len(names))]
        parents = self._parents(words, graph, name)
        if not parents:
            return None
        parent = parents[int(rng.random() * len(parents))]
        shape, top = words.seat(graph, parent)
        return Place(name, parent, words.prior.contacts.sample(rng, shape, graph.vertex(name).shape, top))

    def log_choice(self, words, graph, choice):
        parents = self._parents(words, graph, choice.name)
        if choice.parent not in parents:
            return -math.inf
        shape, top = words.seat(graph, choice.parent)
        total = log_uniform_choice(len(words.grown(graph))) + log_uniform_choice(len(parents))
        return total + words.prior.contacts.log_density(choice.contact, shape, graph.vertex(choice.name).shape, top)

    def apply(self, words, graph, choice):
        vertex = graph.vertex(choice.name)
        new = graph.exchange({choice.name: replace(vertex, parent=choice.parent, contact=choice.contact)})
        if not same_freedom(words, graph, new, graph.children(choice.name)):
            return None
        return Applied(new, Place(choice.name, vertex.parent, vertex.contact), 0.0)
