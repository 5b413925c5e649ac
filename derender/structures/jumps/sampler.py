"""Jump chains and structure SMC in the form that checkpoints, resuming and several processes ask for.

Scenes that come and go have no fixed row of numbers, so what has been drawn stands in the sampler's state, as text:
a line for each scene, to which a segment adds its own. Each segment begins with an engine and a vocabulary of its own:
what follows depends on the scene and the generator alone, so that a resumed chain equals an uninterrupted one to the
last bit.

The engine is made for a fixed list of solids. Here (`SlotImage`) it has places for several solids of each kind; those
in reserve stand behind the camera, where they cover no pixel. Birth moves one into view, death one out of it, and only
what stands elsewhere than before is drawn again: a jump costs what it changes.
"""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from derender.camera.intrinsics import Camera
from derender.render.raycast.evaluator import DepthEvaluator
from derender.sampling.chains import Record, Segment
from derender.scene.graph import Constraint, Contact, SceneGraph, Vertex
from derender.scene.solids import BOX, CYLINDER, PLANE, SPHERE, Solids
from derender.structures.jumps import mixture
from derender.structures.jumps.base import Move, State, Target, Vocabulary, evaluate
from derender.structures.jumps.chain import Draws, jump_chain, walk
from derender.structures.jumps.proposal import Hypothesis, HypothesisProposal
from derender.structures.jumps.smc import structure_smc

RESERVE = 6  # places of each kind beyond what a scene holds when the engine is made
BEHIND = np.eye(4)
BEHIND[2, 3] = -1e3
SMALL = np.full(3, 1e-3)


class SlotImage:
    """Log likelihoods of scenes by difference. `propose(graph)`, then `accept()` or `reject()`.

    camera, observed (H, W), likelihood, values : as of `DepthEvaluator`.
    """

    def __init__(self, camera: Camera, observed: np.ndarray, likelihood: str = "gaussian", values: Any = None) -> None:
        self._arguments = camera, observed, likelihood, values
        self._evaluator: DepthEvaluator | None = None
        self._keys: list[tuple[int, int]] = []  # (kind, mesh) of each place
        self._meshes: tuple = ()
        self._poses = np.zeros((0, 4, 4))
        self._sizes = np.zeros((0, 3))
        self._here: dict[str, int] = {}  # places by name in the current scene
        self._next: tuple = ()
        self._density = 0.0
        self.evaluations = 0

    def propose(self, graph: SceneGraph) -> float:
        """Return the log likelihood of a scene."""
        solids, names = graph.solids(), graph.solid_names
        if len(solids.meshes):
            return self._propose_whole(solids)
        here = self._assign(names, solids)
        if here is None:
            self._make(names, solids)
            here = self._assign(names, solids)
        assert here is not None and self._evaluator is not None, "the engine was made for as many"
        poses, sizes = self._poses, self._sizes
        moved, new_poses, new_sizes = [], [], []
        for place, pose, size in zip(here.values(), solids.pose, solids.size, strict=True):
            if not (np.array_equal(poses[place], pose) and np.array_equal(sizes[place], size)):
                moved.append(place)
                new_poses.append(pose)
                new_sizes.append(size)
        used = set(here.values())
        for place in self._here.values():
            if place not in used:
                moved.append(place)
                new_poses.append(BEHIND)
                new_sizes.append(SMALL if self._keys[place][0] != PLANE else np.zeros(3))
        self.evaluations += 1
        if not moved:
            self._next = here, (), (), (), self._density
            return self._density
        density = self._evaluator.propose(moved, np.array(new_poses), np.array(new_sizes))
        self._next = here, moved, new_poses, new_sizes, density
        return density

    def accept(self) -> None:
        """Make the scene proposed the current one."""
        if not self._next:
            return
        here, moved, poses, sizes, self._density = self._next
        for place, pose, size in zip(moved, poses, sizes, strict=True):
            self._poses[place], self._sizes[place] = pose, size
        if moved and self._evaluator is not None:
            self._evaluator.accept()
        self._here = here

    def reject(self) -> None:
        """Forget the scene proposed."""
        if self._next and self._next[1] and self._evaluator is not None:
            self._evaluator.reject()

    def _propose_whole(self, solids: Solids) -> float:
        """Return the log likelihood of a scene with meshes, in full: each mesh has a picture of its own there."""
        if self._evaluator is None:
            self._evaluator = DepthEvaluator(*self._arguments)
        self._next = ()
        self.evaluations += 1
        return self._evaluator.load(solids)

    def _assign(self, names: tuple[str, ...], solids: Solids) -> dict[str, int] | None:
        """Return a place for each solid: its own where its kind is the same; None where the places do not suffice."""
        if self._evaluator is None:
            return None
        here: dict[str, int] = {}
        taken = set()
        for name, kind in zip(names, solids.kind, strict=True):
            place = self._here.get(name)
            if place is not None and self._keys[place][0] == kind:
                here[name] = place
                taken.add(place)
        free = [place for place in range(len(self._keys)) if place not in taken]
        occupied = set(self._here.values())
        free.sort(key=lambda place: place in occupied)  # empty places first: fewer rectangles change
        for name, kind in zip(names, solids.kind, strict=True):
            if name not in here:
                place = next((p for p in free if self._keys[p][0] == kind), None)
                if place is None:
                    return None
                free.remove(place)
                here[name] = place
        return {name: here[name] for name in names}

    def _make(self, names: tuple[str, ...], solids: Solids) -> None:
        """Make an engine with places for a scene and more; the current scene stays the current one."""
        kinds: list[int] = []
        for kind in (PLANE, BOX, SPHERE, CYLINDER):
            present = int(np.sum(solids.kind == kind))
            before = sum(self._keys[place][0] == kind for place in self._here.values())
            kinds += [kind] * (max(present, before) + (RESERVE if kind != PLANE else 0))
        poses, sizes = np.repeat(BEHIND[None], len(kinds), 0), np.repeat(SMALL[None], len(kinds), 0)
        sizes[np.array(kinds) == PLANE] = 0.0
        old, here = self._here, {}
        keys = [(kind, -1) for kind in kinds]
        for name, place in old.items():
            new = next(p for p, key in enumerate(keys) if key == self._keys[place] and p not in here.values())
            poses[new], sizes[new], here[name] = self._poses[place], self._sizes[place], new
        self._keys, self._poses, self._sizes, self._here = keys, poses, sizes, here
        self._evaluator = DepthEvaluator(*self._arguments)
        numbers, mesh = np.array(kinds, np.int32), np.full(len(kinds), -1, np.int32)
        self._density = self._evaluator.load(Solids(numbers, poses, sizes, mesh, ()))


