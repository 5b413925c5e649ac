"""Resimulate: one object's contact numbers or sizes are drawn anew from the prior, what it carries riding along."""

from dataclasses import replace
from typing import NamedTuple

from derender.structures.jumps.base import Applied, Move, moves
from derender.structures.jumps.numbers import read, write
from derender.structures.jumps.vocabulary import log_uniform_choice


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

    def _blocks(self, words, graph):
        return [
            (name, part)
            for name in graph.names
            for part in ("shape", "contact")
            if any(key[0] == part for key in words.free_numbers(graph, name))
        ]

    def draw(self, rng, words, graph):
        blocks = self._blocks(words, graph)
        if not blocks:
            return None
        name, part = blocks[int(rng.random() * len(blocks))]
        laws = words.free_numbers(graph, name)
        return Numbers(name, part, {key: law.sample(rng) for key, law in laws.items() if key[0] == part})

    def log_choice(self, words, graph, choice):
        laws = words.free_numbers(graph, choice.name)
        total = log_uniform_choice(len(self._blocks(words, graph)))
        return total + sum(laws[key].log_density(value) for key, value in choice.values.items())

    def apply(self, words, graph, choice):
        vertex = graph.vertex(choice.name)
        back = Numbers(choice.name, choice.part, read(vertex, choice.values))
        new = write(vertex, choice.values)
        vertices = tuple(new if other is vertex else other for other in graph.vertices)
        return Applied(replace(graph, vertices=vertices), back, 0.0)
