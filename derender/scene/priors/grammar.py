"""Priors of open structure: a consistent grammar in which objects beget objects that rest on them; Algorithm 1.

A symbol is an object's kind together with the face that it turns up.  A symbol begets a random number of children;
each draws its kind among those that some contact can hold there, its shape parameters, its contact and the contact's
parameters.  The grammar is consistent (it ends with probability one, and its densities sum to one) if the matrix of
mean numbers of children of each kind has a spectral radius below one; that is checked when it is made.
"""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from derender.registry import suggest
from derender.scene.distributions import Categorical, Distribution, distributions
from derender.scene.graph import SceneGraph, Vertex
from derender.scene.priors.objects import ContactPrior, ShapePrior, draw_vertex, fault, top_face
from derender.scene.priors.terms import Term
from derender.scene.priors.tree import (
    ROOT,
    Prior,
    RootPrior,
    TreeObject,
    TreePrior,
    seat,
    vertex_addresses,
    vertex_log_density,
)
from derender.scene.shapes import shapes

MOST_OBJECTS = 10_000


class OpenPrior(Prior):
    """What priors of open structure share: objects that are always there, and kinds of those that grow."""

    shapes: Mapping[str, ShapePrior]  # kinds of objects that grow, by name
    contacts: ContactPrior  # p_{s,t}(c) and p_c(phi)
    tree: TreePrior  # the prior of the objects that are always there

    def kind_of(self, vertex: Vertex) -> str | None:
        """Return the kind of a grown vertex, None if no kind is like it."""
        return next((kind for kind, entry in self.shapes.items() if entry.matches(vertex)), None)

    def free_addresses(self, graph: SceneGraph) -> dict[str, Distribution]:
        vertices = {vertex.name: vertex for vertex in graph.vertices}
        free = self.tree.free_addresses(graph)
        for name, vertex in vertices.items():
            kind = self.kind_of(vertex)
            if kind is not None and name not in self.tree.by_name:
                free.update(vertex_addresses(self.shapes[kind], self.contacts, vertices, name))
        return free


