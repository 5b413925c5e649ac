"""The prior of images that come alone: a grammar of solids, and what holds of their contacts, their weight, their unit.

As a prior it is a grammar whose objects may tip only rarely. What is looser in an image than in exact contacts (slack,
sinking into each other, touching nothing) is a density about those contacts: inference uses it, draws have none of it.
"""

import math
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from derender.scene.codec.yaml_tree import Section
from derender.scene.distributions import Distribution, distributions
from derender.scene.friction import MEDIAN, SPREAD
from derender.scene.graph import ROOT, SceneGraph
from derender.scene.priors.grammar import GrammarPrior
from derender.scene.priors.reading import read_distribution, read_value
from derender.scene.shapes import shapes


@dataclass(frozen=True)
class Existence:
    """How probable it is that a free-form thing is an object, not clutter or a piece of one, by how much it explains.

    even : nats gained at which it is as likely as not, where it stands out by `outstanding`, see
        detection.freestanding; nats count with the cube of that.
    one : nats gained by joining pieces that meet in a concave edge at which they are as likely one as two; each so
        many more make the odds of that e^2 times as high.
    shown : share of what a solid covers by itself that shows it, at which it is as likely there as not.
    clear : power of that share with which the odds grow.
    hangs : share of what touches nothing, though there is a floor, that is an object.
    """

    even: float = 50.0
    steep: float = 3.0  # power with which the odds grow with the nats
    most: float = 0.96  # the most that is said
    error: float = 0.05  # standard error of that
    error_at_even: float = 0.15  # at even odds
    outstanding: float = 0.5
    one: float = 15.0
    shown: float = 0.45
    clear: float = 6.0
    hangs: float = 0.2

    def shown_by(self, share: float) -> tuple[float, float]:
        """Return (probability, standard error) that a solid is there that others hide but for a share of it."""
        there = 1.0 / (1.0 + (self.shown / max(share, 1e-9)) ** self.clear)
        return there, self.error_at_even * 4.0 * there * (1.0 - there)

    def of(self, gain: float, outstanding: float) -> tuple[float, float]:
        """Return (probability, standard error) for a gain in nats of a thing that stands out so much."""
        gain *= (outstanding / self.outstanding) ** 3
        share = 1.0 / (1.0 + (self.even / max(gain, 1e-9)) ** self.steep)
        return self.most * share, math.hypot(self.error * share, self.error_at_even * 4.0 * share * (1.0 - share))

    def joined(self, existence: tuple[float, float], gain: float) -> tuple[float, float]:
        """Return (probability, standard error) of a thing of such an existence of which pieces gain so many nats."""
        probability, error = existence
        share = 1.0 / (1.0 + math.exp(2.0 - 2.0 * gain / self.one))
        return probability * share, math.hypot(
            error * share, probability * self.error_at_even * 4 * share * (1 - share)
        )


@dataclass(frozen=True)
class Missed:
    """How probable it is that a search has not found what is there at all, see `structures.answer.missed_by`.

    settled : of an image, where two searches agreed and nothing is left unexplained.
    unweighed : where what was found was not weighed against others (`--method map` does not).
    explained : of an answer of known objects, share of the pixels from which on nothing is left unexplained.
    """

    settled: float = 0.005
    open: float = 0.05  # where not
    unweighed: float = 0.07
    no_floor: float = 0.5  # where nothing was found to stand on, or a floor that shows little
    sensor: float = 0.1  # of a real sensor's image
    unexplained: float = 0.05  # share of its pixels that solids do not explain at which e times fewer answers are right
    few: float = 0.3  # of each solid, did it show in no pixel
    pixels: float = 5.0  # independent ones in which it shows, e times less at each
    wrong: float = 0.4  # share of the objects of an answer that are not there, where it surely missed what is
    explained: float = 0.95
    error: float = 0.4  # standard error of what these come to, as a share of it: a few misses were counted


