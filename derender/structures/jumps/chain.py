"""A Markov chain over scene graphs by reversible jumps, and the posterior that its draws make up."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from derender.results.posterior import Posterior, StructurePosterior
from derender.scene.graph import SceneGraph
from derender.structures.jumps.base import Move, State, Target, evaluate, step
from derender.structures.jumps.vocabulary import Vocabulary

SAME_PLACE = 0.05  # metres between the centres of what is taken for the same object in two draws
CHUNK = 256  # moves chosen at a time


class Draws(NamedTuple):
    """states : one for each draw; weights : (n,), their sum is one; acceptance : by move; log_evidence : or None."""

    states: list[State]
    weights: np.ndarray
    acceptance: Mapping[str, float]
    log_evidence: float | None = None


def walk(
    rng: np.random.Generator,
    target: Target,
    words: Vocabulary,
    state: State,
    steps: int,
    parts: Sequence[tuple[Move, float]],
    counts: Counter | None = None,
) -> State:
    """Return the state after some steps of a mixture of moves. counts : (name, accepted) of each step is added."""
    shares = np.array([share for _, share in parts])
    for start in range(0, steps, CHUNK):
        for number in rng.choice(len(parts), size=min(CHUNK, steps - start), p=shares):
            state, info = step(rng, target, words, parts[number][0], state)
            if counts is not None:
                counts[info.name, info.accepted] += 1
    return state


def jump_chain(
    rng: np.random.Generator,
    target: Target,
    words: Vocabulary,
    start: SceneGraph,
    draws: int,
    warmup: int,
    thin: int,
    parts: Sequence[tuple[Move, float]],
    counts: Counter | None = None,
) -> Draws:
    """Return `draws` states, `thin` steps apart, after `warmup` steps; counts : see `walk`."""
    state = walk(rng, target, words, evaluate(target, start), warmup, parts)
    counts = Counter() if counts is None else counts
    states = []
    for _ in range(draws):
        state = walk(rng, target, words, state, thin, parts, counts)
        states.append(state)
    return Draws(states, np.full(draws, 1.0 / draws), acceptance_of(counts))


def acceptance_of(counts: Counter) -> dict[str, float]:
    """Return the share of accepted steps by move."""
    names = {name for name, _ in counts}
    return {name: counts[name, True] / (counts[name, True] + counts[name, False]) for name in sorted(names)}


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
    vertices = tuple(
        replace(v, name=names.get(v.name, v.name), parent=names.get(v.parent, v.parent)) for v in graph.vertices
    )
    order = {name: place for place, name in enumerate(reference.names)}
    return _sorted(replace(graph, vertices=vertices), order)


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


def posterior_of(words: Vocabulary, found: Sequence[Draws], seed: int | None = None, command: str = "") -> Posterior:
    """Return draws, or weighted particles, as a Posterior: one part for each structure, objects told by their places.

    Particles of unequal weight are not repeated: SMC hands over equal ones.
    """
    states = [(state, weight / len(found)) for draws in found for state, weight in
              zip(draws.states, draws.weights, strict=True)]  # fmt: skip
    reference = max((state for state, _ in states), key=lambda state: state.log_prior + state.log_likelihood).graph
    groups: dict[tuple, list[tuple[SceneGraph, State, float]]] = {}
    for state, weight in states:
        graph = matched(state.graph, reference, words.base)
        groups.setdefault(graph.structure(), []).append((graph, state, weight))
    parts = [_part(words, group) for group in groups.values()]
    extras = {name: np.mean([draws.acceptance.get(name, 0.0) for draws in found]) for name in found[0].acceptance}
    evidence = [draws.log_evidence for draws in found if draws.log_evidence is not None]
    meta: dict[str, Any] = {"acceptance": {name: float(x) for name, x in extras.items()}}
    if evidence:
        meta["log_evidence"] = [float(x) for x in evidence]
    parts.sort(key=lambda part: -part.weight)
    return Posterior(tuple(parts), seed, command, meta=meta)


def _part(words, group) -> StructurePosterior:
    template = max(group, key=lambda item: item[1].log_prior + item[1].log_likelihood)[0]
    free = words.prior.free_addresses(template)
    addresses, periods = [], []
    for address, law in free.items():
        if address.startswith("root."):
            continue
        if address.endswith(".quat_wxyz"):
            stem = address.removesuffix("quat_wxyz")
            addresses += [stem + part for part in ("qw", "qx", "qy", "qz")]
            periods += [None] * 4
        else:
            addresses.append(address)
            low, high = law.support
            periods.append(high - low if address.endswith(".theta") and np.isfinite(high - low) else None)
    numbers = [graph.numbers() for graph, _, _ in group]
    values = np.array([[row.get(address, 0.0) for address in addresses] for row in numbers]).reshape(len(group), -1)
    root = np.array([graph.root_pose for graph, _, _ in group])
    return StructurePosterior(
        template,
        tuple(addresses),
        values[None],
        np.array([[state.log_prior for _, state, _ in group]]),
        np.array([[state.log_likelihood for _, state, _ in group]]),
        float(sum(weight for _, _, weight in group)),
        tuple(periods),
        root[None] if words.prior.root.free_addresses() else None,
    )