@dataclass(frozen=True)
class GrammarPrior(OpenPrior):
    """Objects that grow on a base.

    base : objects that are always there, under their names (a floor); they may have distributions too.
    offspring : distribution of the number of objects that grow on one, by the name of a base object, the kind of a
        grown one, or "root"; what is not named, or has no flat face up, bears nothing.
    spectral_radius : of the matrix of mean numbers of offspring, below 1.
    """

    root: RootPrior  # prior on the root's pose
    base: tuple[TreeObject, ...]
    shapes: Mapping[str, ShapePrior]  # kinds of objects that grow, by name
    contacts: ContactPrior  # p_{s,t}(c) and p_c(phi)
    offspring: Mapping[str, Any]
    constraints: tuple[Term, ...] = ()
    tree: TreePrior = field(init=False, repr=False, compare=False)  # the prior of the base alone
    spectral_radius: float = field(init=False, repr=False, compare=False)
    _kinds: dict[tuple[str, str | None], Categorical | None] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "tree", TreePrior(self.root, self.base))
        object.__setattr__(self, "_kinds", {})
        for name in self.offspring:
            if name not in self.shapes and name != ROOT and name not in self.tree.by_name:
                choices = [*self.shapes, *self.tree.by_name, ROOT]
                raise fault(None, f"offspring names {name!r}, which is no object and no shape", suggest(name, choices))
        states, matrix = self.mean_matrix()
        radius = float(max(abs(np.linalg.eigvals(matrix)))) if states else 0.0
        if radius >= 1.0:
            what = f"the grammar is not consistent: its mean number of offspring has the spectral radius {radius:.3g}"
            raise fault(None, what, "lower the means under offspring until it is below 1")
        object.__setattr__(self, "spectral_radius", radius)

    def kinds(self, parent_shape: str, top: str | None) -> Categorical | None:
        """Return the distribution of a child's kind on a parent's shape type and upward face; None if none fits."""
        key = (parent_shape, top)
        if key not in self._kinds:
            there = {kind: self.contacts.choices(parent_shape, entry.type, top) for kind, entry in self.shapes.items()}
            weights = {kind: self.shapes[kind].weight for kind, found in there.items() if found is not None}
            self._kinds[key] = Categorical(weights) if any(weights.values()) else None
        return self._kinds[key]

    def _bears(self, kind: str, parent_shape: str, top: str | None) -> Any:
        """Return the distribution of the number of children, None for none."""
        count = self.offspring.get(kind)
        return count if count is not None and self.kinds(parent_shape, top) is not None else None

    def mean_matrix(self) -> tuple[list[tuple[str, str | None]], np.ndarray]:
        """Return the symbols (kind, face up) that can be reached and the (N, N) mean numbers of children."""
        seeds = [(kind, top) for kind in self.shapes for top in self._first_tops(kind)]
        states: list[tuple[str, str | None]] = []
        rows: list[dict] = []
        waiting = list(dict.fromkeys(seeds))
        while waiting:
            state = waiting.pop()
            if state in states:
                continue
            states.append(state)
            rows.append(self._mean_row(*state))
            waiting.extend(rows[-1])
        matrix = np.array([[row.get(state, 0.0) for state in states] for row in rows]).reshape(len(states), len(states))
        return states, matrix

    def _first_tops(self, kind: str) -> set[str | None]:
        """Return the faces that a kind can turn up when it grows on the root or on a base object."""
        own, kinds = self.shapes[kind].type, [item.shape.type for item in self.base]
        seats = [("frame", None), *((shape, face) for shape in kinds for face in (None, *shapes[shape].face_names))]
        found = [self.contacts.choices(shape, own, top) for shape, top in seats]
        return {top_face(own, choice[0], choice[2]) for each in found if each is not None for choice in each[0].choices}

    def _mean_row(self, kind: str, top: str | None) -> dict:
        shape = self.shapes[kind].type
        count = self._bears(kind, shape, top)
        row: Counter = Counter()
        if count is None or count.mean() == 0:
            return row
        for child, probability in self.kinds(shape, top).probabilities.items():  # type: ignore[union-attr]
            own = self.shapes[child].type
            choice_of = self.contacts.choices(shape, own, top)[0]  # type: ignore[index]
            for choice, share in choice_of.probabilities.items():
                row[child, top_face(own, choice[0], choice[2])] += count.mean() * probability * share
        return row

    def sample_unconstrained(self, rng: np.random.Generator) -> SceneGraph:
        root_pose = self.root.sample(rng)
        vertices = self.tree.sample_vertices(rng)
        numbers: Counter = Counter()
        waiting = [(ROOT, ROOT), *((name, name) for name in vertices)]
        for name, kind in waiting:  # grows while it is walked: parents before children
            shape, top = seat(vertices, name)
            count = self._bears(kind, shape, top)
            for _ in range(count.sample(rng) if count is not None else 0):
                child = self.kinds(shape, top).sample(rng)  # type: ignore[union-attr]
                numbers[child] += 1
                grown = f"{child}_{numbers[child]}"
                while grown in vertices:
                    grown += "b"
                vertices[grown] = draw_vertex(rng, grown, self.shapes[child], self.contacts, name, shape, top)
                waiting.append((grown, child))
            if len(vertices) > MOST_OBJECTS:
                what = f"the prior drew more than {MOST_OBJECTS} objects"
                raise fault(None, what, "lower the numbers under offspring")
        return SceneGraph(root_pose=root_pose, vertices=tuple(vertices.values()))

    def unconstrained_log_density(self, graph: SceneGraph) -> float:
        vertices = {vertex.name: vertex for vertex in graph.vertices}
        base = self.tree.by_name
        total = self.root.log_density(graph.root_pose)
        children: dict[str, int] = {}
        kinds: dict[str, str] = {ROOT: ROOT}
        for item in self.base:
            if item.name not in vertices or total == -math.inf:
                return -math.inf
            kinds[item.name] = item.name
            total += self.tree.object_log_density(item, vertices)
        for name, vertex in vertices.items():
            if name in base:
                continue
            kind = self.kind_of(vertex)
            if kind is None or vertex.supports:
                return -math.inf
            kinds[name] = kind
            children[vertex.parent] = children.get(vertex.parent, 0) + 1
            choice = self.kinds(*seat(vertices, vertex.parent))
            if choice is None:
                return -math.inf
            total += choice.log_density(kind)
            total += vertex_log_density(self.shapes[kind], self.contacts, vertices, name)
            if total == -math.inf:
                return total
        for name, kind in kinds.items():
            shape, top = seat(vertices, name)
            count = self._bears(kind, shape, top)
            number = children.get(name, 0)
            if count is not None:
                total += count.log_density(number)
            elif number:
                return -math.inf
        return total

    def log_orderings(self, graph: SceneGraph) -> float:
        base = self.tree.by_name
        counts = Counter(vertex.parent for vertex in graph.vertices if vertex.name not in base)
        return math.fsum(math.lgamma(count + 1) for count in counts.values())