@dataclass(frozen=True)
class Things:
    """What is believed of free-form things: of their surfaces, and of their extents.

    wide : metres across the front of a usual thing; what is larger bends over ways that are as much longer.
    hidden : else how much farther it reaches, as a share of it along the line of sight, standard deviation; what is
        round reaches as far as its axis tells.
    """

    patch: float = 0.03  # metres over which a usual thing's surface bends little
    wide: float = 0.2
    number: float = 2.3  # nats of what each patch says beyond what its neighbours tell
    edge: float = 23.0  # nats against a concave edge within one thing as long as a patch
    whole: float = 0.7  # probability that an extent is as is seen
    hidden: float = 0.2
    silhouette: float = 0.4  # pixels by which an extent is off because silhouettes lie anywhere between two

    def larger(self, area: Any) -> Any:
        """Return how many times larger than usual a thing is that shows so many square metres; at least 1."""
        return np.maximum(1.0, np.sqrt(area) / self.wide)


@dataclass(frozen=True)
class Shared:
    """How many pixels of a real sensor tell the search as much as one whose error is its own.

    Draws and weights are under the likelihood `correlated` there (data/sensors/any.yaml where no file says another).

    power : of (1 + r) / (1 - r), r being the correlation of neighbours' errors on the floor: so many pixels are one.
    columns : of an image (rows of a portrait) in which that holds; the pixels of one of more tell as much as those of
        one of so many.
    """

    power: float = 1.5
    least: float = 0.1  # correlation below which they count as independent
    most: float = 0.75  # the most that is believed of a correlation
    columns: float = 160.0


@dataclass(frozen=True)
class Floors:
    """What is believed of the plane that is the floor, see `detection.floors`.

    aside, upside_down : how often a camera is held on either side or upside down, against upright.
    explained : of the share that it and what stands on it explain, among planes that come near the likeliest.
    under : what far under it takes away of that share, and parallel : what on likely planes parallel to it adds.
    none : odds, of a plane against one that is all that is seen, from which on there rather is no floor.
    """

    height: float = 0.7  # of the camera over it in the middle
    spread: float = 2.0  # factor by which one in three is lower or higher
    aside: float = 0.027
    upside_down: float = 0.011
    ceiling: float = 0.33  # against floors seen upright, what faces down more steeply than a wall and is no ceiling
    faced: float = 0.25  # planes that the camera looks straight at and are no walls
    share: float = 2.0  # power of the share of the pixels on a plane with which the odds grow
    explained: float = 4.0
    under: float = 0.3
    parallel: float = 0.5
    none: float = 0.0009


@dataclass(frozen=True)
class Cartons:
    """What is believed of equal cartons stacked in a grid, see `structures.grids`.

    extent : distribution over each extent of a carton, in metres whatever the unit is.
    """

    probability: float = 0.02  # that a box is such a grid
    flat: float = 0.8  # that a carton is set down on its largest face, on which it is hardest to tip
    most: int = 5  # of them in a row, n being as likely as 1 / n
    extent: Distribution = field(default_factory=lambda: distributions["log-normal"](0.2, 0.4))
    gap: float = 0.006  # metres, the widest
    groove: float = 0.1  # that their edges leave one so wide between layers, which rest on each other


