"""What a reversible jump is: an involution on (scene, random choices) (Green 1995; Cusumano-Towner 2020).

A move draws its random choices u given the scene G and maps (G, u) to (G', u') by a map that is its own inverse. All
maps here exchange, shift or turn numbers, which keeps volumes; so with q(u | G) the probability density of the choices,

    log ratio = log posterior(G') - log posterior(G) + log q(u' | G') - log q(u | G).

One function takes every step; moves say q and the map. What a prior lets stand where is its `Vocabulary`.

Scenes are sets of objects: a scene's density is the prior's density of the list times the number of equally likely
lists, under the stock measure (Lebesgue on lengths and angles, Haar of mass one on rotations). Choices "one object
among n" are then counted without any factor for labels. It takes a continuous number for each object that can be born.
"""

import math
from collections.abc import Callable, Collection, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from derender.errors import DerenderError
from derender.posterior.compiled.prior import moved
from derender.posterior.kernels.base import directions_of
from derender.posterior.space import Block, Space
from derender.registry import Registry
from derender.sampling.metropolis import Info, decide
from derender.scene.distributions import Categorical, Distribution
from derender.scene.graph import ROOT, SceneGraph, Vertex
from derender.scene.priors.grammar import Algorithm1Prior, GrammarPrior
from derender.scene.priors.objects import ShapePrior, draw_vertex
from derender.scene.priors.tree import seat

MOST_STRUCTURES = 1024  # whose coordinates are remembered

Choice = tuple[str, str | None, str | None]  # contact type, parent's face, child's face
Table = Mapping[str, float | Distribution]  # a contact's numbers by name, slack that is ideal left out


class PriorProposal:
    """A parent, each as likely; then kind, sizes, contact and its numbers from the prior.
    log density = -log(number of bearers) + log p(kind | parent) + log p(sizes) + log p(contact, numbers)."""

    def sample(self, rng: np.random.Generator, words: Any, graph: SceneGraph) -> Vertex | None:
        """Return a new vertex with a name of its own; None where nothing can grow."""
        bearers = words.bearers(graph)
        if not bearers:
            return None
        parent = bearers[int(rng.random() * len(bearers))]
        kind = words.kinds(graph, parent).sample(rng)
        name, contacts = words.fresh_name(graph.names, kind), words.prior.contacts
        return draw_vertex(rng, name, words.shapes[kind], contacts, parent, *words.seat(graph, parent))

    def log_density(self, words: Any, graph: SceneGraph, vertex: Vertex) -> float:
        """Return the log density of drawing this vertex, whatever its name, for a graph that lacks it."""
        bearers = words.bearers(graph)
        if vertex.parent not in bearers:
            return -math.inf
        kind = words.prior.kind_of(vertex)
        shape, top = words.seat(graph, vertex.parent)
        return (
            -math.log(len(bearers))
            + words.kinds(graph, vertex.parent).log_density(kind)
            + words.shapes[kind].log_density(vertex)
            + words.prior.contacts.log_density(vertex.contact, shape, vertex.shape, top)
        )


