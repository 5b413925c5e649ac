"""Scene graphs under a prior of open structure, by chains of jumps whose draws make up a posterior: `--method mcmc`.

Without a prior, it is DEFAULT_PRIOR with the floor where it was seen and the noise that the image shows. Chains start
from the search's one best scene, and births are proposed about its solids; nothing that `auto` weighs is used.
"""

import json
import math
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from derender import __version__
from derender.detection.estimate import point_estimate
from derender.detection.floor import read_floor
from derender.detection.search.observation import CORRELATED, Observation
from derender.detection.solids.beliefs import any_sensor
from derender.detection.solids.graph import scene_graph
from derender.document import Document, document_text, read_prior_document
from derender.errors import DerenderError
from derender.posterior.target import ObservedImage
from derender.results.posterior import Posterior, StructurePosterior, scene_of
from derender.sampling import diagnostics
from derender.sampling.chains import Plan, Record, Segment, fingerprint, run_chains
from derender.scene.distributions import within
from derender.scene.graph import ROOT, SceneGraph, Vertex, floating
from derender.scene.pose import inverse
from derender.scene.priors.objects import ShapePrior
from derender.scene.priors.terms import total_log_density
from derender.scene.priors.tree import FixedRoot, FreeRoot, LookedAtRoot, written
from derender.scene.shapes import shapes
from derender.scene.shapes.kinds import ROTATIONS
from derender.structures.answer import explanation_of
from derender.structures.case import settings_of
from derender.structures.jumps.base import State, Target, Vocabulary, evaluate, mixture, step
from derender.structures.jumps.proposal import About, Component, Hypothesis, HypothesisProposal, vertex_of
from derender.structures.options import Options
from derender.structures.parts import part_at

OTHER_KIND = 0.2  # weight of a solid as another kind than it was found to be, beside that kind's
FARTHEST = 8.0  # metres along the view within which a depth camera may meet the floor; see workflow.NEARBY


def root_pose_near(root: FixedRoot, floor_pose: np.ndarray) -> np.ndarray:
    """Return the pose that a root's prior allows nearest to one at which the floor was seen (its z up)."""
    if isinstance(root, LookedAtRoot):
        seen = _looked_at(floor_pose)
        return root.pose({a: within(law.support, seen[a])[0] for a, law in root.free_addresses().items()})
    return np.asarray(floor_pose, float) if isinstance(root, FreeRoot) else root.pose({})


def root_seen(floor_pose: np.ndarray) -> np.ndarray:
    """Return the (4, 4) pose of a root on a floor: its origin where the camera looks, or the floor's own if above."""
    seen = _looked_at(floor_pose)
    if not 0.0 < seen["root.distance"] < FARTHEST:
        return written(floor_pose)
    return written(LookedAtRoot(*seen.values()).pose({}))


def _looked_at(floor_pose: np.ndarray) -> dict[str, float]:
    """Return distance, elevation, azimuth and roll, by address, at which a root would lie on a floor."""
    up, place = floor_pose[:3, 2], floor_pose[:3, 3]
    far = float(up @ place / up[2]) if abs(up[2]) > 1e-9 else math.inf
    return LookedAtRoot(0.0, 0.0).values(floor_pose) | {"root.distance": far, "root.azimuth": 0.0}


def hypotheses_of(words: Vocabulary, graph: SceneGraph, length: float = 0.003, angle: float = 0.03) -> list[Hypothesis]:
    """Return the solids of a scene as hypotheses, each as every kind of a prior, with each naming of upright axes."""
    up, poses, found = -graph.down(), graph.poses(), []
    for vertex in graph.vertices:
        size = vertex.body.size()
        if size is None:
            continue
        for kind, entry in words.shapes.items():
            turned = entry.type != "sphere" and {entry.type, vertex.shape} != {"cylinder"}
            likely = 1.0 if entry.type == vertex.shape else OTHER_KIND
            named = _named(entry, poses[vertex.name], size, ROTATIONS if turned else np.eye(3)[None], up)
            found += [Hypothesis(kind, *each, likely / len(named), length, angle) for each in named]
    return found


