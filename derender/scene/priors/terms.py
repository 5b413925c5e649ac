"""Terms that a prior multiplies in: what objects must not do to each other, beyond what edges ensure.

A term answers with a log density of at most 0 (Section 2: "additional likelihood terms that penalize violation").
A prior with terms samples by rejection, exactly; its log density is then known up to one constant.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from derender.compilation.cache import njit
from derender.errors import DerenderError, at_fault
from derender.registry import Registry
from derender.scene.codec.yaml_tree import Node, Section
from derender.scene.graph import Constraint, SceneGraph
from derender.scene.separation import penetration_of, rest_residual, separation_of
from derender.scene.shapes import shapes

MOST_TRIES = 10_000
ROUNDING = 1e-9  # metres to which an exact contact holds

term_types: Registry[Any] = Registry(
    "constraint", "derender.constraints", late=("derender.physics.constraint",), make=lambda term: term
)


class Term(Protocol):
    """One term. A kind of them is a class under `@term_types.register(name)` that also has `read(node, names)`.

    `read`, a class method, returns the term that a node of the file describes (None: no more was said than its name);
    names : the objects that it may speak of.
    """

    name: str  # as it stands under `constraints:`

    def log_density(self, graph: SceneGraph) -> float:
        """Return the term's log density, at most 0; -inf where the scene is ruled out."""
        ...


OVERLAP, APART, RESTS = range(3)  # codes of what a row is of
TERM, ONE, OTHER, LENGTH, SOFTNESS, BEARER, AXIS = range(7)  # columns of a row; an axis is the last three
COLUMNS = AXIS + 3


class OfPairs:
    """What terms share that are sums over pairs of solids, which compiled code knows too."""

    def rows(self, graph: SceneGraph, names: Sequence[str]) -> list[tuple[float, ...]]:
        """Return a row of COLUMNS for each pair, the objects told by their places among `names`."""
        raise NotImplementedError

    def log_density(self, graph: SceneGraph) -> float:
        solids, table = graph.solids(), np.array(self.rows(graph, graph.solid_names), float).reshape(-1, COLUMNS)
        kinds, poses, sizes = solids.kind.astype(np.int64), solids.pose.astype(float), solids.size.astype(float)
        return float(sum_of_terms(table, kinds, poses, sizes))


def table_of(terms: tuple[Term, ...], graph: SceneGraph, names: Sequence[str]) -> np.ndarray:
    """Return (T, COLUMNS) float64, the rows of all terms of pairs. Raises NotImplementedError where one is none."""
    rows: list[tuple[float, ...]] = []
    for term in terms:
        if isinstance(term, OfPairs):
            rows += term.rows(graph, names)
        elif not (isinstance(term, NoFloating | AtMost) and term.log_density(graph) == 0.0):  # of structures alone
            raise NotImplementedError(term.name)
    return np.array(rows, float).reshape(-1, COLUMNS)


@njit(cache=True, nogil=True)
def sum_of_terms(terms, kinds, poses, sizes):
    """Return the log density of terms (T, COLUMNS) where objects have kinds (N,), poses (N, 4, 4) and extents (N, 3).

    A hard term has the softness 0.
    """
    total = 0.0
    for t in range(terms.shape[0]):
        row = terms[t]
        a, b = int(row[ONE]), int(row[OTHER])
        if row[TERM] == OVERLAP:
            excess = penetration_of(kinds[a], poses[a], sizes[a], kinds[b], poses[b], sizes[b]) - row[LENGTH]
            if excess > 0.0:
                if row[SOFTNESS] == 0.0:
                    return -math.inf
                total -= 0.5 * (excess / row[SOFTNESS]) ** 2
        elif row[TERM] == APART:
            if separation_of(kinds[a], poses[a], sizes[a], kinds[b], poses[b], sizes[b]) <= row[LENGTH]:
                return -math.inf
        else:
            p = poses[int(row[BEARER])]
            x = p[0, 0] * row[AXIS] + p[0, 1] * row[AXIS + 1] + p[0, 2] * row[AXIS + 2]
            y = p[1, 0] * row[AXIS] + p[1, 1] * row[AXIS + 1] + p[1, 2] * row[AXIS + 2]
            z = p[2, 0] * row[AXIS] + p[2, 1] * row[AXIS + 1] + p[2, 2] * row[AXIS + 2]
            away = rest_residual(kinds[a], poses[a], sizes[a], kinds[b], poses[b], sizes[b], x, y, z)
            total -= 0.5 * (away / row[SOFTNESS]) ** 2
    return total


