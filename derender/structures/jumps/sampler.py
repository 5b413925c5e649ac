"""Jump chains in the form that checkpoints, resuming and several processes ask for.

Scenes that come and go have no fixed row of numbers, so what has been drawn stands in the sampler's state, as text:
a line for each scene, to which a segment adds its own. Each segment begins with an image and a vocabulary of its own:
what follows depends on the scene and the generator alone, so that a resumed chain equals an uninterrupted one to the
last bit.
"""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from derender.posterior.target import ObservedImage
from derender.sampling.chains import Record, Segment
from derender.scene.graph import Constraint, Contact, SceneGraph, Vertex
from derender.structures.jumps import mixture
from derender.structures.jumps.base import State, Target, Vocabulary, evaluate
from derender.structures.jumps.chain import Draws, jump_chain, walk
from derender.structures.jumps.proposal import Hypothesis, HypothesisProposal


@dataclass
class JumpSampler:
    """Walks one chain.

    prior : Algorithm1Prior or GrammarPrior. start_graph : a scene of positive prior density.
    camera, image (H, W), likelihood, values : as of `ObservedImage`.
    hypotheses : what births are drawn from besides the prior.
    thin : steps between two draws, and to a round of warm-up.
    segment : draws between two moments at which a chain can be stopped.
    """

    prior: Any
    start_graph: SceneGraph
    camera: Any
    image: np.ndarray
    likelihood: str
    values: Mapping[str, float] | None
    hypotheses: Sequence[Hypothesis]
    thin: int
    segment: int

    def vocabulary(self) -> Vocabulary:
        """Return the words that jumps are made of, with births about the hypotheses."""
        return Vocabulary(self.prior, HypothesisProposal(self.hypotheses) if self.hypotheses else None)

    def start(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Return the state of a chain that has drawn nothing."""
        counts = np.zeros((len(mixture()), 2), np.int64)
        return {"now": _packed([self.start_graph]), "drawn": _packed([]), "counts": counts}

    def _begin(self, state: dict[str, np.ndarray]) -> tuple[Target, Vocabulary, State]:
        image = ObservedImage(self.camera, self.image, self.likelihood, self.values)
        target = Target(self.prior, partial(image.log_likelihood, parameters={}))
        return target, self.vocabulary(), evaluate(target, _unpacked(state["now"])[0])

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
        found = jump_chain(rng, target, words, place.graph, draws, 0, self.thin, counts)
        graphs = [drawn.graph for drawn in found.states]
        steps = [[counts[move.name, True] + counts[move.name, False], counts[move.name, True]]
                 for move, _ in mixture()]  # fmt: skip
        state = {"now": _packed(graphs[-1:]), "drawn": np.concatenate([state["drawn"], _packed(graphs)]),
                 "counts": state["counts"] + steps}  # fmt: skip
        densities = (np.array([getattr(drawn, kind) for drawn in found.states]) for kind in State._fields[1:])
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
    rows = ({"root_pose": np.asarray(graph.root_pose, float).tolist(), "gravity": list(map(float, graph.gravity)),
             "vertices": [asdict(vertex) for vertex in graph.vertices],
             "constraints": [asdict(constraint) for constraint in graph.constraints]} for graph in graphs)  # fmt: skip
    text = "".join(json.dumps(row, default=lambda number: number.item()) + "\n" for row in rows)
    return np.frombuffer(text.encode(), np.uint8)


def _unpacked(packed: np.ndarray) -> list[SceneGraph]:
    """Return the scenes that `_packed` made bytes of."""
    return [
        SceneGraph(
            np.array(row["root_pose"]),
            tuple(
                Vertex(**{**one, "contact": Contact(**one["contact"]), "supports": tuple(one["supports"])})
                for one in row["vertices"]
            ),
            tuple(row["gravity"]),
            tuple(Constraint(**one) for one in row["constraints"]),
        )
        for row in map(json.loads, bytes(packed).splitlines())
    ]
