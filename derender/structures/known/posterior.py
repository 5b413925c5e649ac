"""A posterior over which known object each solid is, and where: what `infer --known` answers."""

from collections import Counter
from dataclasses import replace

import numpy as np

from derender.detection.search.greedy import Settings
from derender.detection.solids.graph import floating, periods_of, pose_of, scene_graph, turns_freely, vertex_of
from derender.detection.solids.image import Image, rotation_of
from derender.detection.solids.polish import WALK_MOVES, walk
from derender.detection.solids.state import NOTHING, State, in_the_way
from derender.results.posterior import StructurePosterior
from derender.scene.graph import ROOT, SceneGraph, Vertex
from derender.structures.draws.numbers import numbers_at, parameters_of
from derender.structures.known.identities import SCALES, Placed, Placement, identity_probabilities, state_of
from derender.structures.known.library import Known

STEPS = 24  # of each object between two draws
LEAST_LIKELY, MOST_STRUCTURES = 1e-3, 24  # share of the likeliest's weight that one told has; how many, at most
UNKNOWN = "unknown"


def known_posterior(
    rng: np.random.Generator,
    image: Image,
    state: State,
    settings: Settings,
    floor_pose: np.ndarray,
    library: tuple[Known, Known, Known],
    others: bool,
    chains: int,
    draws: int,
) -> list[StructurePosterior]:
    """Return the structures: the most probable identities with full chains, others as they are polished.

    What one object is tells nothing of what another is: the weight of a structure is the product of its identities'.

    state : what the search for solids of unknown sizes found. library : Known objects.
    others : whether solids that are none of them may be there.

    The first part's extras hold `identities`: for each object, the probability of each name of the library.
    """
    placement = Placement(rng, image, state, settings, library, others)
    placed = placement.place()
    options, probabilities = [], []
    for k in range(len(placed)):
        found = placement.identities(placed, k)
        share = identity_probabilities(found, settings.temper)
        placed[k] = found[int(np.argmax(share))][1]
        options.append(found)
        probabilities.append(share)
    placed = placement.settle(placed)
    names = names_of(placed)
    identities = {
        name: {
            item.known.name if item.known else UNKNOWN: float(p)
            for (_, item), p in zip(found, share, strict=True) if p >= LEAST_LIKELY
        }
        for name, found, share in zip(names, options, probabilities, strict=True)
    }  # fmt: skip
    best = part_of_known(rng, placement, placed, names, floor_pose, chains, draws)
    parts = [replace(best, extras={"identities": identities})]
    leading = tuple(int(np.argmax(share)) for share in probabilities)
    total = 1.0 / float(np.prod([share.max() for share in probabilities]))  # of all, told or not
    for chosen, weight in likeliest(probabilities):
        other = [item if number == first else found[number][1]
                 for item, number, first, found in zip(placed, chosen, leading, options, strict=True)]  # fmt: skip
        if chosen != leading and not enough(other):
            total -= weight
        elif chosen != leading:
            kept = [name if new.known is old.known else "" for name, old, new in zip(names, placed, other, strict=True)]
            part = part_of_known(rng, placement, other, names_of(other, kept), floor_pose, 1, 1)
            parts.append(replace(part, weight=weight))
    for worse, instead, anchors in placement.rivals:
        weight = float(np.exp(-worse / settings.temper))
        other = [*(item for item in placed if item.anchor not in anchors), *instead]
        if weight >= LEAST_LIKELY and enough(other):
            total += weight
            part = part_of_known(rng, placement, other, names_of(other), floor_pose, 1, 1)
            parts.append(replace(part, weight=weight))
    return [replace(part, weight=part.weight / total) for part in parts]


def likeliest(shares: list[np.ndarray]) -> list[tuple[tuple[int, ...], float]]:
    """Return (which identity each object has, how probable that is against the likeliest), the likeliest first.

    shares : for each object, the probabilities (n,) of what it may be. Of MOST_STRUCTURES, none below LEAST_LIKELY.
    """
    found: list[tuple[tuple[int, ...], float]] = [((), 1.0)]
    for share in shares:
        further = [((*chosen, number), weight * float(p)) for chosen, weight in found
                   for number, p in enumerate(share / share.max()) if weight * p >= LEAST_LIKELY]  # fmt: skip
        found = sorted(further, key=lambda each: -each[1])[:MOST_STRUCTURES]
    return found


def enough(placed: list[Placed]) -> bool:
    """Whether there are no more of any object than its library has."""
    numbers = Counter(item.known.name for item in placed if item.known is not None)
    return all(item.known is None or numbers[item.known.name] <= item.known.count for item in placed)


