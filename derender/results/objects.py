"""What a posterior knows of each object of its most probable scene beside the probability: the range of its size.

`show --json`, `summary.json`, tables and pages all take it from here.
"""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from derender.results.posterior import Posterior, StructurePosterior

INSIDE = 0.9  # probability of an interval
EVERY = 400  # draws of a structure from which a size's range is told, at most


def size_intervals(posterior: "Posterior") -> dict[str, list[list[float]] | None]:
    """Return the 90 % interval of each full extent of each object of the most probable scene, along its own axes.

    A structure's draws count with its weight; those without the object say nothing. None for what has no size; the size
    twice for what has nothing unknown.

    Returns
    -------
    {name: [[low, high], [low, high], [low, high]] in metres, or None}
    """
    found: dict[str, list[list[float]] | None] = {}
    for vertex in posterior.best_part.graph.vertices:
        told = [_sizes(part, vertex.name) for part in posterior.parts if vertex.name in part.graph.names]
        with_weight = [part.weight for part in posterior.parts if vertex.name in part.graph.names]
        pairs = [(sizes, weight) for sizes, weight in zip(told, with_weight, strict=True) if sizes is not None]
        if vertex.body.size() is None or not pairs:
            found[vertex.name] = None
            continue
        sizes = np.concatenate([each for each, _ in pairs])
        weights = np.concatenate([np.full(len(each), max(weight, 0.0) / len(each)) for each, weight in pairs])
        if not weights.sum() > 0:
            weights = np.ones(len(sizes))
        low, high = 0.5 * (1.0 - INSIDE), 0.5 * (1.0 + INSIDE)
        found[vertex.name] = [
            [weighted_quantile(sizes[:, axis], weights, low), weighted_quantile(sizes[:, axis], weights, high)]
            for axis in range(3)
        ]
    return found


def _sizes(part: "StructurePosterior", name: str) -> np.ndarray | None:
    """Return the full extents (n, 3) of an object in some draws of a structure, evenly spread; None for no extent."""
    vertex = part.graph.vertex(name)
    size = vertex.body.size()
    if size is None:
        return None
    prefix = f"{name}."
    free = [(i, address[len(prefix) :]) for i, address in enumerate(part.addresses) if address.startswith(prefix)]
    free = [(i, parameter) for i, parameter in free if "." not in parameter]  # not those of its contact
    if not free:
        return np.asarray(size, float)[None]
    draws = part.values.reshape(-1, part.values.shape[-1])
    draws = draws[np.unique(np.linspace(0, len(draws) - 1, min(len(draws), EVERY)).round().astype(int))]
    places = {parameter.name: place for place, parameter in enumerate(vertex.body.shape.parameters)}
    psi, extents = vertex.psi, []
    for draw in draws:
        for i, parameter in free:
            psi[places[parameter]] = draw[i]
        extents.append(vertex.body._replace(psi=psi).size())
    return np.array(extents, float)


def weighted_quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    """Return the value below which a share of the weight lies, between neighbours as np.quantile has it."""
    order = np.argsort(values, kind="stable")
    values, weights = values[order], weights[order]
    total = weights.sum()
    at = (np.cumsum(weights) - 0.5 * weights) / total  # the middle of each value's own share
    return float(np.interp(share, at, values))
