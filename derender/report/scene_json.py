"""A scene as JSON: the contract that `show --json` prints and every other command that speaks JSON reuses."""

from typing import Any

import numpy as np

from derender.results.posterior import Posterior, StructurePosterior
from derender.scene.graph import SceneGraph


def scene_json(graph: SceneGraph, posterior: Posterior | None = None) -> dict[str, Any]:
    """Return the scene in camera axes: objects with type, full extents, pose, parent, contact.

    graph : the scene; with a posterior, its most probable one.
    posterior : adds `size_interval`, `probability`, `parent_probability` and `type_probability` to each object, and
        `support_probability` to what may have a second support.

    Returns {"frame": "camera", "gravity": [gx, gy, gz] in m/s^2, "objects": [...]}, and of a posterior that was judged
    (results/trust.py) `explained`, `trusted` and `doubts`, and `trusted` of each object; of an object, `size` is the
    three full extents along its own axes in metres, None for what has none; `size_interval` their 90 % intervals, None
        where no draws tell them;
    `pose` is 4x4 row-major, object to camera; `supports`, where there, names what it rests on besides its parent.
    """
    poses, meta = graph.poses(), {} if posterior is None else posterior.meta
    intervals = size_intervals(posterior) if posterior is not None else {}
    objects = []
    for vertex in graph.vertices:
        size = vertex.body.size()
        numbers = {name: float(value) for name, value in vertex.contact.values.items()}
        entry: dict[str, Any] = {
            "name": vertex.name,
            "type": vertex.shape,
            "size": None if size is None else [float(side) for side in size],
            "pose": np.asarray(poses[vertex.name], dtype=float).tolist(),
            "parent": vertex.parent,
            "contact": {"type": vertex.contact.type, **vertex.contact.named_faces, **numbers},
        }
        if vertex.supports:
            entry["supports"] = list(vertex.supports)
        if posterior is not None:
            entry["size_interval"] = intervals.get(vertex.name)
            entry["probability"] = float(posterior.object_probability(vertex.name))
            entry["probability_error"] = float(posterior.object_probability_error(vertex.name))
            entry["parent_probability"] = posterior.parent_probability(vertex.name)
            entry["type_probability"] = posterior.shape_probability(vertex.name)
            if supports := posterior.support_probability(vertex.name):
                entry["support_probability"] = supports
        if "in_doubt" in meta:
            entry["trusted"] = vertex.name not in meta["in_doubt"]
        objects.append(entry)
    judged = {key: meta[key] for key in ("explained", "trusted", "doubts") if key in meta}
    return {"frame": "camera", "gravity": graph.pull().tolist(), "objects": objects, **judged}


INSIDE = 0.9  # probability of an interval
EVERY = 400  # draws of a structure from which a size's range is told, at most


def size_intervals(posterior: Posterior) -> dict[str, list[list[float]] | None]:
    """Return by name the 90 % intervals (low, high), metres, of an object's three full extents along its own axes.

    A structure's draws count with its weight; those without the object say nothing. None for what has no size, and
    for a size that is unknown but of which there is one draw alone; the size twice for what has nothing unknown.
    """
    found: dict[str, list[list[float]] | None] = {}
    for vertex in posterior.best_part.graph.vertices:
        if vertex.body.size() is None:
            found[vertex.name] = None
            continue
        having = [part for part in posterior.parts if vertex.name in part.graph.names]
        if all(part.log_density.size == 1 for part in having) and any(_unknown(part, vertex.name) for part in having):
            found[vertex.name] = None
            continue
        pairs = [(sizes, part.weight) for part in having if (sizes := _sizes(part, vertex.name)) is not None]
        sizes = np.concatenate([each for each, _ in pairs])
        weights = np.concatenate([np.full(len(each), max(weight, 0.0) / len(each)) for each, weight in pairs])
        if not weights.sum() > 0:
            weights = np.ones(len(sizes))
        ends = 0.5 * (1.0 - INSIDE), 0.5 * (1.0 + INSIDE)
        found[vertex.name] = [[weighted_quantile(side, weights, end) for end in ends] for side in sizes.T]
    return found


def _sizes(part: StructurePosterior, name: str) -> np.ndarray | None:
    """Return the full extents (n, 3) of an object in some draws of a structure, evenly spread; None for no extent."""
    vertex = part.graph.vertex(name)
    size = vertex.body.size()
    if size is None:
        return None
    free = _unknown(part, name)
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


def _unknown(part: StructurePosterior, name: str) -> list[tuple[int, str]]:
    """Return (place among the part's numbers, shape parameter) of what is unknown of an object's shape."""
    split = [(place, *address.partition(".")[::2]) for place, address in enumerate(part.addresses)]
    return [(place, own) for place, owner, own in split if owner == name and "." not in own]  # not those of its contact


def weighted_quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    """Return the value below which a share of the weight lies, between neighbours as np.quantile has it."""
    order = np.argsort(values, kind="stable")
    values, weights = values[order], weights[order]
    total = weights.sum()
    at = (np.cumsum(weights) - 0.5 * weights) / total  # the middle of each value's own share
    return float(np.interp(share, at, values))