def _named(
    entry: ShapePrior, pose: np.ndarray, size: np.ndarray, turns: np.ndarray, up: np.ndarray
) -> list[tuple[dict[str, float], np.ndarray]]:
    """Return (parameters, pose) of a solid as a shape, its axes named anew by some turns (K, 3, 3), each once."""
    variants: list[tuple[dict[str, float], np.ndarray]] = []
    rounded = entry.type in ("cylinder", "sphere")  # which turn about its own axis tells nothing of
    for turn in turns:
        new, extents = pose.copy(), np.abs(turn.T) @ size  # the same box, its axes named anew
        new[:3, :3] = pose[:3, :3] @ turn
        if len(turns) > 1 and new[:3, 2] @ up < math.cos(math.radians(45.0)):
            continue
        psi = shapes[entry.type].psi_from_size(extents, entry.options)
        parameters = {p.name: round(float(x), 9) for p, x in zip(shapes[entry.type].parameters, psi, strict=True)}
        alike = [other for known, other in variants if known == parameters]
        if not alike or (not rounded and all(abs(new[:3, :3] @ other[:3, :3].T)[0, 0] < 0.999 for other in alike)):
            variants.append((parameters, new))
    return variants


def start_graph(words: Vocabulary, base: SceneGraph, seen: SceneGraph) -> SceneGraph:
    """Return a scene that the prior allows, with the solids of another one, each in the contact that fits it best;
    without those that no contact holds, or that the prior's terms do not allow even when shrunk by a few per cent."""
    graph = base
    for vertex in seen.vertices:
        if vertex.body.size() is None:
            continue
        contact = floating(inverse(seen.root_pose) @ seen.poses()[vertex.name])
        hung = Vertex(vertex.name, vertex.shape, vertex.parameters, ROOT, contact, vertex.options)
        alone = SceneGraph(seen.root_pose, (hung,), seen.gravity)
        options = []
        proposal = HypothesisProposal(hypotheses_of(words, alone, 0.002, 0.03))
        for component in proposal.components(words, graph):
            options.append((component.weight * (2.0 if component.parent == vertex.parent else 1.0), component))
        for _, component in sorted(options, key=lambda pair: -pair[0])[:6]:
            placed = _placed(words, graph, component)
            if placed is not None:
                graph = placed
                break
    return graph


def _placed(words: Vocabulary, graph: SceneGraph, component: Component) -> SceneGraph | None:
    """Return the graph with a component's vertex, shrunk as far as it takes; None where nothing helps."""
    for share in (1.0, 0.99, 0.97, 0.94):
        values = {key: share * x if key.startswith("shape.") and key in component.spreads else x
                  for key, x in component.centres.items()}  # fmt: skip
        values |= {key: within(about.support, values[key])[0]
                   for key, about in component.spreads.items() if isinstance(about, About)}  # fmt: skip
        added = graph.add(vertex_of(words, graph, component, values))
        if total_log_density(words.prior.constraints, added) > -math.inf:
            return added
    return None


DEFAULT_PRIOR = "bare-image"  # of images that come without one
DRAWS, CHAINS, THIN, WARMUP = 400, 2, 20, 4000
SEGMENT = 10  # draws of a chain between two moments at which it can be stopped