class Vocabulary:
    """What may be born, where, and touching how.

    prior : Algorithm1Prior or GrammarPrior. proposal : from which births are drawn, see PriorProposal; None: the prior.
    base : names of the objects that are always there. shapes : ShapePrior of each kind of object that can be born.
    """

    def __init__(self, prior: Algorithm1Prior | GrammarPrior, proposal: PriorProposal | None = None) -> None:
        if not isinstance(prior, Algorithm1Prior | GrammarPrior):
            raise DerenderError("the prior names its objects", remedy="give one with structure:")
        self.prior = prior
        self.shapes: Mapping[str, ShapePrior] = prior.shapes
        self.base = frozenset(prior.tree.by_name)
        self.proposal = PriorProposal() if proposal is None else proposal
        self._equal = Categorical(dict.fromkeys(self.shapes, 1.0))
        self.table = lru_cache(maxsize=4096)(self._table)
        self._coordinates: dict[tuple, Any] = {}

    def grown(self, graph: SceneGraph) -> tuple[str, ...]:
        """Return the names of the objects that jumps may change: all but the base."""
        return tuple(name for name in graph.names if name not in self.base)

    def leaves(self, graph: SceneGraph) -> tuple[str, ...]:
        """Return the names of the objects that carry nothing and may die."""
        parents = {vertex.parent for vertex in graph.vertices}
        return tuple(name for name in self.grown(graph) if name not in parents)

    def seat(self, graph: SceneGraph, parent: str) -> tuple[str, str | None]:
        """Return the shape type and the upward face of a parent."""
        return seat({parent: graph.vertex(parent)} if parent != ROOT else {}, parent)

    def bearers(self, graph: SceneGraph) -> tuple[str, ...]:
        """Return the names on which one more object could grow, the root's among them."""
        return tuple(name for name in (ROOT, *graph.names) if self.kinds(graph, name) is not None)

    def kinds(self, graph: SceneGraph, parent: str) -> Categorical | None:
        """Return the prior of the kind of an object that grows on `parent`; None where nothing can."""
        if isinstance(self.prior, Algorithm1Prior):
            return self._equal if parent == ROOT or graph.vertex(parent).parent == ROOT else None
        kind = parent if parent == ROOT or parent in self.base else self.prior.kind_of(graph.vertex(parent))
        if kind is None or kind not in self.prior.offspring:
            return None
        return self.prior.kinds(*self.seat(graph, parent))

    def contacts(self, graph: SceneGraph, parent: str, kind: str) -> Categorical | None:
        """Return the prior of the contact (type, parent face, child face) of a kind on a parent; None: none fits."""
        shape, top = self.seat(graph, parent)
        found = self.prior.contacts.choices(shape, self.shapes[kind].type, top)
        return None if found is None else found[0]

    def coordinates(self, graph: SceneGraph) -> Any:
        """Return the SceneTarget that says which numbers of a scene's structure are free; None where none is."""
        key = graph.structure()
        if key not in self._coordinates:
            from derender.posterior.target import SceneTarget

            if len(self._coordinates) >= MOST_STRUCTURES:
                self._coordinates.clear()
            prior: Any = self.prior
            found = SceneTarget(prior, graph, None) if prior.free_addresses(graph) else None  # type: ignore[arg-type]
            self._coordinates[key] = found
        return self._coordinates[key]

    def _table(self, parent: str, top: str | None, child: str, choice: Choice) -> Table | None:
        found = self.prior.contacts.choices(parent, child, top)
        return dict(found[1][choice]) if found is not None and choice in found[1] else None

    def fresh_name(self, names: Collection[str], kind: str) -> str:
        """Return a name for an object of a kind that is none of the names."""
        number = 1
        while f"{kind}_{number}" in names:
            number += 1
        return f"{kind}_{number}"


class State(NamedTuple):
    """A scene with its densities."""

    graph: SceneGraph
    log_prior: float  # of the scene as a set
    log_likelihood: float  # of the image


class Applied(NamedTuple):
    """What a move makes of (graph, choices): the new graph and the choices of the way back."""

    graph: SceneGraph
    back: Any


class Move:
    """One reversible jump. Subclasses are registered; one instance serves all."""

    name: str = ""  # in the registry
    weight: float = 1.0  # share of the steps, before normalisation
    even: bool = False  # whether q(u' | G') = q(u | G) always: then there is no `log_choice`

    def draw(self, rng: np.random.Generator, words: Vocabulary, graph: SceneGraph) -> Any:
        """Return random choices u given the scene, or None where the move has nothing to do."""
        raise NotImplementedError

    def log_choice(self, words: Vocabulary, graph: SceneGraph, choice: Any) -> float:
        """Return log q(u | G), -inf for what `draw` never returns."""
        raise NotImplementedError

    def apply(self, words: Vocabulary, graph: SceneGraph, choice: Any) -> Applied | None:
        """Return (G', u'); None where the map is not defined."""
        raise NotImplementedError


moves: Registry[Move] = Registry("jump", "derender.jumps")


class Target:
    """The posterior over scenes: `prior.log_density + prior.log_orderings + log_likelihood`.
    prior : Prior. log_likelihood : of a scene; the prior itself is the target where none is given."""

    def __init__(self, prior: GrammarPrior, log_likelihood: Callable[[SceneGraph], float] = lambda graph: 0.0) -> None:
        self.prior, self.log_likelihood = prior, log_likelihood

    def log_prior(self, graph: SceneGraph) -> float:
        """Return the log density of a scene as a set."""
        density = self.prior.log_density(graph)
        return density + self.prior.log_orderings(graph) if density > -math.inf else density


def evaluate(target: Target, graph: SceneGraph) -> State:
    """Return a scene with its densities."""
    return State(graph, target.log_prior(graph), target.log_likelihood(graph))


def log_proposal_ratio(move: Move, words: Vocabulary, graph: SceneGraph, choice: Any) -> tuple[Applied | None, float]:
    """Return what the move makes of (graph, choice), and log q(u' | G') - log q(u | G)."""
    applied = move.apply(words, graph, choice)
    if applied is None:
        return None, -math.inf
    if move.even:
        return applied, 0.0
    forth = move.log_choice(words, graph, choice)
    back = move.log_choice(words, applied.graph, applied.back)
    if not (forth > -math.inf and back > -math.inf):
        return None, -math.inf
    return applied, back - forth


