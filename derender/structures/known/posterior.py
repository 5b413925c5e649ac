"""A posterior over which known object each solid is, and where: what `infer --known` answers."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from derender.compilation.threads import THREADS
from derender.detection.search.greedy import Settings
from derender.detection.solids.graph import scene_graph, shape_of, turns_freely
from derender.detection.solids.image import Image, rotation_of
from derender.detection.solids.polish import SIZE_SPREAD, TYPICAL_SIZE
from derender.detection.solids.state import State
from derender.posterior.kernels import mixture
from derender.posterior.sampler import MixtureSampler
from derender.posterior.target import ObservedImage, SceneTarget, default_parts
from derender.render.likelihoods import likelihoods
from derender.render.raycast.depth import render_depth
from derender.results.posterior import StructurePosterior
from derender.sampling.chains import Plan
from derender.scene.distributions import Distribution, distributions
from derender.scene.graph import ROOT, SceneGraph, Vertex, floating, relative_pose
from derender.scene.pose import from_axes
from derender.scene.priors.objects import QUATERNION, ROTATION
from derender.structures.known.identities import SHOWN, Placed, Placement, identity_probabilities, state_of
from derender.structures.known.library import GAP, Known
from derender.structures.parts import LEAST_LIKELY, likeliest, part_of, part_of_one, run_until_agreed
from derender.structures.unexplained import spots_left

Seen = Callable[[SceneGraph], ObservedImage]

WARMUP = 400  # rounds of the chains before their first draw, in which steps shrink from centimetres to what images tell
MOST_TIMES = 32  # the draws that are usual, of chains that go on because they disagree: those are cheap, searches dear
DIFFERENCE = 1e-6  # of a number of a contact, by which metres for each of it are told
EIGHTH = 0.25 * math.pi  # of a turn: farther on a box is another one, its length and width swapped
NEAR = 0.1  # metres along a floor from where an object was placed that it may be
UNKNOWN = "unknown"


def known_posterior(
    rng: np.random.Generator,
    image: Image,
    whole: Image,
    state: State,
    settings: Settings,
    floor_pose: np.ndarray,
    seen: Seen,
    library: tuple[Known, Known, Known],
    others: bool,
    chains: int,
    draws: int,
    goes_on: bool = False,
) -> list[StructurePosterior]:
    """Return the structures: the most probable identities with full chains, others as they are polished, the weight of
    each the product of its identities'. The first part's extras hold `identities`: the probabilities of each object's
    names.

    image, whole : as it is searched, and as it came. state : what the search for solids of unknown sizes found.
    seen : from a scene to the whole image bound to the likelihood that it suggests given that scene.
    others : whether solids that are none of the library's may be there.
    goes_on : whether chains that disagree after so many draws make more.
    """
    placement = Placement(rng, image, whole, state, settings, library, others)
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
    most = MOST_TIMES * draws if goes_on else draws
    best = part_of_known(rng, placement, placed, names, floor_pose, seen, chains, draws, most)
    parts = [replace(best, extras={**best.extras, "identities": identities})]
    leading = tuple(int(np.argmax(share)) for share in probabilities)
    total = 1.0 / float(np.prod([share.max() for share in probabilities]))  # of all, told or not
    for chosen, weight in likeliest(probabilities):
        other = [item if number == first else found[number][1]
                 for item, number, first, found in zip(placed, chosen, leading, options, strict=True)]  # fmt: skip
        if chosen != leading and not enough(other):
            total -= weight
        elif chosen != leading:
            kept = [name if new.known is old.known else "" for name, old, new in zip(names, placed, other, strict=True)]
            part = part_of_known(rng, placement, other, names_of(other, kept), floor_pose, seen, 1, 1)
            parts.append(replace(part, weight=weight))
    for worse, instead, anchors in placement.rivals:
        weight = float(np.exp(-worse / settings.temper))
        other = [*(item for item in placed if item.anchor not in anchors), *instead]
        if weight >= LEAST_LIKELY and enough(other):
            total += weight
            part = part_of_known(rng, placement, other, names_of(other), floor_pose, seen, 1, 1)
            parts.append(replace(part, weight=weight))
    return [replace(part, weight=part.weight / total) for part in parts]


def enough(placed: list[Placed]) -> bool:
    """Whether there are no more of any object than its library has."""
    numbers = Counter(item.known.name for item in placed if item.known is not None)
    return all(item.known is None or numbers[item.known.name] <= item.known.count for item in placed)


def names_of(placed: list[Placed], kept: list[str] | None = None) -> list[str]:
    """Return a name for each: its library's (a second one of the same: name_2), or its shape and a number.
    kept : names that some have already, "" for the others."""
    names = [""] * len(placed) if kept is None else list(kept)
    for k, item in enumerate(placed):
        if not names[k]:
            base = item.known.name if item.known else shape_of(item.solid)
            numbered = [f"{base}_{n}" for n in range(1, len(names) + 2)]
            numbered[0] = base if item.known else numbered[0]
            names[k] = next(name for name in numbered if name not in names)
    return names


def graph_of(placed: list[Placed], floor_pose: np.ndarray, names: list[str]) -> SceneGraph:
    """Return the scene graph of what was placed."""
    # a mesh keeps its own axes, whatever its proxy
    given = {k: Vertex(names[k], item.known.shape, item.known.parameters, ROOT,
                       floating(from_axes(rotation_of(item.solid.row).T, item.solid.row[10:13])), item.known.options)
             for k, item in enumerate(placed) if item.known is not None}  # fmt: skip
    return scene_graph(state_of(placed), floor_pose, names, given=given)


def part_of_known(
    rng: np.random.Generator, placement: Placement, placed: list[Placed], names: list[str], floor_pose: np.ndarray,
    seen: Seen, chains: int, draws: int, most: int = 0,
) -> StructurePosterior:  # fmt: skip
    """Return draws of all numbers under given identities, and the `spots` they leave, by chains from where things were
    placed; of one the place. most : draws of each chain up to which those that disagree go on."""
    placed = [replace(item, solid=item.solid._replace(parent=parent, bottom=bottom))
              for item, (parent, bottom) in zip(placed, placement.carriers(placed), strict=True)]  # fmt: skip
    graph = graph_of(placed, floor_pose, names)
    unknown = [name for name, item in zip(names, placed, strict=True) if item.known is None]
    shown = np.bincount(placement.view(placed)[1].ravel() + 1, minlength=len(placed) + 1)[1:]
    laws = laws_of(graph, names, unknown, [name for name, pixels in zip(names, shown, strict=True) if pixels < SHOWN])
    target = SceneTarget(Even(laws), graph, seen(graph))  # type: ignore[arg-type]
    start = np.array([value if period is None else value % period
                      for value, period in zip(target.values(graph), target.space.periods, strict=True)])  # fmt: skip
    if chains * draws == 1:
        return part_of_one(target, start, 1.0, {})
    parts = mixture(target.space, default_parts())
    seed = int(rng.integers(2**63))
    sampler = MixtureSampler(target, parts, places=start[None]).prepared(seed)
    plan = Plan(sampler, seed, chains, WARMUP, draws)
    outcome = run_until_agreed(plan, target, most, THREADS, until=placement.settings.until, closely=False)
    part = part_of(target, list(outcome.records.values()), parts)
    if part is None or outcome.interrupted:
        raise KeyboardInterrupt
    images, left = target.images, []
    if placement.settings.temper == 1.0:
        numbers = likelihoods[images.type].complete(images.values)
        clean = render_depth(part.best()[0].solids(), images.camera, background=numbers["background"])[0]
        left = spots_left(clean, np.where(images.observed > 0, images.observed, np.nan), numbers)
    return replace(part, extras={**part.extras, "spots": left})


class Even(NamedTuple):
    """A prior of the numbers of one structure that are free, each for itself."""

    laws: dict[str, Distribution]  # by address

    def free_addresses(self, graph: SceneGraph) -> dict[str, Distribution]:
        """Return the distributions of the free numbers of the structure's scenes."""
        return self.laws


