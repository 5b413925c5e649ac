"""Scenes with supports at several heights: each plane with what stands on it has a posterior of its own.

Which pixels show a plane or what stands on it is decided beforehand (`levels.py`); to each all others are background.
Given that, the posterior of all is the product of theirs. A plane on which nothing is found stays background.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from derender.detection.floor import NoFloor
from derender.detection.levels import levels_of, patch_of
from derender.detection.search.greedy import Settings
from derender.detection.search.observation import Observation, Support, of_whole_image
from derender.detection.solids.graph import FLOOR_NAME
from derender.detection.solids.state import State
from derender.results.posterior import StructurePosterior
from derender.scene.graph import ROOT, Contact, SceneGraph, floating
from derender.scene.pose import inverse
from derender.structures.graph_posterior import MOST_PARTS, NEGLIGIBLE

POSE = tuple(floating(np.eye(4)).values)  # the seven numbers of a contact that holds to nothing


def further_supports(
    seen: Observation, state: State, settings: Settings, shape: tuple[int, int], look: Callable[..., Any]
) -> list[tuple[State, Observation]]:
    """Return [(State, Observation)] of further planes on which something stands, the largest first.

    seen, state : of the main plane. settings : how many objects there may be on all. shape : (H, W) of the image as it
    came. look : function of a plane, a Support, and of how many objects there may be on it, that returns both.
    """
    found, left = [(state, seen)], settings.max_objects
    for plane in levels_of(seen):
        if settings.counts_all:
            left = settings.max_objects - sum(len(there) + len(each.things) for there, each in found)
        if left <= 0:
            break
        explained = [~of_whole_image(each.behind, each, shape) for _, each in found]
        try:
            there, other = look(Support(*plane, np.any(explained, axis=0)), left)
        except NoFloor:
            continue
        if not other.no_floor and (len(there) or other.things):
            found.append((there, other))
    return found[1:]


def with_supports(parts: list[StructurePosterior], seen: Observation, others: list[Any]) -> list[StructurePosterior]:
    """Return the StructurePosteriors of all planes together, the likeliest MOST_PARTS, with the products of their
    weights.

    parts, seen : of the main plane. others : [(parts, Observation)] of further ones. The lowest plane is unbounded, as
        a single floor is; of the others that is there which is seen.
    """
    main = seen.floor.pose
    heights = [0.0, *(float((other.floor.pose[:3, 3] - main[:3, 3]) @ main[:3, 2]) for _, other in others)]
    patches = [None if height == min(heights) else patch_of(each)
               for height, each in zip(heights, (seen, *(other for _, other in others)), strict=True)]  # fmt: skip
    parts = [replace(part, graph=bounded(part.graph, FLOOR_NAME, patches[0])) for part in parts]
    for number, (more, _) in enumerate(others, start=2):
        names = new_names(parts, more, number)
        more = [renamed(part, names, patches[number - 1]) for part in more]
        pairs = sorted(product(parts, more), key=lambda pair: -pair[0].weight * pair[1].weight)
        least = np.exp(-NEGLIGIBLE) * pairs[0][0].weight * pairs[0][1].weight
        pairs = [(a, b) for a, b in pairs if a.weight * b.weight > least][:MOST_PARTS]
        parts = [multiplied(a, b, a.weight * b.weight) for a, b in pairs]
    return parts


def bounded(graph: SceneGraph, name: str, patch: list[float] | None) -> SceneGraph:
    """Return a graph in which a plane is there as far as a patch reaches; None: everywhere."""
    return graph if patch is None or name not in graph.names else graph.replace(name, options={"patch": patch})


def new_names(parts: list[StructurePosterior], more: list[StructurePosterior], number: int) -> Any:
    """Return {name: new name} of what the parts of another plane have: counted on where the first parts' names end."""
    last: dict[str, int] = {}
    for part in parts:
        for name in part.graph.names:
            shape, _, count = name.rpartition("_")
            if shape and count.isdigit():
                last[shape] = max(last.get(shape, 0), int(count))
    names = {FLOOR_NAME: FLOOR_NAME if number == 1 else f"support_{number}"}
    for part in more:
        for name in part.graph.names:
            shape, _, count = name.rpartition("_")
            if name != FLOOR_NAME:
                names[name] = f"{shape}_{last.get(shape, 0) + int(count)}" if count.isdigit() else f"{name}_{number}"
    return names