@dataclass(frozen=True)
class Algorithm1Prior(OpenPrior):
    """Algorithm 1 of the paper; its log density is Eq. 4.

    Eq. 4 leaves out one case: with no parents and n_2 > 0 children the algorithm has no result.  `sample` draws both
    numbers again then, so the distribution of its results is Eq. 4 divided by
    Z = 1 - exp(-mean_parents) (1 - exp(-mean_children)), the mass of all graphs under Eq. 4.
    The root, always a frame, takes no part in the product over shapes.
    """

    root: RootPrior  # prior on z_root, which Eq. 4 does not cover; its log density is added.
    shapes: Mapping[str, ShapePrior]  # the finite set S by name, each as likely
    contacts: ContactPrior  # p_{s,t}(c) and p_c(phi); under the root only `6dof` counts
    mean_parents: float  # lambda_1
    mean_children: float  # lambda_2
    constraints: tuple[Term, ...] = ()
    tree: TreePrior = field(init=False, repr=False, compare=False)  # of the bare root
    _parents: Distribution = field(init=False, repr=False, compare=False)
    _children: Distribution = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "tree", TreePrior(self.root, ()))
        object.__setattr__(self, "_parents", distributions["poisson"](self.mean_parents))
        object.__setattr__(self, "_children", distributions["poisson"](self.mean_children))
        for parent in self.shapes.values():
            if self.contacts.choices("frame", parent.type) is None:
                raise fault(None, f"no 6dof contact places a {parent.type} under the root", "add 6dof to contacts")
            for child in self.shapes.values():
                top = top_face(parent.type, "6dof", None)
                if self.contacts.choices(parent.type, child.type, top) is None:
                    what = f"no contact holds a {child.type} on a {parent.type}"
                    raise fault(None, what, "add a contact for this pair or leave one of the shapes out")

    def sample_unconstrained(self, rng: np.random.Generator) -> SceneGraph:
        while True:
            parents, children = self._parents.sample(rng), self._children.sample(rng)
            if parents or not children:
                break
        entries = list(self.shapes.values())
        vertices: dict[str, Vertex] = {}

        def add(name: str, parent: str) -> None:
            entry = entries[int(len(entries) * rng.random())]
            vertices[name] = draw_vertex(rng, name, entry, self.contacts, parent, *seat(vertices, parent))

        for i in range(parents):
            add(f"parent_{i + 1}", ROOT)
        for j in range(children):
            add(f"child_{j + 1}", f"parent_{1 + int(parents * rng.random())}")
        return SceneGraph(root_pose=self.root.sample(rng), vertices=tuple(vertices.values()))

    def unconstrained_log_density(self, graph: SceneGraph) -> float:
        """Return Eq. 4, plus the log density of the root's pose."""
        vertices = {vertex.name: vertex for vertex in graph.vertices}
        first = {name for name, vertex in vertices.items() if vertex.parent == ROOT}
        second = len(vertices) - len(first)
        total = self.root.log_density(graph.root_pose)
        total += self._parents.log_density(len(first)) + self._children.log_density(second)
        for name, vertex in vertices.items():
            kind = self.kind_of(vertex)
            if kind is None or vertex.supports or (vertex.parent != ROOT and vertex.parent not in first):
                return -math.inf  # not in S, or deeper than Algorithm 1 goes
            total -= math.log(len(self.shapes))
            total += vertex_log_density(self.shapes[kind], self.contacts, vertices, name)
            if total == -math.inf:
                return total
        if second:
            total -= second * math.log(len(first))
        return total

    def log_orderings(self, graph: SceneGraph) -> float:
        depth = Counter(vertex.parent == ROOT for vertex in graph.vertices)
        return math.lgamma(depth[True] + 1) + math.lgamma(depth[False] + 1)