def names_of(placed: list[Placed], kept: list[str] | None = None) -> list[str]:
    """Return a name for each: its library's (a second one of the same: name_2), or its shape and a number.

    kept : names that some have already, "" for the others.
    """
    names = [""] * len(placed) if kept is None else list(kept)
    for k, item in enumerate(placed):
        if not names[k]:
            base = item.known.name if item.known else vertex_of(item.row, item.cube, "x").shape
            numbered = [f"{base}_{n}" for n in range(1, len(names) + 2)]
            numbered[0] = base if item.known else numbered[0]
            names[k] = next(name for name in numbered if name not in names)
    return names


def graph_of(placed: list[Placed], parents: list[int], floor_pose: np.ndarray, names: list[str]) -> SceneGraph:
    """Return the scene graph of what was placed."""
    given = {k: Vertex(names[k], item.known.shape, item.known.parameters, ROOT, floating(pose_of_known(item.row)),
                       item.known.options) for k, item in enumerate(placed) if item.known is not None}  # fmt: skip
    state = state_of(placed)
    state.parents = list(parents)
    return scene_graph(state, floor_pose, names, given=given)


def pose_of_known(row: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) of a known object; a mesh keeps its own axes, whatever its proxy."""
    pose = pose_of(row)
    pose[:3, :3] = rotation_of(row)
    return pose


def part_of_known(
    rng: np.random.Generator,
    placement: Placement,
    placed: list[Placed],
    names: list[str],
    floor_pose: np.ndarray,
    chains: int,
    draws: int,
) -> StructurePosterior:
    """Return draws of all numbers under given identities."""
    placed = list(placed)
    parents, bases = placement.parents(placed)
    placed = [replace(item, base=base) for item, base in zip(placed, bases, strict=True)]
    graph = graph_of(placed, parents, floor_pose, names)
    fixed = {f"{name}.{key}" for name, item in zip(names, placed, strict=True) if item.known
             for key in item.known.parameters}  # fmt: skip
    # how a can that carries nothing is turned about itself nothing tells
    fixed |= {f"{vertex.name}.contact.theta" for vertex in graph.vertices
              if turns_freely(vertex) and not graph.children(vertex.name)}  # fmt: skip
    addresses = tuple(a for a in graph.numbers() if a.partition(".")[0] in names and a not in fixed)
    values = np.empty((chains, draws, len(addresses)))
    density = np.empty((chains, draws))
    for chain in range(chains):
        now = list(placed)
        scales = [np.full(WALK_MOVES, 1e-3) if item.known is None else SCALES / 10 for item in now]
        for draw in range(-3, draws):
            for k in rng.permutation(len(now)):
                if draw != 0 or chain != 0:  # the very first draw is the best scene as it was polished
                    now[k] = walk_one(rng, placement, now, k, scales[k], draw < 0)
            if draw == 0 and chain == 0:
                now = list(placed)
            if draw >= 0:
                numbers = numbers_at(graph, floor_pose, places_of(graph, now, names))
                values[chain, draw] = [numbers[a] for a in addresses]
                density[chain, draw] = -placement.view(now)[2].sum() / placement.settings.temper
    return StructurePosterior(graph, addresses, values, np.zeros((chains, draws)), density, 1.0,
                              periods_of(graph, addresses))  # fmt: skip


def walk_one(
    rng: np.random.Generator, placement: Placement, placed: list[Placed], k: int, scale: np.ndarray, adapt: bool
) -> Placed:
    """Return one solid after some Metropolis steps given the others."""
    item, settings, image = placed[k], placement.settings, placement.image
    depth, _, misfit = view = placement.view(placed, k)
    if item.known is None:
        rows = in_the_way(state_of(placed).rows, settings)
        row = walk(rng, image, item.row, item.form, item.cube, rows, k, depth, misfit, item.base, NOTHING,
                   settings.slack, settings.tilt, scale, STEPS, settings.temper, adapt)  # fmt: skip
        return replace(item, row=row)
    row, _ = placement.walked(rng, item.known, item.row, item.base, state_of(placed).rows, k, view, scale, STEPS, 1.0,
                              settings.temper, adapt)  # fmt: skip
    return replace(item, row=row)


def places_of(graph: SceneGraph, placed: list[Placed], names: list[str]) -> dict[str, tuple[np.ndarray, None]]:
    """Return what `numbers_at` takes of what was placed."""
    return {
        name: (pose_of(item.row), parameters_of(item.row, graph.vertex(name).shape)) if item.known is None
        else (pose_of_known(item.row), None)
        for name, item in zip(names, placed, strict=True)
    }  # fmt: skip