def laws_of(graph: SceneGraph, placed: list[str], unknown: list[str], unseen: list[str]) -> dict[str, Distribution]:
    """Return what is believed of each free number of a scene: objects lie anywhere near, those of unknown sizes are as
    large as the search takes them to be, those `unseen` that a grid has stand where it has them, but for the gaps
    between its cartons."""
    laws: dict[str, Distribution] = {}
    uniform, size = distributions["uniform"], distributions["log-normal"](TYPICAL_SIZE, SIZE_SPREAD)
    for vertex in (vertex for vertex in graph.vertices if vertex.name in placed):
        name, round_about = vertex.name, turns_freely(vertex) and not graph.children(vertex.name)
        if name in unknown:
            laws |= {f"{name}.{key}": size for key in vertex.parameters}
        for parameter in graph.contact_parameters(name):
            address, value = f"{name}.contact.{parameter.name}", vertex.contact.values.get(parameter.name, 0.0)
            if parameter.slack or parameter.name in ROTATION or (round_about and parameter.name == "theta"):
                continue  # how a can that carries nothing is turned about itself nothing tells
            bounded = math.isfinite(parameter.upper - parameter.lower)
            low, high = (parameter.lower, parameter.upper) if bounded else (value - NEAR, value + NEAR)
            if parameter.name == "theta" and name in unknown and vertex.shape == "box":
                low, high = value - EIGHTH, value + EIGHTH
            elif parameter.name == "theta" and parameter.period and graph.children(name):  # they go by its axes
                low, high = value - 0.5 * parameter.period, value + 0.5 * parameter.period
            if name in unseen:
                off, turns = GAP / metres_of(graph, vertex, parameter.name), graph.period(address) is not None
                low, high = (value - off, value + off) if turns else (max(low, value - off), min(high, value + off))
            laws[address] = uniform(low, high)
        if vertex.contact.type == "6dof":
            laws[f"{name}.contact.{QUATERNION}"] = distributions["uniform-rotation"]()
    return laws


def metres_of(graph: SceneGraph, vertex: Vertex, parameter: str) -> float:
    """Return the metres by which the farthest point of an object moves where a number of its contact is one more."""
    here = vertex.contact.values.get(parameter, 0.0)
    moved = replace(
        vertex, contact=replace(vertex.contact, values={**vertex.contact.values, parameter: here + DIFFERENCE})
    )
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * vertex.body.size()
    poses = [relative_pose(each, graph.body(vertex.parent)) for each in (vertex, moved)]
    ends = [corners @ pose[:3, :3].T + pose[:3, 3] for pose in poses]
    return float(np.linalg.norm(ends[1] - ends[0], axis=1).max()) / DIFFERENCE