@dataclass(frozen=True)
class Loose:
    """What an image's solids do besides what a tree of exact contacts says.

    unit : metres, a number or distribution: of all lengths in the file.
    slack : metres by which a solid that is not upright is off its support (the width of a Cauchy density).
    resting : standard deviation in metres by which what stands exactly sinks into what it stands on, or stands over it.
    faces : standard deviation in metres by which each face of a real solid is off where a real sensor shows it: neither
        is even, and slow biases span whole faces.
    scale : standard deviation of the share by which all that a real sensor shows is too far or too near.
    friction : coefficient of one contact, on which hangs which of several supports bears most.
    crowding : how many solids seen on a floor tell as much of how crowded it is as the number in `offspring`.
    """

    unit: Distribution | float = field(default_factory=lambda: distributions["log-normal"](1.0, 1.5))
    seen_from: tuple[float, float] = (0.4, 1.5)  # units from the camera, least and most, to most of what it sees
    slack: float = 0.0015
    slack_seen: float = 0.002  # the same where a real sensor shows it
    resting: float = 3e-5
    overlap: float = 3e-4  # metres by which solids may enter each other
    faces: float = 0.003
    scale: float = 0.01
    hanging: float = 1e-13  # probability of touching nothing
    tipping: float = 0.01  # weight of what its contacts cannot hold without friction
    friction: Distribution = field(default_factory=lambda: distributions["log-normal"](MEDIAN, SPREAD))
    missed: Missed = field(default_factory=Missed)  # Missed, what a search may not have found
    crowding: float = 1.0
    stranger: float = 0.05  # probability that a solid is none of the known objects, where others than those may be
    second_support: float = 0.5  # probability that a neighbour's top is level with what bears a solid
    within: float = 0.06  # metres below it in which that top lies otherwise
    shared: Shared = field(default_factory=Shared)  # Shared, by pixels that err together
    existence: Existence = field(default_factory=Existence)  # of a free-form thing
    things: Things = field(default_factory=Things)  # of their extents
    cartons: Cartons = field(default_factory=Cartons)  # Cartons, of boxes that are many
    floor: Floors = field(default_factory=Floors)  # Floors, of which plane is the floor


class MayTip:
    """What would fall off its parent, did no friction hold it, is that many times less probable.

    probability : that factor, for each object.
    """

    name = "tipping"

    def __init__(self, probability: float) -> None:
        self.probability = probability

    def log_density(self, graph: SceneGraph) -> float:
        return sum(tips(graph, name) for name in graph.names) * math.log(self.probability)


def tips(graph: SceneGraph, name: str) -> bool:
    """Whether an object that stands on another one's face would fall off it, did no friction hold it."""
    vertex = graph.vertex(name)
    if vertex.parent == ROOT or vertex.contact.parent_face is None or vertex.supports:
        return False
    return shapes[graph.vertex(vertex.parent).shape].bounded and not balances(graph, name, vertex.parent)


def balances(graph: SceneGraph, name: str, parent: str) -> bool:
    """Whether the solid's centre lies over the part of its parent's face that carries it.

    The centre of the face that rests is inside both outlines if and only if their pieces in common hold it, as both are
    convex and the centre is in the middle of its own.
    """
    poses = graph.poses()
    parent_face, size = graph.vertex(name).contact.parent_face, graph.body(parent).size()
    assert parent_face is not None and size is not None, "it rests on a face of a solid"
    face = graph.body(parent).face(parent_face)
    frame = poses[parent] @ face.frame
    down = graph.down()
    centre = poses[name][:3, 3]
    # along gravity onto the plane of the parent's face
    steps = (frame[:3, 3] - centre) @ frame[:3, 2] / max(float(-down @ frame[:3, 2]), 1e-6)
    local = np.linalg.inv(frame) @ np.append(centre - steps * down, 1.0)
    axis = "xyz".index(parent_face[1])
    half = 0.5 * np.array([size[(axis + 1) % 3], size[(axis + 2) % 3]])
    if graph.vertex(parent).shape == "cylinder":
        return bool(np.hypot(local[0], local[1]) < half[0])
    return bool(abs(local[0]) < half[0] and abs(local[1]) < half[1])


@dataclass(frozen=True)
class BareImagePrior(GrammarPrior):
    """A grammar with what is loose about it."""

    loose: Loose = field(default_factory=Loose)