def step(rng: np.random.Generator, target: Target, words: Vocabulary, move: Move, state: State) -> tuple[State, Info]:
    """Take one Metropolis-Hastings-Green step."""
    refused = state, Info(False, move.name)
    choice = move.draw(rng, words, state.graph)
    if choice is None:
        return refused
    applied, correction = log_proposal_ratio(move, words, state.graph, choice)
    if applied is None:
        return refused
    log_prior = target.log_prior(applied.graph)
    if not log_prior > -math.inf:
        return refused
    new = State(applied.graph, log_prior, target.log_likelihood(applied.graph))
    log_ratio = log_prior - state.log_prior + new.log_likelihood - state.log_likelihood + correction
    return decide(rng, state, new, log_ratio, move.name)


def mixture() -> list[tuple[Move, float]]:
    """Return the moves with their shares of the steps."""
    total = math.fsum(moves[name].weight for name in moves)
    return [(moves[name], moves[name].weight / total) for name in moves]


SHORTEST, LONGEST = 3e-4, 0.3  # of the prior's spread: length of a step, drawn evenly in its logarithm


class Shift(NamedTuple):
    """name : of the object or "root"; members : its unknowns; share : of the prior's spread; tangent : the step."""

    name: str
    members: tuple[int, ...]
    share: float
    tangent: np.ndarray


@moves.register("wiggle")
class Wiggle(Move):
    """Shift some numbers of one object by normals of a random scale; all that stands on it rides along.

    Choices: the object, or the root; a scale, evenly in its logarithm; all its numbers or one; the steps. Back are the
    opposite steps: normals are even and circles and rotations have no boundary, so the q cancel; volumes are kept.
    """

    weight = 12.0
    even = True

    def objects(self, space: Space) -> dict[str, tuple[int, ...]]:
        """Return the unknowns of each object, and of the root, by name."""
        found: dict[str, tuple[int, ...]] = {}
        for i, unknown in enumerate(space.unknowns):
            name = unknown.address.partition(".")[0]
            found[name] = (*found.get(name, ()), i)
        return found

    def draw(self, rng: np.random.Generator, words: Vocabulary, graph: SceneGraph) -> Shift | None:
        target = words.coordinates(graph)
        if target is None:
            return None
        space, objects = target.space, list(self.objects(target.space).items())
        name, members = objects[int(rng.random() * len(objects))]
        share = SHORTEST * (LONGEST / SHORTEST) ** rng.random()
        if rng.random() < 0.5:
            members = (members[int(rng.random() * len(members))],)
        spread = space.scales[directions_of(space, Block("", members))]
        return Shift(name, members, share, share * spread * rng.standard_normal(len(spread)))

    def apply(self, words: Vocabulary, graph: SceneGraph, choice: Shift) -> Applied:
        target = words.coordinates(graph)
        after = moved(target.space, target.values(graph), Block("", choice.members), choice.tangent)
        return Applied(target.graph(after), choice._replace(tangent=-choice.tangent))


@moves.register("birth-death")
class BirthDeath(Move):
    """With probability one half each: add an object drawn from the proposal b, or remove one leaf of the l there are.

    The choices of a birth are the new vertex itself, those of a death the leaf's name, so the map only moves numbers
    between scene and choices:

        birth: log ratio = log posterior(G + v) - log posterior(G) - log l(G + v) - log b(v | G)
        death: the negative, with the vertex removed in place of v.
    """

    weight = 3.0

    def draw(self, rng: np.random.Generator, words: Vocabulary, graph: SceneGraph) -> Any:
        if rng.random() < 0.5:
            return words.proposal.sample(rng, words, graph)
        leaves = words.leaves(graph)
        return leaves[int(rng.random() * len(leaves))] if leaves else None

    def log_choice(self, words: Vocabulary, graph: SceneGraph, choice: Any) -> float:
        if isinstance(choice, Vertex):
            return math.log(0.5) + words.proposal.log_density(words, graph, choice)
        leaves = words.leaves(graph)
        return math.log(0.5) - math.log(len(leaves)) if choice in leaves else -math.inf

    def apply(self, words: Vocabulary, graph: SceneGraph, choice: Any) -> Applied | None:
        if isinstance(choice, Vertex):
            return Applied(graph.add(choice), choice.name)
        return Applied(graph.remove(choice), graph.vertex(choice))