STEPS, ANNEAL = 60, 4  # of populations, see `structure_smc`


@dataclass
class JumpSampler:
    """Walks one chain, or makes one population at a go.

    prior : Algorithm1Prior or GrammarPrior. start_graph : a scene of positive prior density.
    camera, image (H, W), likelihood, values : as of `SlotImage`.
    hypotheses : what births are drawn from besides the prior. weights : of moves by name, see `mixture`.
    method : "mcmc" or "smc". thin : steps between two draws of a chain, and to a round of warm-up.
    segment : draws between two moments at which a chain can be stopped; of a population all.
    most : objects at which populations stop.
    """

    prior: Any
    start_graph: SceneGraph
    camera: Any
    image: np.ndarray
    likelihood: str
    values: Mapping[str, float] | None
    hypotheses: Sequence[Hypothesis]
    method: str
    thin: int
    segment: int
    most: int
    weights: Mapping[str, float] | None = None

    def vocabulary(self) -> Vocabulary:
        """Return the words that jumps are made of, with births about the hypotheses."""
        return Vocabulary(self.prior, HypothesisProposal(self.hypotheses) if self.hypotheses else None)

    def start(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Return the state of a chain that has drawn nothing."""
        counts = np.zeros((len(self._parts), 2), np.int64)
        return {"now": _packed([self.start_graph]), "drawn": _packed([]), "counts": counts}

    @property
    def _parts(self) -> list[tuple[Move, float]]:
        return mixture(self.weights)

    def _begin(self, state: dict[str, np.ndarray]) -> tuple[Target, Vocabulary, State]:
        target = Target(self.prior, SlotImage(self.camera, self.image, self.likelihood, self.values))
        return target, self.vocabulary(), evaluate(target, _unpacked(state["now"])[0])

    def warm_up(
        self, rng: np.random.Generator, state: dict[str, np.ndarray], done: int, rounds: int, total: int
    ) -> dict[str, np.ndarray]:
        """Return the state after `rounds` times `thin` steps."""
        target, words, place = self._begin(state)
        place = walk(rng, target, words, place, rounds * self.thin, self._parts)
        return {**state, "now": _packed([place.graph])}

    def advance(
        self, rng: np.random.Generator, state: dict[str, np.ndarray], draws: int
    ) -> tuple[dict[str, np.ndarray], Segment]:
        """Return the state and the densities of `draws` more scenes; the scenes are in the state."""
        target, words, place = self._begin(state)
        counts: Counter = Counter()
        more = {}
        if self.method == "mcmc":
            found = jump_chain(rng, target, words, place.graph, draws, 0, self.thin, self._parts, counts)
        else:
            bare = place.graph
            for name in reversed(words.grown(bare)):
                bare = bare.remove(name) if name in bare.names else bare
            found = structure_smc(rng, target, words, bare, draws, self.most, self._parts, STEPS, ANNEAL, counts)
            more = {"log_evidence": np.array(found.log_evidence)}
        graphs = [drawn.graph for drawn in found.states]
        steps = [[counts[move.name, True] + counts[move.name, False], counts[move.name, True]]
                 for move, _ in self._parts]  # fmt: skip
        state = {"now": _packed(graphs[-1:]), "drawn": np.concatenate([state["drawn"], _packed(graphs)]),
                 "counts": state["counts"] + steps, **more}  # fmt: skip
        densities = (np.array([getattr(drawn, kind) for drawn in found.states]) for kind in State._fields[1:])
        return state, Segment(np.empty((draws, 0)), *densities)

    def draws(self, record: Record) -> Draws:
        """Return what a chain or population has drawn."""
        graphs = _unpacked(record.state["drawn"])
        states = [State(*row) for row in zip(graphs, map(float, record.log_prior), map(float, record.log_likelihood),
                                             strict=True)]  # fmt: skip
        steps, accepted = record.state["counts"].T
        acceptance = {move.name: float(took / of) for (move, _), of, took in
                      zip(self._parts, steps, accepted, strict=True) if of}  # fmt: skip
        evidence = float(record.state["log_evidence"]) if "log_evidence" in record.state else None
        return Draws(states, np.full(len(states), 1.0 / len(states)), acceptance, evidence)


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
