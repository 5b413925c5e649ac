"""Second supports: a solid that rests on its parent and on others of the same height, as a bridge on two towers.

Every structure is split in two for each level contact besides the tree's, with it and without, by a Savage-Dickey
ratio.  Let g be the gap between the solid's resting face and the other's top, m and s its mean and standard deviation
over the draws, which know nothing of the contact.

    with the contact     p(data) ~ N(m; 0, s^2 + slack^2)
    without              p(data) ~ 1 / REACH      (any height of the other within REACH below would have done)

The draws of a hidden top end at the gap 0, which it cannot enter, and are mirrored there, each widened as much as so
many tell (Silverman, Density Estimation, 1986, sections 2.10 and 3.4). The contact's prior probability, REACH, and how
much less probable is what would tip off its parent alone, stand in the prior's file.

The parent is the one that bears most (`by_bearer`), in as many of the draws of place and friction as it does so.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from derender.detection.solids.beliefs import Rules, bare_image
from derender.detection.solids.state import State
from derender.detection.solids.support import TOUCHING, bearers, shares_of_load
from derender.errors import DerenderError
from derender.results.posterior import StructurePosterior
from derender.scene.contacts import Inverse
from derender.scene.distributions import Distribution
from derender.scene.graph import ROOT, Contact, SceneGraph, Vertex, nearest_contact
from derender.scene.pose import inverse
from derender.scene.priors.bare_image import Loose, balances
from derender.scene.shapes import shapes
from derender.scene.shapes.base import EXTENTS, opposite
from derender.structures.draws.chart import Chart, rows_at

DEEPEST, LARGEST_TILT = 0.010, np.radians(4.0)  # metres by which the solids may enter each other, and angle of faces
ENDS_AT_NONE = 2.0  # standard deviations of draws from their mean to 0, where few would lie beyond anyway
EDGE = 0.02  # share of the range of (u, v) within which outlines only graze each other
RESTING = ("face-to-face", "side-on-face")
SMALLEST_WEIGHT = 1e-3  # a half that is less likely is not kept
GAPS = 60  # draws looked at


class Candidate(NamedTuple):
    """A contact besides the tree's."""

    name: str  # the solid, and what else it may rest on
    other: str  # the solid, and what else it may rest on
    probability: float  # that they are in contact


def with_bridges(parts: Sequence[StructurePosterior], rules: Rules) -> list[StructurePosterior]:
    """Return the structures with their second supports, weights still summing to what they did; two that differ only in
    which of the carriers is called the parent become one."""
    loose = (bare_image() if rules.beliefs is None else rules.beliefs).loose
    found: list[StructurePosterior] = []
    for part in sorted(parts, key=lambda part: -part.weight):
        divided = [part]
        for candidate in candidates(part, rules.slack, loose):
            divided = [piece for whole in divided for piece in divide(whole, candidate)]
        found += divided
    return merge_same(found)


def candidates(part: StructurePosterior, slack: float, loose: Loose) -> list[Candidate]:
    """Return the second supports that a structure may have, with their probabilities."""
    graph, _ = part.best()
    pairs = [
        (vertex.name, other)
        for vertex in graph.vertices
        if vertex.parent != ROOT and vertex.contact.type in RESTING and _bounded(graph, vertex.parent)
        for other in graph.names
        if other not in (vertex.name, vertex.parent, *vertex.supports, *graph.descendants(vertex.name))
        and other not in graph.path(vertex.parent, ROOT)
        and _bounded(graph, other)
        and _level(graph, vertex, other, loose.within)
    ]
    scenes = some_of(part) if pairs else []
    return [judge(scenes, graph, name, other, slack, loose) for name, other in pairs]


