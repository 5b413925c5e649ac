"""Sequential Monte Carlo over structures: objects enter one at a time, are annealed in, and jumps rejuvenate.

The targets are pi_k, the posterior limited to k grown objects or fewer, k = 0, 1, ..., K (Del Moral, Doucet, Jasra
2006). From pi_{k-1} to pi_k a particle of k - 1 objects is given one more with probability 1/2, drawn from the
births' proposal b; every other one stays. With the backward kernel that removes one of the l leaves of a scene of k
objects and leaves all others alone, the increments of weight

    birth: pi(G + v) / l(G + v) / (1/2 pi(G) b(v | G)),     left at k - 1: 2,     fewer objects: 1

estimate Z_k / Z_{k-1}, Z_k the mass of prior times likelihood on scenes of at most k objects. At one go the weight of a
birth would rest on the luck of one draw, so it is raised from exponent 0 to 1 in steps, each as far as half of the
population's weight bears: with resampling and moves of the new object that leave the annealed target invariant, which
is the implicit annealing of objects into the scene. Then the jumps run on pi_k. The product of the mean weights is an
estimate of the evidence; adaptive steps bias it by O(1 / particles).
"""

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from derender.sampling.metropolis import log_threshold
from derender.sampling.smc import anneal
from derender.scene.graph import SceneGraph
from derender.structures.jumps.base import Move, State, Target, Vocabulary, evaluate
from derender.structures.jumps.chain import Draws, acceptance_of, walk
from derender.structures.jumps.resimulate import Wiggle

STAY = 0.5  # probability that a particle that could take one more object does not


class Particle(NamedTuple):
    """state : of the scene with the object; born : its name, or None; without : the scene before, with densities;
    possible : whether there was an object to be born where one was to be."""

    state: State
    born: str | None
    without: State
    possible: bool = True


class Limited:
    """The posterior over scenes of at most `most` grown objects."""

    def __init__(self, target: Target, words: Vocabulary, most: int) -> None:
        self.target, self.words, self.most = target, words, most
        self.temperature = target.temperature

    def log_prior(self, graph: SceneGraph) -> float:
        """Return the log density of a scene as a set, -inf above the limit."""
        return self.target.log_prior(graph) if len(self.words.grown(graph)) <= self.most else -math.inf

    def propose(self, graph: SceneGraph) -> float:
        """Return the log likelihood."""
        return self.target.propose(graph)

    def settle(self, accepted: bool) -> None:
        """Keep the scene proposed, or forget it."""
        self.target.settle(accepted)


def log_increment(words: Vocabulary, particle: Particle, most: int) -> float:
    """Return the log of a particle's whole increment of weight (see above)."""
    if not particle.possible:
        return -math.inf
    if particle.born is None:
        return -math.log(STAY) if len(words.grown(particle.state.graph)) == most - 1 else 0.0
    graph, before = particle.state.graph, particle.without
    proposal = words.proposal.log_density(words, before.graph, graph.vertex(particle.born))
    density = particle.state.log_prior + particle.state.log_likelihood - before.log_prior - before.log_likelihood
    return density - math.log(len(words.leaves(graph))) - math.log(1.0 - STAY) - proposal


def structure_smc(
    rng: np.random.Generator,
    target: Target,
    words: Vocabulary,
    start: SceneGraph,
    particles: int,
    most: int,
    parts: Sequence[tuple[Move, float]],
    steps: int,
    new_steps: int = 8,
    counts: Counter | None = None,
) -> Draws:
    """Return particles of equal weight from the posterior over scenes of at most `most` grown objects.

    start : the scene without any grown object; with a root whose pose is unknown it is where the jumps start from.
    steps : of the jumps for each particle and each number of objects. new_steps : of a new object at each exponent.
    """
    empty = evaluate(target, start)
    population = [Particle(empty, None, empty)] * particles
    log_evidence = empty.log_prior + empty.log_likelihood
    counts = Counter() if counts is None else counts
    for size in range(1, most + 1):
        population = [_forth(rng, target, words, particle.state, size) for particle in population]
        gain = np.array([log_increment(words, particle, size) for particle in population])

        def advance(chosen, exponent, size=size):
            nonlocal population
            population = [population[index] for index in chosen]
            if exponent == 1.0:  # the jumps below move them
                return np.zeros(particles)
            population = [_rejuvenate(rng, target, words, p, size, exponent, new_steps) for p in population]
            return np.array([log_increment(words, particle, size) for particle in population])

        log_evidence += anneal(rng, gain, advance)[0]
        limited = Limited(target, words, size)
        for index, particle in enumerate(population):
            evaluate(target, particle.state.graph)  # the image goes back to this particle
            state = walk(rng, limited, words, particle.state, steps, parts, counts)  # type: ignore[arg-type]
            population[index] = Particle(state, None, state)
    states = [particle.state for particle in population]
    return Draws(states, np.full(particles, 1.0 / particles), acceptance_of(counts), log_evidence)


def _forth(rng: np.random.Generator, target: Target, words: Vocabulary, state: State, size: int) -> Particle:
    """Return a particle after the forward kernel: perhaps with one more object."""
    stays = Particle(state, None, state)
    if len(words.grown(state.graph)) != size - 1 or rng.random() < STAY:
        return stays
    vertex = words.proposal.sample(rng, words, state.graph)
    if vertex is None:
        return stays._replace(possible=False)
    graph = state.graph.add(vertex)
    return Particle(evaluate(target, graph), vertex.name, state)


def _rejuvenate(
    rng: np.random.Generator,
    target: Target,
    words: Vocabulary,
    particle: Particle,
    size: int,
    exponent: float,
    steps: int,
) -> Any:
    """Return the particle after moves of its new object that leave the annealed target invariant.

    That is pi(G) b(v | G) times the increment to the exponent; steps are those of `wiggle`, even, with Jacobian one.
    """
    if particle.born is None:
        return particle
    wiggle = Wiggle()
    laws = words.free_numbers(particle.state.graph, particle.born)
    if not laws:
        return particle

    born = particle.born

    def density(p: Particle) -> float:
        proposal = words.proposal.log_density(words, p.without.graph, p.state.graph.vertex(born))
        if proposal == -math.inf or p.state.log_prior == -math.inf:
            return -math.inf
        return proposal + exponent * log_increment(words, p, size)

    evaluate(target, particle.state.graph)
    present = density(particle)
    for _ in range(steps):
        shift = wiggle.steps_of(rng, words, particle.state.graph, born)
        applied = wiggle.apply(words, particle.state.graph, shift)
        if applied is None:
            continue
        log_prior = target.log_prior(applied.graph)
        if log_prior == -math.inf:
            continue
        state = State(applied.graph, log_prior, target.propose(applied.graph))
        proposed = particle._replace(state=state)
        new = density(proposed)
        accepted = log_threshold(rng) < new - present
        target.settle(accepted)
        if accepted:
            particle, present = proposed, new
    return particle
