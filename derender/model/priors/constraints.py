"""Terms that a prior multiplies in: what the objects of a scene must not do to each other, beyond what edges ensure.

A constraint answers with a log density of at most 0 (Section 2: "additional likelihood terms that penalize violation").
A prior with constraints samples by rejection, exactly; its log density is then known up to one constant.
"""

import math
from collections.abc import Callable
from typing import Protocol

from derender.model.scene import SceneGraph

from derender.errors import DerenderError
from derender.registry import Registry
from derender.yaml_tree import Node, Section

MOST_TRIES = 10_000

constraints: Registry["ConstraintType"] = Registry("constraint", "derender.constraints")


class Constraint(Protocol):
    """One term."""

    def log_density(self, graph: SceneGraph) -> float:
        """Return the term's log density, at most 0; -inf where the scene is ruled out."""
        ...


class ConstraintType:
    """A kind of constraint: reads itself from a file and writes itself."""

    name: str

    def read(self, node: Node | None, names: tuple[str, ...]) -> Constraint:
        """Return the constraint that `node` describes (None: no more was said than its name)."""
        raise NotImplementedError


def total_log_density(terms: tuple[Constraint, ...], graph: SceneGraph) -> float:
    """Return the sum of the terms' log densities."""
    total = 0.0
    for term in terms:
        total += term.log_density(graph)
        if total == -math.inf:
            break
    return total


def sample_until_allowed(rng, sample: Callable, terms: tuple[Constraint, ...]) -> SceneGraph:
    """Draw whole scenes until one is accepted with the probability that its terms give: exact rejection sampling."""
    if not terms:
        return sample(rng)
    for _ in range(MOST_TRIES):
        graph = sample(rng)
        log_probability = total_log_density(terms, graph)
        if log_probability >= 0.0 or rng.random() < math.exp(log_probability):
            return graph
    raise DerenderError(
        f"none of {MOST_TRIES} scenes drawn meets the constraints", remedy="spread the objects out or ask for fewer"
    )


class NoOverlap:
    """No two solids share more than a sliver, whether or not an edge joins them.

    Parameters
    ----------
    depth : metres by which two solids may enter each other; contacts hold only to rounding (and to the prior's slack).
    scale : None rules deeper overlap out; a length makes the log density -(excess depth / scale)^2 / 2 for each pair.
    """

    def __init__(self, depth: float = 0.0005, scale: float | None = None) -> None:
        self.depth = depth
        self.scale = scale

    def log_density(self, graph):
        from derender.model.overlap import overlapping_pairs

        total = 0.0
        for _, _, deep in overlapping_pairs(graph.solids(), self.depth):
            if self.scale is None:
                return -math.inf
            total -= 0.5 * ((deep - self.depth) / self.scale) ** 2
        return total


class DoesNotTouch:
    """Two named objects keep a distance; absent ones do.

    Parameters
    ----------
    first, second : names.
    margin : metres that must lie between them.
    """

    def __init__(self, first: str, second: str, margin: float = 0.001) -> None:
        self.first = first
        self.second = second
        self.margin = margin

    def log_density(self, graph):
        from derender.model.overlap import distance

        names = set(graph.names)
        if self.first not in names or self.second not in names:
            return 0.0
        return 0.0 if distance(graph, self.first, self.second) > self.margin else -math.inf


@constraints.register("no-overlap")
class NoOverlapType(ConstraintType):
    """`no-overlap` or `no-overlap: {depth: 0.5 mm, scale: 1 mm}`."""

    def read(self, node, names):
        if node is None:
            return NoOverlap()
        section = node.section().allow("depth", "scale")
        depth = section["depth"].number("m", lower=0.0) if "depth" in section else 0.0005
        scale = section["scale"].number("m", lower=1e-9) if "scale" in section else None
        return NoOverlap(depth, scale)


@constraints.register("does-not-touch")
class DoesNotTouchType(ConstraintType):
    """`does-not-touch: [a, b]`."""

    def read(self, node, names):
        if node is None:
            raise DerenderError("does-not-touch names no objects", remedy="write does-not-touch: [a, b]")
        first, second = (item.text(names or None) for item in node.sequence(2))
        if first == second:
            raise node.fault("an object cannot keep off itself", "name two objects")
        return DoesNotTouch(first, second)


def read_constraints(node: Node, names: tuple[str, ...]) -> tuple[Constraint, ...]:
    """Read the list under `constraints:`; `names` are the objects that it may speak of (empty: any)."""
    terms = []
    for item in node.sequence():
        if isinstance(item, Section):
            kind, detail = item.only()
            if kind not in constraints:
                item.allow(*constraints)
            terms.append(constraints[kind].read(detail, names))
        else:
            kind = item.text(constraints)
            try:
                terms.append(constraints[kind].read(None, names))
            except DerenderError as error:
                raise item.fault(error.what, error.remedy) from None
    return tuple(terms)
