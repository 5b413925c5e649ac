"""What a structural prior lets stand where: the sets that jumps choose from, one interface for every prior."""

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import cast

from derender.errors import DerenderError
from derender.scene.distributions import Categorical, Distribution
from derender.scene.graph import ROOT, Contact, SceneGraph, Vertex
from derender.scene.priors.algorithm_1 import Algorithm1Prior
from derender.scene.priors.grammar import GrammarPrior
from derender.scene.priors.shapes import ShapePrior
from derender.scene.priors.tree import seat

Choice = tuple[str, str | None, str | None]  # contact type, parent's face, child's face
Table = Mapping[str, float | Distribution]  # a contact's numbers by name, slack that is ideal left out


class Vocabulary:
    """What may be born, where, and touching how.

    Parameters
    ----------
    prior : Algorithm1Prior or GrammarPrior.
    proposal : from which births are drawn (`sample(rng, words, graph)`, `log_density(words, graph, vertex)`); None:
        the prior itself.

    Attributes
    ----------
    base : names of the objects that are always there.
    shapes : ShapePrior of each kind of object that can be born.
    """

    def __init__(self, prior: Algorithm1Prior | GrammarPrior, proposal=None) -> None:
        if not isinstance(prior, Algorithm1Prior | GrammarPrior):
            raise DerenderError("the prior names its objects", remedy="give one with structure:")
        from derender.structures.jumps.proposal import PriorProposal

        self.prior = prior
        self.shapes: Mapping[str, ShapePrior] = prior.shapes
        self.base = frozenset(prior.tree.by_name if isinstance(prior, GrammarPrior) else ())
        self.proposal = PriorProposal() if proposal is None else proposal
        self._equal = Categorical(dict.fromkeys(self.shapes, 1.0))
        self.table = lru_cache(maxsize=4096)(self._table)
        self._free = lru_cache(maxsize=4096)(self._free_numbers)

    def grown(self, graph: SceneGraph) -> tuple[str, ...]:
        """Return the names of the objects that jumps may change: all but the base."""
        return tuple(name for name in graph.names if name not in self.base)

    def leaves(self, graph: SceneGraph) -> tuple[str, ...]:
        """Return the names of the objects that carry nothing and may die."""
        parents = {vertex.parent for vertex in graph.vertices}
        return tuple(name for name in self.grown(graph) if name not in parents)

    def kind_of(self, vertex: Vertex) -> str:
        """Return the kind of a grown vertex."""
        return next(kind for kind, entry in self.shapes.items() if entry.matches(vertex))

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
        kind = parent if parent == ROOT or parent in self.base else self.kind_of(graph.vertex(parent))
        if kind not in self.prior.offspring:
            return None
        return self.prior.kinds(*self.seat(graph, parent))

    def contacts(self, graph: SceneGraph, parent: str, kind: str) -> Categorical | None:
        """Return the prior of the contact (type, parent face, child face) of a kind on a parent; None: none fits."""
        shape, top = self.seat(graph, parent)
        found = self.prior.contacts.choices(shape, self.shapes[kind].type, top)
        return None if found is None else found[0]

    def table_of(self, graph: SceneGraph, vertex: Vertex) -> Table | None:
        """Return the numbers of a vertex's contact, fixed or with their distributions; None: the prior has no such."""
        contact = vertex.contact
        choice = (contact.type, contact.parent_face, contact.child_face)
        return self.table(*self.seat(graph, vertex.parent), vertex.shape, choice)

    def free_numbers(self, graph: SceneGraph, name: str) -> Mapping[tuple[str, str], Distribution]:
        """Return the prior of each free number of an object, by ("shape" or "contact", name); the base's too."""
        vertex = graph.vertex(name)
        contact = vertex.contact
        choice = (contact.type, contact.parent_face, contact.child_face)
        kind = name if name in self.base else self.kind_of(vertex)
        return self._free(kind, name in self.base, *self.seat(graph, vertex.parent), choice)

    def _free_numbers(self, kind: str, base: bool, parent: str, top: str | None, choice: Choice):
        if base:
            item = cast(GrammarPrior, self.prior).tree.by_name[kind]
            shape = item.shape.free()
            contact = item.contact.free(Contact(*choice), parent, item.shape.type, top)
        else:
            entry = self.shapes[kind]
            shape, table = entry.free(), self.table(parent, top, entry.type, choice) or {}
            contact = {key: value for key, value in table.items() if isinstance(value, Distribution)}
        return {
            **{("shape", key): value for key, value in shape.items()},
            **{("contact", key): value for key, value in contact.items()},
        }

    def _table(self, parent: str, top: str | None, child: str, choice: Choice) -> Table | None:
        found = self.prior.contacts.choices(parent, child, top)
        return dict(found[1][choice]) if found is not None and choice in found[1] else None

    def fresh_name(self, graph: SceneGraph, kind: str) -> str:
        """Return a name that no object has."""
        number = 1
        names = set(graph.names)
        while f"{kind}_{number}" in names:
            number += 1
        return f"{kind}_{number}"


def log_uniform_choice(count: int) -> float:
    """Return the log probability of one among `count`."""
    return -math.log(count) if count > 0 else -math.inf
