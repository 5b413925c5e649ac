"""Physics as knowledge about the image: what was photographed stands, so that scenes that could not are ruled out.

`stands: true` under `constraints:` multiplies the prior by one where contact forces can balance every weight and by
zero elsewhere. A posterior under it is the posterior without it, restricted to the draws that stand: that is exact, and
costs one test of statics for each draw instead of one for each step of a chain.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.physics.bodies import matter_of_graph
from derender.physics.statics import Equilibrium
from derender.results.posterior import Posterior, StructurePosterior
from derender.scene.codec.yaml_tree import Node
from derender.scene.graph import SceneGraph
from derender.scene.priors.terms import term_types

# Chains are kept apart where the poorest keeps at least this share of what the richest does; else they become one.
ALIKE = 0.5


@term_types.register("stands")
class Stands:
    """Contact forces can hold the whole scene at rest: `stands: true`."""

    name: str

    def log_density(self, graph: SceneGraph) -> float:
        return 0.0 if Equilibrium(matter_of_graph(graph)).stands else -math.inf

    @classmethod
    def read(cls, node: Node | None, names: tuple[str, ...]) -> "Stands":
        if node is not None and not node.boolean():
            raise node.fault("a scene that need not stand needs no constraint", "write stands: true, or leave it out")
        return cls()


def without_stands(prior: Any) -> tuple[Any, bool]:
    """Return a prior without the constraint that its scenes stand, and whether it had one."""
    terms = getattr(prior, "constraints", ())
    others = tuple(term for term in terms if not isinstance(term, Stands))
    return (replace(prior, constraints=others), True) if len(others) < len(terms) else (prior, False)


def assume_stable(posterior: Posterior) -> tuple[Posterior, float]:
    """Return a posterior given that the scene stands, and how probable that was before.

    The weight of each structure is multiplied by the share of its draws that stand; the others' draws are dropped.

    Raises DerenderError : no draw stands.
    """
    found = []
    for part in posterior.parts:
        stands = [
            Equilibrium(matter_of_graph(part.graph_at(*each))).stands for each in np.ndindex(part.log_density.shape)
        ]
        found.append((part, np.reshape(stands, part.log_density.shape)))
    weights = [part.weight * float(mask.mean()) for part, mask in found]
    total = sum(weights)
    if total <= 0.0:
        raise DerenderError("no draw of the posterior stands", "--assume-stable", "infer without it, and look")
    known = sum(part.weight for part in posterior.parts)  # less than one where a search may have missed something
    share = total / known
    parts = tuple(
        replace(_kept(part, mask), weight=known * weight / total)
        for (part, mask), weight in zip(found, weights, strict=True)
        if weight > 0
    )
    return replace(posterior, parts=parts, meta={**posterior.meta, "p_stands_before": share}), share


def _kept(part: StructurePosterior, mask: np.ndarray) -> StructurePosterior:
    """Return a part with the draws of the mask (chains, draws) alone, as many in each chain."""
    if mask.all():
        return part
    counts = mask.sum(axis=1)
    if counts.min() >= ALIKE * counts.max():
        least = int(counts.min())
        chosen = [np.flatnonzero(row)[np.linspace(0, n - 1, least).round().astype(int)]
                  for row, n in zip(mask, counts, strict=True)]  # fmt: skip
        place: Any = (np.arange(len(mask))[:, None], np.array(chosen))
    else:
        rows, columns = np.nonzero(mask)
        place = (rows[None], columns[None])
    return part.at(place)