def total_log_density(terms: tuple[Term, ...], graph: SceneGraph) -> float:
    """Return the sum of the terms' log densities."""
    total = 0.0
    for term in terms:
        total += term.log_density(graph)
        if total == -math.inf:
            break
    return total


def with_relations(terms: tuple[Term, ...], graph: SceneGraph) -> SceneGraph:
    """Return the scene with what the terms say of named objects, which scenes record."""
    relations = tuple(term.relation for term in terms if isinstance(term, DoesNotTouch))
    return replace(graph, constraints=relations) if relations else graph


def sample_until_allowed(rng: np.random.Generator, sample: Callable, terms: tuple[Term, ...]) -> SceneGraph:
    """Draw whole scenes until one is accepted with the probability that its terms give: exact rejection sampling."""
    if not terms:
        return sample(rng)
    for _ in range(MOST_TRIES):
        graph = sample(rng)
        log_probability = total_log_density(terms, graph)
        if log_probability >= 0.0 or rng.random() < math.exp(log_probability):
            return with_relations(terms, graph)
    raise DerenderError(
        f"none of {MOST_TRIES} scenes drawn meets the constraints", remedy="spread the objects out or ask for fewer"
    )


@term_types.register("no-overlap")
@dataclass(eq=False)
class NoOverlap(OfPairs):
    """No two solids enter each other: `no-overlap`, or `no-overlap: {depth: 0.5 mm, scale: 1 mm}`.

    It does not matter whether an edge joins them.

    depth : metres by which two solids may enter each other: contacts hold only to rounding and to the prior's slack.
    scale : None rules deeper overlap out; a length makes the log density -(excess depth / scale)^2 / 2 for each pair.
    """

    name: str = field(init=False)
    depth: float = 0.0005
    scale: float | None = None

    def rows(self, graph: SceneGraph, names: Sequence[str]) -> list[tuple[float, ...]]:
        solids = [names.index(name) for name in graph.solid_names]
        rule = (self.depth, self.scale or 0.0, 0, 0, 0, 0)
        return [(OVERLAP, a, b, *rule) for a in solids for b in solids if b < a]

    @classmethod
    def read(cls, node: Node | None, names: tuple[str, ...]) -> Term:
        if node is None:
            return cls()
        section, least = node.section().allow("depth", "scale"), {"depth": 0.0, "scale": 1e-9}
        return cls(**{key: section[key].number("m", lower=lower) for key, lower in least.items() if key in section})


@term_types.register("does-not-touch")
@dataclass(eq=False)
class DoesNotTouch(OfPairs):
    """Two objects keep a distance: `does-not-touch: [a, b]`, or `{objects: [a, b], margin: 5 mm}`."""

    name: str = field(init=False)
    relation: Constraint  # the scene's own record of it, with the margin in metres that must lie between their surfaces

    @property
    def least(self) -> float:
        """Metres that two objects which rest on each other never are apart, and those that keep the margin are."""
        return max(self.relation.margin, ROUNDING)

    def rows(self, graph: SceneGraph, names: Sequence[str]) -> list[tuple[float, ...]]:
        pair = self.relation.first, self.relation.second
        there = set(pair) <= set(graph.solid_names)
        return [(APART, *map(names.index, pair), self.least, 0, 0, 0, 0, 0)] if there else []

    @classmethod
    def read(cls, node: Node | None, names: tuple[str, ...]) -> Term:
        first, second, margin = _read_pair(node, names, "does-not-touch", "margin", 0.0)
        return cls(Constraint(first, second, margin=margin or 0.0))


