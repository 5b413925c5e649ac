"""Algorithm 1: parents that float under the root, children in contact with parents, both Poisson in number."""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from derender.scene.distributions import Distribution, distributions
from derender.scene.graph import SceneGraph, Vertex
from derender.scene.priors.objects import ContactPrior, ShapePrior, draw_vertex, fault, top_face
from derender.scene.priors.terms import Term, sample_until_allowed, total_log_density
from derender.scene.priors.tree import ROOT, Prior, RootPrior, seat, vertex_addresses


@dataclass(frozen=True)
class Algorithm1Prior(Prior):
    """Algorithm 1 of the paper; its log density is Eq. 4.

    Eq. 4 leaves out one case: with no parents and n_2 > 0 children the algorithm has no result.  `sample` draws both
    numbers again then, so the distribution of its results is Eq. 4 divided by
    Z = 1 - exp(-mean_parents) (1 - exp(-mean_children)), the mass of all graphs under Eq. 4; `log_normaliser` is log Z.
    The root, always a frame, takes no part in the product over shapes.

    root : prior on z_root, which Eq. 4 does not cover; its log density is added.
    shapes : the finite set S by name, each as likely.
    contacts : p_{s,t}(c) and p_c(phi); under the root only `6dof` counts.
    mean_parents, mean_children : lambda_1 and lambda_2.
    """

    root: RootPrior
    shapes: Mapping[str, ShapePrior]
    contacts: ContactPrior
    mean_parents: float
    mean_children: float
    constraints: tuple[Term, ...] = ()
    _parents: Distribution = field(init=False, repr=False, compare=False)
    _children: Distribution = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
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

    @property
    def log_normaliser(self) -> float:
        """Log of the total mass of Eq. 4."""
        return math.log1p(math.exp(-self.mean_parents) * math.expm1(-self.mean_children))

    def sample(self, rng: np.random.Generator) -> SceneGraph:
        return sample_until_allowed(rng, self._sample, self.constraints)

    def _sample(self, rng: np.random.Generator) -> SceneGraph:
        while True:
            parents, children = self._parents.sample(rng), self._children.sample(rng)
            if parents or not children:
                break
        entries = list(self.shapes.values())
        vertices: dict[str, Vertex] = {}
        for i in range(parents):
            self._add(rng, vertices, f"parent_{i + 1}", entries, ROOT)
        for j in range(children):
            self._add(rng, vertices, f"child_{j + 1}", entries, f"parent_{1 + int(parents * rng.random())}")
        return SceneGraph(root_pose=self.root.sample(rng), vertices=tuple(vertices.values()))

    def _add(
        self, rng: np.random.Generator, vertices: dict[str, Vertex], name: str, entries: list[ShapePrior], parent: str
    ) -> None:
        entry = entries[int(len(entries) * rng.random())]
        vertices[name] = draw_vertex(rng, name, entry, self.contacts, parent, *seat(vertices, parent))

    def log_density(self, graph: SceneGraph) -> float:
        """Return Eq. 4, plus the log density of the root's pose."""
        vertices = {vertex.name: vertex for vertex in graph.vertices}
        first = {name for name, vertex in vertices.items() if vertex.parent == ROOT}
        second = len(vertices) - len(first)
        total = self.root.log_density(graph.root_pose)
        total += self._parents.log_density(len(first)) + self._children.log_density(second)
        for vertex in vertices.values():
            entry = self._entry(vertex)
            if entry is None or vertex.supports or (vertex.parent != ROOT and vertex.parent not in first):
                return -math.inf  # not in S, or deeper than Algorithm 1 goes
            shape, top = seat(vertices, vertex.parent)
            total -= math.log(len(self.shapes))
            total += entry.log_density(vertex) + self.contacts.log_density(vertex.contact, shape, vertex.shape, top)
            if total == -math.inf:
                return total
        if second:
            total -= second * math.log(len(first))
        return total + total_log_density(self.constraints, graph) if self.constraints else total

    def _entry(self, vertex: Vertex) -> ShapePrior | None:
        return next((entry for entry in self.shapes.values() if entry.matches(vertex)), None)

    def free_addresses(self, graph: SceneGraph) -> dict[str, Distribution]:
        vertices = {vertex.name: vertex for vertex in graph.vertices}
        free = self.root.free_addresses()
        for name, vertex in vertices.items():
            entry = self._entry(vertex)
            if entry is not None:
                free.update(vertex_addresses(entry, self.contacts, vertices, name))
        return free

    def log_orderings(self, graph: SceneGraph) -> float:
        depth = Counter(vertex.parent == ROOT for vertex in graph.vertices)
        return math.lgamma(depth[True] + 1) + math.lgamma(depth[False] + 1)