MOST_SHARED = 0.99  # correlation of neighbours: at 1 no number of pixels would tell anything
SHARE = ("", 1e-9, 1.0 - 1e-9)
# Of each group of numbers what it is read into, and (unit, least, most) by name; "" is that of all others.
GROUPS: dict[str, tuple[Any, dict]] = {
    "missed": (Missed, {"pixels": ("", 1e-9), "": ("", 1e-9, 1.0)}),
    "shared": (Shared, {"least": ("", 0.0, 1.0), "most": ("", 0.0, MOST_SHARED), "columns": ("", 1.0), "": ("", 0.0)}),
    "existence": (Existence, {**dict.fromkeys(("even", "steep", "one", "clear"), ("", 1e-9)), "": ("", 1e-9, 1.0)}),
    "things": (Things, {"patch": ("m", 1e-6), "wide": ("m", 1e-6), "whole": ("", 0.0, 1.0), "": ("", 0.0)}),
    "floor": (Floors, {"height": ("m", 1e-9), "spread": ("", 1.0 + 1e-9), "share": ("", 1e-9),
                       "explained": ("", 1e-9), "": ("", 1e-9, 1.0)}),
}  # fmt: skip
NUMBERS = {**dict.fromkeys(("slack", "slack_seen", "resting", "overlap", "faces"), ("m", 1e-6)), "crowding": ("", 1e-9),
           "scale": ("", 0.0, 0.1),
           **dict.fromkeys(("hanging", "tipping"), ("", 1e-300, 1.0)), "stranger": SHARE}  # fmt: skip


def numbers_of(section: Section, limits: dict[str, tuple]) -> dict[str, float]:
    """Return the numbers of a section that are named with (unit, least, most), as far as it has them."""
    return {name: section[name].number(*where) for name, where in limits.items() if name in section}


def read_loose(section: Section) -> Loose:
    """Read a `structure:` section of the type bare-image, all but its offspring; what is left out has its default."""
    section.allow("type", "offspring", "unit", "seen_from", "second_support", "cartons", "friction", *GROUPS, *NUMBERS)
    found: dict = {**numbers_of(section, NUMBERS)}
    if "friction" in section:
        found["friction"] = read_distribution(section["friction"])
    if "unit" in section:
        found["unit"] = read_value(section["unit"], "m")
    if "seen_from" in section:
        low, high = (item.number(lower=1e-6) for item in section["seen_from"].sequence(2))
        if low >= high:
            raise section["seen_from"].fault("the nearest is not nearer than the farthest", "write [0.4, 1.5]")
        found["seen_from"] = low, high
    for key, (kind, limits) in GROUPS.items():
        if key in section:
            names = [each.name for each in fields(kind)]
            told = section[key].section().allow(*names)
            found[key] = kind(**numbers_of(told, {name: limits.get(name, limits[""]) for name in names}))
    if "second_support" in section:
        second = numbers_of(section["second_support"].section().allow("probability", "within"),
                            {"probability": SHARE, "within": ("m", 1e-6)})  # fmt: skip
        found |= {"second_support" if name == "probability" else name: number for name, number in second.items()}
    if "shared" in section:
        if found["shared"].least >= found["shared"].most:
            remedy = "write {least: 0.1, most: 0.75}; with {power: 0} each pixel tells all"
            raise section["shared"].fault("the least correlation is not below the most", remedy)
    if "cartons" in section:
        told = section["cartons"].section().allow("probability", "flat", "most", "extent", "gap", "groove")
        allowed = {"probability": SHARE, "flat": SHARE, "gap": ("m", 1e-6), "groove": SHARE}
        carton: dict = {**numbers_of(told, allowed)}
        if "most" in told:
            carton["most"] = told["most"].integer(lower=2, upper=9)
        if "extent" in told:
            carton["extent"] = read_value(told["extent"], "m")
            if not isinstance(carton["extent"], Distribution):
                remedy = "write a distribution, or pass them with --known"
                raise told["extent"].fault("cartons of one size only", remedy)
        found["cartons"] = Cartons(**carton)
    return Loose(**found)
