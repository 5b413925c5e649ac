"""A Markov chain over scene graphs by reversible jumps, and the posterior that its draws make up."""

import json
import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from derender.document import document_text
from derender.posterior.target import ObservedImage
from derender.results.posterior import Posterior, StructurePosterior, scene_of
from derender.sampling import diagnostics
from derender.sampling.chains import Record, Segment
from derender.scene.graph import SceneGraph
from derender.structures.given import part_at
from derender.structures.jumps.base import State, Target, Vocabulary, evaluate, mixture, step
from derender.structures.jumps.proposal import Hypothesis, HypothesisProposal

SAME_PLACE = 0.05  # metres between the centres of what is taken for the same object in two draws
CHUNK = 256  # moves chosen at a time


class Draws(NamedTuple):
    """states : one for each draw; acceptance : by move."""

    states: list[State]
    acceptance: Mapping[str, float]


class Visit(NamedTuple):
    """A draw of one structure: its scene in the common names, its state, its weight among all draws."""

    graph: SceneGraph
    state: State
    weight: float


def walk(
    rng: np.random.Generator, target: Target, words: Vocabulary, state: State, steps: int, counts: Counter | None = None
) -> State:
    """Return the state after some steps of the mixture of moves. counts : (name, accepted) of each step is added."""
    parts = mixture()
    shares = np.array([share for _, share in parts])
    for start in range(0, steps, CHUNK):
        for number in rng.choice(len(parts), size=min(CHUNK, steps - start), p=shares):
            state, info = step(rng, target, words, parts[number][0], state)
            if counts is not None:
                counts[info.name, info.accepted] += 1
    return state


