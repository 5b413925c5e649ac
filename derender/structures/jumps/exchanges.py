"""Moves that change which solids there are: birth and death, and two neighbours in a stack that change places."""

import math
from dataclasses import replace
from typing import NamedTuple

from derender.scene.graph import Vertex
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

    def draw(self, rng, words, graph):
        if rng.random() < 0.5:
            vertex = words.proposal.sample(rng, words, graph)
            return None if vertex is None else Birth(vertex)
        leaves = words.leaves(graph)
        return Death(leaves[int(rng.random() * len(leaves))]) if leaves else None

    def log_choice(self, words, graph, choice):
        if isinstance(choice, Birth):
            return math.log(0.5) + words.proposal.log_density(words, graph, choice.vertex)
        leaves = words.leaves(graph)
        return math.log(0.5) + log_uniform_choice(len(leaves)) if choice.name in leaves else -math.inf

    def apply(self, words, graph, choice):
        if isinstance(choice, Birth):
            return Applied(graph.add(choice.vertex), Death(choice.vertex.name), 0.0)
        return Applied(graph.remove(choice.name), Birth(graph.vertex(choice.name)), 0.0)