def renamed(part: StructurePosterior, names: Any, patch: list[float] | None) -> StructurePosterior:
    """Return a StructurePosterior with other names, its plane as far as a patch reaches."""
    graph = bounded(part.graph, FLOOR_NAME, patch).renamed(names)
    addresses = tuple(f"{names.get(name, name)}{dot}{rest}" for name, dot, rest in
                      (address.partition(".") for address in part.addresses))  # fmt: skip
    return replace(part, graph=graph, addresses=addresses)


def multiplied(part: StructurePosterior, other: StructurePosterior, weight: float) -> StructurePosterior:
    """Return the StructurePosterior of two planes' together: draws of each, independent of the other's, the best of
    both one draw. What hung on the other's root, its plane first, hangs on the first one's."""
    shape = max(part.log_density.shape, other.log_density.shape, key=np.prod)
    first, second = (as_one_chain(each, int(np.prod(shape))) for each in (part, other))
    order = np.arange(first.log_density.size)
    ends = [int(np.argmax(first.log_density)), int(np.argmax(second.log_density))]
    order[ends] = order[ends[::-1]]
    second = second.at((slice(None), order))
    hanging = [vertex.name for vertex in second.graph.vertices if vertex.parent == ROOT]
    numbers = hung_anew(first, second, hanging)
    second = second.only([k for k, address in enumerate(second.addresses)
                          if not address.startswith(tuple(f"{name}.contact." for name in hanging))])  # fmt: skip
    hung = [Contact("6dof", values=dict(zip(POSE, map(float, pose), strict=True))) for pose in numbers[:, ends[0]]]
    graph = second.graph
    for name, contact in zip(hanging, hung, strict=True):
        graph = graph.replace(name, contact=contact)
    both = replace(
        first,
        graph=first.graph.add(*graph.vertices),
        addresses=(*first.addresses, *second.addresses, *(f"{name}.contact.{key}" for name in hanging for key in POSE)),
        values=np.concatenate([first.values, second.values, *numbers[:, None]], axis=2),
        periods=(),
        log_prior=first.log_prior + second.log_prior,
        log_likelihood=first.log_likelihood + second.log_likelihood,
        weight=weight,
        weight_error=float(np.hypot(part.weight_error * other.weight, other.weight_error * part.weight)),
        weight_interval=None,
    )  # fmt: skip
    return both.at((np.zeros(shape, int), np.arange(order.size).reshape(shape)))


def as_one_chain(part: StructurePosterior, count: int) -> StructurePosterior:
    """Return a StructurePosterior with so many of its draws in one chain, each as often as the others, or nearly."""
    chains, draws = np.unravel_index(np.resize(np.arange(part.log_density.size), count), part.log_density.shape)
    return part.at((chains[None], draws[None]))


def hung_anew(part: StructurePosterior, other: StructurePosterior, names: list[str]) -> np.ndarray:
    """Return (K, draws, 7) the poses of what hangs on another's root, over the root of part's draw of the same number.
    part, other : of one chain each. names : of the K vertices."""
    found = np.empty((len(names), part.log_density.size, len(POSE)))
    for draw in range(part.log_density.size):
        poses = other.graph_at(0, draw).poses()
        root = part.graph.root_pose if part.root_pose is None else part.root_pose[0, draw]
        for k, name in enumerate(names):
            values = floating(inverse(np.asarray(root)) @ poses[name]).values
            found[k, draw] = [values[key] for key in POSE]
    return found