@dataclass
class JumpSampler:
    """Walks one chain, in the form that checkpoints, resuming and several processes ask for.

    Scenes that come and go have no fixed row of numbers, so what has been drawn stands in the state, as text: a line
    for each scene, to which a segment adds its own. Each segment begins with an image and a vocabulary of its own: what
    follows depends on the scene and the generator alone, so that a resumed chain equals an uninterrupted one to the
    last bit.

    start_graph : a scene of positive prior density. camera, image (H, W), likelihood, values : as of `ObservedImage`.
    """

    prior: Any  # Algorithm1Prior or GrammarPrior
    start_graph: SceneGraph
    camera: Any
    image: np.ndarray
    likelihood: str
    values: Mapping[str, float] | None
    hypotheses: Sequence[Hypothesis]  # what births are drawn from besides the prior
    thin: int  # steps between two draws, and to a round of warm-up
    segment: int  # draws between two moments at which a chain can be stopped

    def start(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Return the state of a chain that has drawn nothing."""
        counts = np.zeros((len(mixture()), 2), np.int64)
        return {"now": _packed([self.start_graph]), "drawn": _packed([]), "counts": counts}

    def _begin(self, state: dict[str, np.ndarray]) -> tuple[Target, Vocabulary, State]:
        image = ObservedImage(self.camera, self.image, self.likelihood, self.values)
        target = Target(self.prior, partial(image.log_likelihood, parameters={}))
        words = Vocabulary(self.prior, HypothesisProposal(self.hypotheses) if self.hypotheses else None)
        return target, words, evaluate(target, _unpacked(state["now"])[0])

    def warm_up(
        self, rng: np.random.Generator, state: dict[str, np.ndarray], done: int, rounds: int, total: int
    ) -> dict[str, np.ndarray]:
        """Return the state after `rounds` times `thin` steps."""
        target, words, place = self._begin(state)
        place = walk(rng, target, words, place, rounds * self.thin)
        return {**state, "now": _packed([place.graph])}

    def advance(
        self, rng: np.random.Generator, state: dict[str, np.ndarray], draws: int
    ) -> tuple[dict[str, np.ndarray], Segment]:
        """Return the state and the densities of `draws` more scenes; the scenes are in the state."""
        target, words, place = self._begin(state)
        counts: Counter = Counter()
        states = []
        for _ in range(draws):
            place = walk(rng, target, words, place, self.thin, counts)
            states.append(place)
        graphs = [drawn.graph for drawn in states]
        steps = [[counts[move.name, True] + counts[move.name, False], counts[move.name, True]]
                 for move, _ in mixture()]  # fmt: skip
        state = {"now": _packed(graphs[-1:]), "drawn": np.concatenate([state["drawn"], _packed(graphs)]),
                 "counts": state["counts"] + steps}  # fmt: skip
        densities = (np.array([getattr(drawn, kind) for drawn in states]) for kind in State._fields[1:])
        return state, Segment(np.empty((draws, 0)), *densities)

    def draws(self, record: Record) -> Draws:
        """Return what a chain has drawn."""
        graphs = _unpacked(record.state["drawn"])
        states = [State(*row) for row in zip(graphs, map(float, record.log_prior), map(float, record.log_likelihood),
                                             strict=True)]  # fmt: skip
        steps, accepted = record.state["counts"].T
        acceptance = {move.name: float(took / of) for (move, _), of, took in
                      zip(mixture(), steps, accepted, strict=True) if of}  # fmt: skip
        return Draws(states, acceptance)


def _packed(graphs: Sequence[SceneGraph]) -> np.ndarray:
    """Return scenes as the bytes of a text, a line each, exact to the last bit of each number."""
    text = "".join(json.dumps([document_text(graph), graph.names]) + "\n" for graph in graphs)
    return np.frombuffer(text.encode(), np.uint8)


def _unpacked(packed: np.ndarray) -> list[SceneGraph]:
    """Return the scenes that `_packed` made bytes of."""
    return [scene_of(*json.loads(line)) for line in bytes(packed).splitlines()]


def matched(graph: SceneGraph, reference: SceneGraph, base: frozenset[str]) -> SceneGraph:
    """Return the graph with each object called like the reference's nearest, by their centres; others get new names."""
    from scipy.optimize import linear_sum_assignment

    grown = [name for name in graph.names if name not in base]
    known = [name for name in reference.names if name not in base]
    names: dict[str, str] = {}
    if grown and known:
        here, there = graph.poses(), reference.poses()
        far = np.array([[np.linalg.norm(here[a][:3, 3] - there[b][:3, 3]) for b in known] for a in grown])
        for row, column in zip(*linear_sum_assignment(np.minimum(far, SAME_PLACE)), strict=True):
            if far[row, column] < SAME_PLACE:
                names[grown[row]] = known[column]
    number = 0
    for name in grown:
        if name not in names:
            number += 1
            while f"other_{number}" in known:
                number += 1
            names[name] = f"other_{number}"
    order = {name: place for place, name in enumerate(reference.names)}
    return _sorted(called(graph, names), order)


def called(graph: SceneGraph, names: Mapping[str, str]) -> SceneGraph:
    """Return the graph with other names, by their present ones."""
    vertices = tuple(
        replace(v, name=names.get(v.name, v.name), parent=names.get(v.parent, v.parent)) for v in graph.vertices
    )
    return replace(graph, vertices=vertices)


def names_by_kind(words: Vocabulary, graph: SceneGraph, taken: Collection[str]) -> dict[str, str]:
    """Return {name: one that fits} of the objects that have become another kind since they were named after theirs.

    taken : names that other objects have.
    """
    names: dict[str, str] = {}
    for name in words.grown(graph):
        entry, vertex = words.shapes.get(name.rpartition("_")[0]), graph.vertex(name)
        if entry is not None and not entry.matches(vertex):
            names[name] = words.fresh_name({*taken, *names.values()}, words.kind_of(vertex))
    return names


def _sorted(graph: SceneGraph, order: Mapping[str, int]) -> SceneGraph:
    """Return the graph with its vertices in a canonical order, parents first: equal structures have equal lists."""
    waiting = sorted(graph.vertices, key=lambda v: (order.get(v.name, len(order)), v.name))
    placed, seen = [], {"root"}
    while waiting:
        vertex = next(v for v in waiting if v.parent in seen)
        waiting.remove(vertex)
        placed.append(vertex)
        seen.add(vertex.name)
    return replace(graph, vertices=tuple(placed))


def posterior_of(words: Vocabulary, found: Sequence[Draws]) -> Posterior:
    """Return the draws of chains as a Posterior: one part for each structure, objects told by their places.

    They are called after their kinds in the likeliest structure.
    """
    every = [state for draws in found for state in draws.states]
    reference = max(every, key=lambda state: state.log_prior + state.log_likelihood).graph
    visited: list[list[tuple]] = []
    groups: dict[tuple, list[list[Visit]]] = {}
    for number, draws in enumerate(found):
        visited.append([])
        for state in draws.states:
            graph = matched(state.graph, reference, words.base)
            visited[-1].append(graph.structure())
            chains = groups.setdefault(graph.structure(), [[] for _ in found])
            chains[number].append(Visit(graph, state, 1.0 / (len(draws.states) * len(found))))
    heaviest = max(groups.values(), key=lambda chains: sum(visit.weight for chain in chains for visit in chain))
    taken = {name for structure in groups for name, *_ in structure}
    names = names_by_kind(words, next(visit.graph for chain in heaviest for visit in chain), taken)
    parts = [
        _part(words, [[visit._replace(graph=called(visit.graph, names)) for visit in chain] for chain in chains])
        for chains in groups.values()
    ]
    extras = {name: np.mean([draws.acceptance.get(name, 0.0) for draws in found]) for name in found[0].acceptance}
    meta: dict[str, Any] = {"acceptance": {name: float(x) for name, x in extras.items()},
                            "structure_chains": agreement(visited)}  # fmt: skip
    parts.sort(key=lambda part: -part.weight)
    return Posterior(tuple(parts), meta=meta)


def agreement(visited: Sequence[Sequence[tuple]]) -> dict[str, Any]:
    """Return how far chains, each given by the structures of its draws, agree about the likeliest structure.

    shares : of it, by chain; r_hat, ess : of its being visited, None where it always is or they cannot be told.
    """
    likeliest = Counter(structure for chain in visited for structure in chain).most_common(1)[0][0]
    shortest = min(map(len, visited))
    there = np.array([[structure == likeliest for structure in chain[:shortest]] for chain in visited], float)
    told = {} if there.all() else {"r_hat": diagnostics.r_hat(there), "ess": diagnostics.mean_ess(there)}
    shares = [float(np.mean([structure == likeliest for structure in chain])) for chain in visited]
    return {"shares": shares, **{key: float(told[key]) if math.isfinite(told.get(key, math.nan)) else None
                                 for key in ("r_hat", "ess")}}  # fmt: skip


def in_step(chains: list[list[Visit]]) -> list[list[Visit]]:
    """Return the draws of one structure as chains of one length: cut to the shortest where that costs at most half of
    them, else in a row as one chain."""
    chains = [chain for chain in chains if chain]
    shortest = min(map(len, chains))
    if 2 * shortest * len(chains) >= sum(map(len, chains)):
        return [chain[:shortest] for chain in chains]
    return [[visit for chain in chains for visit in chain]]


def _part(words: Vocabulary, chains: list[list[Visit]]) -> StructurePosterior:
    weight = float(sum(visit.weight for chain in chains for visit in chain))
    chains = in_step(chains)
    log_prior, log_likelihood = (np.array([[getattr(visit.state, kind) for visit in chain] for chain in chains])
                                 for kind in State._fields[1:])  # fmt: skip
    graph = chains[0][0].graph
    target = words.coordinates(graph)
    if target is None:  # nothing is free
        return StructurePosterior(graph, (), np.empty((*log_prior.shape, 0)), log_prior, log_likelihood, weight)
    values = np.array([[target.values(visit.graph) for visit in chain] for chain in chains])
    return part_at(target, values, log_prior, log_likelihood, weight, {})
