"""Why a prior gives a scene no density: what a person asks who sees -inf."""

import math
from collections.abc import Iterator
from typing import Any

from derender.scene.graph import SceneGraph
from derender.scene.priors.base import Prior
from derender.scene.priors.tree import TreePrior
from derender.scene.priors.values import QUATERNION


def why_impossible(prior: Prior, graph: SceneGraph) -> str | None:
    """Return in a few words what rules a scene out under a prior: the first cause found; None where nothing does."""
    if prior.log_density(graph) > -math.inf:
        return None
    return next(_causes(prior, graph), "its objects, or what rests on what, are none that this prior makes")


def _causes(prior: Any, graph: SceneGraph) -> Iterator[str]:
    always = getattr(prior, "tree", prior)
    names = always.by_name if isinstance(always, TreePrior) else {}
    for name in names:
        if name not in graph.names:
            yield f"it has no {name}, which this prior always has"
            return
    if isinstance(prior, TreePrior):
        for name in graph.names:
            if name not in names:
                yield f"it has {name}, which this prior has not"
                return
    if prior.root.log_density(graph.root_pose) == -math.inf:
        yield "the root does not stand before the camera where this prior puts it"
    for vertex in graph.vertices:
        kinds = [] if vertex.name in names else [entry.type for entry in prior.shapes.values()]
        if kinds and vertex.shape not in kinds:
            yield f"{vertex.name} is a {vertex.shape}, and this prior makes only {', '.join(sorted(set(kinds)))}"
        if vertex.supports and vertex.name not in names:
            yield f"{vertex.name} has a second support, and this prior makes none"
    for term in prior.constraints:
        if term.log_density(graph) == -math.inf:
            yield f"it breaks the constraint {term.name}"
    numbers = graph.numbers()
    for address, law in prior.free_addresses(graph).items():
        if address.startswith("root.") or address.endswith(QUATERNION) or address not in numbers:
            continue
        if law.log_density(numbers[address]) == -math.inf:
            low, high = law.support
            yield f"{address} is {numbers[address]:.4g}, outside of {low:.4g} to {high:.4g}"