def some_of(part: StructurePosterior) -> list[SceneGraph]:
    """Return GAPS or more of a structure's draws, all where there are no more."""
    places = list(np.ndindex(part.log_density.shape))
    return [part.graph_at(*place) for place in places[:: max(1, len(places) // GAPS)]]


def _bounded(graph: SceneGraph, name: str) -> bool:
    return shapes[graph.vertex(name).shape].bounded


def _level(graph: SceneGraph, vertex: Vertex, other: str, within: float) -> bool:
    """Whether the vertex would lie flat on `other`, whose top is within so many metres, and not merely graze it."""
    try:
        contact, left = nearest_to_resting(graph, vertex.name, other)
    except DerenderError:  # these two shapes have no such contact
        return False
    if not -DEEPEST < left.gap < within or left.tilt + left.angle > LARGEST_TILT or left.outside > 0.0:
        return False
    return all(EDGE < contact.values.get(key, 0.5) < 1 - EDGE for key in ("u", "v"))


def judge(scenes: list[SceneGraph], graph: SceneGraph, name: str, other: str, slack: float, loose: Loose) -> Candidate:
    """Return the candidate with its probability, by the ratio at the head of this file.
    scenes : draws. graph : the best scene."""
    gaps = [nearest_to_resting(scene, name, other)[1].gap for scene in scenes]
    balanced = balances(graph, name, graph.vertex(name).parent)
    with_it = density_at_none(np.array(gaps), slack)
    prior_odds = loose.second_support / (1.0 - loose.second_support)
    odds = prior_odds * loose.within * with_it / (1.0 if balanced else loose.tipping)
    return Candidate(name, other, float(odds / (1 + odds)))


def density_at_none(gaps: np.ndarray, slack: float) -> float:
    """Return the density, 1 / m, at no gap of that of which there are draws (N,) in metres, see the head of this
    file."""
    mean, spread = float(np.median(gaps)), float(np.std(gaps))
    if slack < spread and mean < ENDS_AT_NONE * spread and gaps.min() > -slack:
        wide = np.hypot(1.06 * spread * len(gaps) ** -0.2, slack)
        return float(2.0 * np.exp(-0.5 * (gaps / wide) ** 2).mean() / (np.sqrt(2.0 * np.pi) * wide))
    wide = np.hypot(spread, slack)
    return float(np.exp(-0.5 * (mean / wide) ** 2) / (np.sqrt(2.0 * np.pi) * wide))


def divide(part: StructurePosterior, candidate: Candidate) -> list[StructurePosterior]:
    """Return a structure with the second support and without it."""
    vertex = part.graph.vertex(candidate.name)
    graph = part.graph.replace(vertex.name, supports=(*vertex.supports, candidate.other))
    probability = candidate.probability
    if min(probability, 1 - probability) < SMALLEST_WEIGHT:
        probability = round(probability)
    joined = replace(closed(part, candidate), graph=graph).scaled(probability)
    apart = part.scaled(1 - probability)
    return [piece for piece in (joined, apart) if piece.weight > 0]


def closed(part: StructurePosterior, candidate: Candidate) -> StructurePosterior:
    """Return the draws with the gap closed, where the other's top is a free extent of what stands on the opposite face;
    the densities are left as they were, for the gap is within the slack and mostly hidden."""
    contact = part.graph.vertex(candidate.other).contact
    if contact.type != "face-to-face" or part.graph.vertex(candidate.other).shape not in ("box", "cylinder"):
        return part
    face = contact.faces[1]
    address = f"{candidate.other}.{EXTENTS['xyz'.index(face[1])]}"
    if address not in part.addresses:
        return part
    if nearest_to_resting(part.graph, candidate.name, candidate.other)[0].parent_face != opposite(face):
        return part
    values = part.values.copy()
    place = part.addresses.index(address)
    for chain, draw in np.ndindex(part.log_density.shape):
        gap = nearest_to_resting(part.graph_at(chain, draw), candidate.name, candidate.other)[1].gap
        values[chain, draw, place] = max(values[chain, draw, place] + gap, 0.5 * values[chain, draw, place])
    return replace(part, values=values, apparent=None)


def merge_same(parts: Sequence[StructurePosterior]) -> list[StructurePosterior]:
    """Return the structures without those that say the same of who carries whom; the heaviest draws stand for all."""
    kept: dict[tuple, StructurePosterior] = {}
    for part in sorted(parts, key=lambda part: -part.weight):
        key = tuple(
            (v.name, v.shape, v.contact.type, frozenset((v.parent, *v.supports)) if v.supports else v.parent)
            for v in sorted(part.graph.vertices, key=lambda v: v.name)
        )
        kept[key] = together(kept[key], part) if key in kept else part
    return sorted(kept.values(), key=lambda part: -part.weight)


def together(part: StructurePosterior, other: StructurePosterior) -> StructurePosterior:
    """Return a structure with the weight of another that says the same; their errors are taken as independent."""
    error = float(np.hypot(part.weight_error, other.weight_error))
    weight, ends = part.weight + other.weight, (part.weight_interval, other.weight_interval)
    interval = None
    if ends[0] is not None and ends[1] is not None:
        far = [np.hypot(part.weight - ends[0][k], other.weight - ends[1][k]) for k in range(2)]
        interval = float(max(weight - far[0], 0.0)), float(min(weight + far[1], 1.0))
    return replace(part, weight=weight, weight_error=error, weight_interval=interval)


def nearest_to_resting(graph: SceneGraph, name: str, support: str) -> tuple[Contact, Inverse]:
    """Return the contact by which `name` would rest on `support` with what rests on its parent, and how far it is off.
    The support's face is the one that looks most squarely at it. A vertex that floats takes its best pair of faces."""
    vertex = graph.vertex(name)
    poses = graph.poses()
    kind = vertex.contact.type if vertex.contact.type != "6dof" else "face-to-face"
    relative = inverse(poses[support]) @ poses[name]
    body, child = graph.body(support), vertex.body
    face = vertex.contact.child_face
    upright = None
    if face is not None and body.shape.face_names:
        down = relative[:3, :3] @ child.face(face).frame[:3, 2]
        upright = min(body.shape.face_names, key=lambda other: body.face(other).frame[:3, 2] @ down)
    return nearest_contact(relative, body, child, kind, upright, face)


DRAWN = 100  # scenes, and frictions of each contact, in which who bears most is looked at
SMALLEST_SHARE = 1e-3  # of a parent that is kept


def by_bearer(
    rng: np.random.Generator, state: State, chart: Chart, drawn: np.ndarray, friction: Distribution
) -> list[tuple[State, float]]:
    """Return [(State, probability)]: a state with each parent that each of its solids may have.
    drawn : (n, D) draws of the chart's coordinates. friction : of one contact."""
    found = [(state, 1.0)]
    for k in range(len(state)):
        if len(bearers(state.rows, k)) > 1:
            parents = parents_of(rng, chart, drawn, k, friction)
            if parents:
                found = [(each.changed(k, parent=j), share * p) for each, share in found for j, p in parents.items()]
    return found


def parents_of(
    rng: np.random.Generator, chart: Chart, drawn: np.ndarray, k: int, friction: Distribution
) -> dict[int, float]:
    """Return how probably each of its supports bears most of solid k; empty where it is held in no draw."""
    most: Counter[int] = Counter()
    for values in drawn[rng.integers(len(drawn), size=DRAWN)]:
        rough = np.array([friction.quantile(p) for p in rng.random(len(chart.flags) + 1)])
        shares = shares_of_load(rows_at(chart, values), k, TOUCHING, rough)
        if shares:
            most[max(shares, key=lambda j: shares[j])] += 1
    return {j: number / most.total() for j, number in most.items() if number > SMALLEST_SHARE * most.total()}
