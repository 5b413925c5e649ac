"""The unit of length in which an image is searched: one of a hall, or of coins, is looked at as though of a table.

What is believed of sizes, gaps and noise before an image is seen is a table's. From far off people look at larger
things, and a sensor's noise grows with the distance too: so the prior's lengths are counted in a unit u, which has a
prior of its own, log-normal about its median m, and the camera stands between a and b of them away (`unit` and
`seen_from` in data/priors/bare-image.yaml). How far away that is in metres, D, the image tells: all u in
[D / b, D / a] are possible, and of these the likeliest is taken, the one nearest to m. It is held there.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from derender.render.likelihoods import likelihoods
from derender.results.posterior import Posterior, StructurePosterior
from derender.scene.distributions import Distribution
from derender.scene.graph import SceneGraph
from derender.scene.priors.bare_image import Loose
from derender.scene.shapes import shapes

SHARE = 0.25  # of the pixels are nearer than what counts: there may be a room behind a table
SAME = 1e-9


def unit_of(depth: np.ndarray, loose: Loose) -> float:
    """Return the unit in metres for a depth image (H, W), NaN = no return. loose : of the prior, see Loose."""
    seen = depth[np.isfinite(depth)]
    middle = loose.unit.quantile(0.5) if isinstance(loose.unit, Distribution) else loose.unit
    if len(seen) == 0 or not isinstance(loose.unit, Distribution):
        return middle
    distance, (nearest, farthest) = float(np.quantile(seen, SHARE)), loose.seen_from
    unit = float(np.clip(middle, distance / farthest, distance / nearest))
    return 1.0 if abs(unit - 1.0) < SAME else unit


def in_metres(posterior: Posterior, unit: float) -> Posterior:
    """Return a Posterior whose lengths were counted in units of so many metres with all of them in metres."""
    parts = tuple(part_in_metres(part, unit) for part in posterior.parts)
    meta = dict(posterior.meta)
    meta["noise"] *= unit
    meta["faces"] *= unit
    meta["other_floors"] = [{**each, "plane": (*each["plane"][:3], each["plane"][3] * unit)}
                            for each in meta.get("other_floors", [])]  # fmt: skip
    meta["likelihood"] = likelihood_in_metres(meta["likelihood"], unit)
    explanation = posterior.explanation
    if explanation is not None:
        explanation = explanation._replace(depth=explanation.depth * np.float32(unit))
    return replace(posterior, parts=parts, meta=meta, explanation=explanation)


def part_in_metres(part: StructurePosterior, unit: float) -> StructurePosterior:
    """Return a StructurePosterior with all lengths in metres; its log densities keep their unit."""
    lengths, numbers = lengths_of(part.graph), part.graph.numbers()
    graph = part.graph.with_numbers({k: v * unit if k in lengths else v for k, v in numbers.items()})
    extras = dict(part.extras)
    if "likelihood" in extras:
        extras["likelihood"] = likelihood_in_metres(extras["likelihood"], unit)
    part = stretched(part, np.full(part.log_density.shape, unit))
    return replace(part, graph=replace(graph, root_pose=farther(graph.root_pose, unit)), extras=extras)


def scale_drawn(rng: np.random.Generator, part: StructurePosterior, scale: float) -> StructurePosterior:
    """Return a StructurePosterior whose draws have the sensor's scale open, all but the best; scale : see Loose."""
    factors = np.exp(scale * rng.standard_normal(part.log_density.shape))
    factors.flat[part.log_density.argmax()] = 1.0
    return stretched(part, factors)


def stretched(part: StructurePosterior, factors: np.ndarray) -> StructurePosterior:
    """Return a StructurePosterior whose draws are so many times as large, and as far from the camera, each by a factor
    (chains, draws) of its own."""
    factors, lengths = factors[..., None], lengths_of(part.graph)
    values = part.values * np.where([address in lengths for address in part.addresses], factors, 1.0)
    root = part.graph.root_pose if part.root_pose is None else part.root_pose
    roots = farther(np.broadcast_to(root, (*factors.shape[:2], 4, 4)), factors)
    return replace(part, values=values, root_pose=roots, apparent=None)


def farther(pose: np.ndarray, factor: float | np.ndarray) -> np.ndarray:
    """Return poses (..., 4, 4) with their places so many times as far away."""
    pose = np.array(pose, float)
    pose[..., :3, 3] *= factor
    return pose


def lengths_of(graph: SceneGraph) -> set[str]:
    """Return the addresses of a graph's numbers that are lengths."""
    found = {f"{vertex.name}.{parameter.name}" for vertex in graph.vertices
             for parameter in shapes[vertex.shape].parameters if parameter.unit == "m"}  # fmt: skip
    return found | {f"{name}.contact.{parameter.name}" for name in graph.names
                    for parameter in graph.contact_parameters(name) if parameter.unit == "m"}  # fmt: skip


def likelihood_in_metres(numbers: Any, unit: float) -> dict[str, float | str]:
    """Return a likelihood's type and numbers, as a scene file has them, with lengths in metres, in their ranges."""
    powers = {"m": 1, "1/m": -1}
    known = {p.name: (powers.get(p.unit, 0), p.lower, p.upper) for p in likelihoods[numbers["type"]].parameters}
    scaled = {k: float(np.clip(numbers[k] * unit**power, *ends)) for k, (power, *ends) in known.items() if k in numbers}
    return {**numbers, **scaled}