def infer_by_jumps(
    image: np.ndarray,
    camera: Any,
    options: Options,
    document: Any,
    rng: np.random.Generator | None = None,
    progress: Any = None,
) -> Posterior:
    """Infer what there is under a document's prior of open structure, by jumps from the fast search's scene.

    document : None for the default prior, its floor where it was seen. options : Options; warmup counts steps.

    Raises DerenderError : an option that these jumps know nothing about, or no floor to put solids on.
    """
    rng = np.random.default_rng(options.seed) if rng is None else rng
    if progress:
        progress(0.0, "searching for solids")
    plane = read_floor(options.floor)
    if document is None and isinstance(plane, str):
        remedy = "give a plane, leave --floor out, or take --method auto"
        raise DerenderError(f"the prior {DEFAULT_PRIOR} has a floor", "--floor", remedy)
    said = document or replace(read_prior_document(DEFAULT_PRIOR), likelihood=None)
    prior: Any = said.prior
    settings = settings_of(replace(options, prior=prior))._replace(free_forms=False)
    depth = np.where(np.isfinite(image) & (image > 0), image, np.nan)
    state, seen = point_estimate(rng, depth, camera, settings, plane=plane)
    if document is None:  # the floor is where it is seen
        prior = replace(prior, root=FixedRoot(root_seen(seen.floor.pose)))
    graph = scene_graph(state, seen.floor.pose, may_float=settings.may_float)
    words = Vocabulary(prior)
    always = tuple(prior.tree.sample_vertices(rng).values())
    start = start_graph(words, SceneGraph(root_pose_near(prior.root, seen.floor.pose), always), graph)
    likelihood, values = _likelihood_of(said, seen, depth)
    draws, chains = options.draws or DRAWS, options.chains or CHAINS
    hypotheses = hypotheses_of(words, graph)
    sampler = JumpSampler(prior, start, camera, depth, likelihood, values, hypotheses, THIN, SEGMENT)
    if Target(prior).log_prior(start) == -np.inf:
        raise DerenderError("the prior rules out the scene to start from", remedy="widen the prior")
    warmup = WARMUP if options.warmup is None else options.warmup
    folder = None if options.folder is None else Path(options.folder) / "checkpoint"
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    run = fingerprint(__version__, options.deciding(), depth.tobytes(), repr(camera), likelihood, repr(values),
                      sampler.start(rng)["now"].tobytes(), repr(sampler.hypotheses))  # fmt: skip
    plan = Plan(sampler, int(rng.integers(2**63)), chains, -(-warmup // THIN), draws, folder, run,
                options.resume)  # fmt: skip
    total, done = chains * (plan.warmup + plan.draws), dict.fromkeys(range(chains), 0)

    def report(number: int, steps: int, _: int) -> None:
        done[number] = steps
        if progress:
            progress(sum(done.values()) / total, "jumping")

    outcome = run_chains(plan, options.jobs or 1, report)
    found = [sampler.draws(record) for record in outcome.records.values() if record.drawn]
    if not found:
        raise KeyboardInterrupt
    if folder is not None and not outcome.interrupted:
        shutil.rmtree(folder)
    posterior = posterior_of(words, found)
    explanation = explanation_of(posterior.best_graph(), [seen], depth, camera)
    meta = {
        **posterior.meta,
        "likelihood": {"type": likelihood, **(values or {})},
        "interrupted": outcome.interrupted,
        "lost_chains": outcome.lost,
    }
    return replace(posterior, explanation=explanation, meta=meta)


def _likelihood_of(document: Document, seen: Observation, depth: np.ndarray) -> tuple[str, dict[str, float]]:
    """Return the likelihood's name and numbers: the document's, else one with the noise seen on the floor, which
    neighbouring pixels share where the image shows that they do."""
    if document.likelihood is not None:
        return document.likelihood.type, document.likelihood.means
    sigma = float(np.median(seen.sigma[seen.mask])) if seen.mask.any() else 0.002
    seen_on_floor = {"sigma": max(sigma, 0.0005), "blur": 0.5, "outlier": 0.05}
    if seen.correlation > CORRELATED:
        usual = {name: law.quantile(0.5) for name, law in any_sensor().free.items()}
        return "correlated", {**any_sensor().fixed, **usual, "sigma_growth": 0.0, **seen_on_floor}
    missing = float(np.mean(~np.isfinite(depth)))
    return "robust", {
        **seen_on_floor,
        "missing": min(max(missing, 0.01), 0.9), "missing_edge": min(max(2.0 * missing, 0.05), 0.95),
    }  # fmt: skip


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

    Scenes that come and go have no fixed row of numbers, so what has been drawn stands in the state, as text, a line
    each. A segment depends on the scene and the generator alone: a resumed chain equals an uninterrupted one to the
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
        return state, Segment(np.empty((draws, 0)), np.array([drawn[1:] for drawn in states]))

    def draws(self, record: Record) -> Draws:
        """Return what a chain has drawn."""
        graphs = _unpacked(record.state["drawn"])
        states = [State(graph, *row) for graph, row in zip(graphs, record.densities.tolist(), strict=True)]
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
    return _sorted(graph.renamed(names), order)


def unnamed(graph: SceneGraph) -> tuple:
    """Return what tells a structure from others, whatever its objects are called."""
    return tuple(sorted((v.shape, graph.body(v.parent).shape.name, v.contact.type, str(v.contact.child_face))
                        for v in graph.vertices))  # fmt: skip


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
    They are called as in the best draw of the likeliest structure."""
    every = [state for draws in found for state in draws.states]
    (likeliest, _), *_ = Counter(unnamed(state.graph) for state in every).most_common(1)
    there = (state for state in every if unnamed(state.graph) == likeliest)
    reference = max(there, key=lambda state: state.log_prior + state.log_likelihood).graph
    visited: list[list[tuple]] = []
    groups: dict[tuple, list[list[Visit]]] = {}
    for number, draws in enumerate(found):
        visited.append([])
        for state in draws.states:
            graph = matched(state.graph, reference, words.base)
            visited[-1].append(graph.structure())
            chains = groups.setdefault(graph.structure(), [[] for _ in found])
            chains[number].append(Visit(graph, state, 1.0 / (len(draws.states) * len(found))))
    parts = []
    for structure, chains in groups.items():
        part = _part(words, chains)
        error, interval = share_error(visited, structure, part.weight)
        parts.append(replace(part, weight_error=error, weight_interval=interval))
    extras = {name: np.mean([draws.acceptance.get(name, 0.0) for draws in found]) for name in found[0].acceptance}
    meta: dict[str, Any] = {"acceptance": {name: float(x) for name, x in extras.items()},
                            "structure_chains": agreement(visited)}  # fmt: skip
    parts.sort(key=lambda part: -part.weight)
    return Posterior(tuple(parts), meta=meta)


def share_error(
    visited: Sequence[Sequence[tuple]], structure: tuple, share: float
) -> tuple[float, tuple[float, float]]:
    """Return the standard error, and the ends of the 90 % range, of the share of the draws that are of a structure.

    By Jeffreys' estimate of as many independent draws as its being visited is worth. Chains that never leave it, or
    that nothing tells the worth of, are worth one each: that they stayed may be theirs.
    """
    from scipy.stats import beta

    shortest = min(map(len, visited))
    there = np.array([[other == structure for other in chain[:shortest]] for chain in visited], float)
    worth = math.nan if there.min() == there.max() else diagnostics.mean_ess(there)
    worth = max(worth, len(visited)) if math.isfinite(worth) else len(visited)
    hits = share * worth + 0.5, (1.0 - share) * worth + 0.5
    low, high = beta.ppf([0.05, 0.95], *hits)
    return float(beta.std(*hits)), (float(min(low, share)), float(max(high, share)))


def agreement(visited: Sequence[Sequence[tuple]]) -> dict[str, Any]:
    """Return how far chains, each given by the structures of its draws, agree about the likeliest structure.
    shares : of it, by chain; r_hat, ess : of its being visited, None where it always is or they cannot be told."""
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
    weight = math.fsum(visit.weight for chain in chains for visit in chain)
    chains = in_step(chains)
    densities = np.array([[visit.state[1:] for visit in chain] for chain in chains])
    graph = chains[0][0].graph
    target = words.coordinates(graph)
    if target is None:  # nothing is free
        return StructurePosterior(graph, (), densities[..., :0], densities[..., 0], densities[..., 1], weight)
    values = np.array([[target.values(visit.graph) for visit in chain] for chain in chains])
    return part_at(target, values, densities, weight, {})