@term_types.register("rests-on")
@dataclass(eq=False)
class RestsOn(OfPairs):
    """An object rests on a second one too: `rests-on: [deck, pier]`, or `{objects: [deck, pier], slack: 2 mm}`.

    `supports: [pier]` in an object's entry says the same, with a slack of 1 mm. The log density is
    -(residual / slack)^2 / 2, see `separation.rest_residual`: up is the normal of the face that it rests on, so its
    other support ends at the same height and lies below it.
    """

    name: str = field(init=False)
    child: str
    support: str
    slack: float = 0.001  # metres

    def bearing(self, graph: SceneGraph) -> tuple[str, np.ndarray]:
        """Return the parent, and the direction (3,) that is up in its axes."""
        vertex = graph.vertex(self.child)
        face = vertex.contact.parent_face
        if face is None:
            what = f"{self.child} has a second support and hangs on {vertex.parent} without resting on a face"
            raise DerenderError(what, remedy="give it a parent and a contact such as face-to-face")
        return vertex.parent, graph.body(vertex.parent).face(face).frame[:3, 2]

    def rows(self, graph: SceneGraph, names: Sequence[str]) -> list[tuple[float, ...]]:
        parent, axis = self.bearing(graph)
        pair = map(names.index, (self.child, self.support))
        return [(RESTS, *pair, 0.0, self.slack, names.index(parent), *axis)]

    @classmethod
    def read(cls, node: Node | None, names: tuple[str, ...]) -> Term:
        child, support, slack = _read_pair(node, names, "rests-on", "slack", 1e-6)
        return cls(child, support, 0.001 if slack is None else slack)


@term_types.register("at-most")
@dataclass(eq=False)
class AtMost:
    """No more than so many objects, floors and frames not counted: `at-most: 4`."""

    name: str = field(init=False)
    count: int

    def log_density(self, graph: SceneGraph) -> float:
        bounded = sum(shapes[vertex.shape].bounded for vertex in graph.vertices)
        return 0.0 if bounded <= self.count else -math.inf

    @classmethod
    def read(cls, node: Node | None, names: tuple[str, ...]) -> Term:
        if node is None:
            raise DerenderError("at-most says no number", remedy="write at-most: 4")
        return cls(node.integer(lower=0))


@term_types.register("no-floating")
class NoFloating:
    """No solid hangs in the air, placed freely (`6dof`): `no-floating`."""

    name: str

    def log_density(self, graph: SceneGraph) -> float:
        free = any(vertex.contact.type == "6dof" and shapes[vertex.shape].bounded for vertex in graph.vertices)
        return -math.inf if free else 0.0

    @classmethod
    def read(cls, node: Node | None, names: tuple[str, ...]) -> Term:
        if node is not None:
            raise node.fault("no-floating takes no value", "write no-floating alone")
        return cls()


def _read_pair(
    node: Node | None, names: tuple[str, ...], term: str, key: str, lower: float
) -> tuple[str, str, float | None]:
    """Return two objects by name, and the length in metres that stands under `key` where one does."""
    if node is None:
        raise DerenderError(f"{term} names no objects", remedy=f"write {term}: [a, b]")
    pair, length = node, None
    if isinstance(node, Section):
        pair = node.allow("objects", key)["objects"]
        length = node[key].number("m", lower=lower) if key in node else None
    first, second = (item.text(names) for item in pair.sequence(2))
    if first == second:
        raise node.fault(f"{term} names {first} twice", "name two objects")
    return first, second, length


def read_terms(node: Node, names: tuple[str, ...]) -> tuple[Term, ...]:
    """Read the list under `constraints:`; `names` are the objects that it may speak of."""
    found = []
    for item in node.sequence():
        if isinstance(item, Section):
            kind, detail = item.only()
            item.allow(*term_types)
            found.append(term_types[kind].read(detail, names))
            continue
        kind = item.text(term_types)
        with at_fault(item.where):
            found.append(term_types[kind].read(None, names))
    return tuple(found)
