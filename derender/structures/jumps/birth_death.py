"""Birth and death: an object appears on one that can bear it, or one that carries nothing is gone."""

import math
from typing import NamedTuple

from derender.scene.graph import Vertex
from derender.structures.jumps.base import Applied, Move, moves
from derender.structures.jumps.vocabulary import log_uniform_choice


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
