"""Exchange: two neighbours in a stack, one standing on the other, change places."""

import math
from dataclasses import replace
from typing import NamedTuple

from derender.structures.jumps.base import Applied, Move, moves
from derender.structures.jumps.reparametrise import same_freedom
from derender.structures.jumps.vocabulary import log_uniform_choice


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

    def _pairs(self, words, graph):
        grown = set(words.grown(graph))
        return [Pair(vertex.parent, vertex.name) for vertex in graph.vertices if grown >= {vertex.parent, vertex.name}]

    def draw(self, rng, words, graph):
        pairs = self._pairs(words, graph)
        return pairs[int(rng.random() * len(pairs))] if pairs else None

    def log_choice(self, words, graph, choice):
        pairs = self._pairs(words, graph)
        return log_uniform_choice(len(pairs)) if choice in pairs else -math.inf

    def apply(self, words, graph, choice):
        lower, upper = graph.vertex(choice.lower), graph.vertex(choice.upper)
        changed = {
            lower.name: replace(lower, shape=upper.shape, parameters=upper.parameters, options=upper.options),
            upper.name: replace(upper, shape=lower.shape, parameters=lower.parameters, options=lower.options),
        }
        new = replace(graph, vertices=tuple(changed.get(vertex.name, vertex) for vertex in graph.vertices))
        touched = {*choice, *graph.children(choice.lower), *graph.children(choice.upper)}
        return Applied(new, choice, 0.0) if same_freedom(words, graph, new, touched) else None
