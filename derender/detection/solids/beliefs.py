"""A prior over structures as the numbers that compiled densities read: what a bare image is inferred under.

They come from a file: data/priors/bare-image.yaml where no other is given. Of a file that says nothing of slack,
tipping and the like (any other grammar) the shapes, their sizes and how many there are count, and the rest is as in
that one. `Rules` are what solids may do to each other: the terms of the density that detection and draws share.

Densities of solids' extents are tabulated, so that compiled code needs to know no types of distributions.
"""

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from derender import data_path
from derender.compilation.cache import njit
from derender.document import LikelihoodPrior, read_document, read_prior_document
from derender.scene.distributions import Distribution
from derender.scene.priors.bare_image import BareImagePrior, Loose
from derender.scene.priors.grammar import GrammarPrior
from derender.scene.shapes import shapes
from derender.scene.shapes.base import EXTENTS
from derender.scene.solids import BOX, CYLINDER, PLANE, SPHERE

CUBE = PLANE  # row of a table of sizes, besides BOX, CYLINDER and SPHERE: a plane has none
NODES = 129
LOW, HIGH, FIRST = 0, 1, 2  # columns: where the table begins and ends, log metres; log densities at equal steps
# Beyond the ends densities fall off as a normal one's tails of this width: chains find back from a first guess.
EDGE = 3e-4  # metres
ENDS = 1e-4, 1e3  # metres: of a table of what a prior does not have; none begins nearer to nothing
REST = 1e-9  # probability in each tail that is cut off where a density has no end
AXES = {"cube": ("side",) * 3, "box": EXTENTS, "sphere": ("radius",) * 3,
        "cylinder": ("radius", "radius", "height")}  # fmt: skip
ROWS = {"cube": CUBE, "box": BOX, "sphere": SPHERE, "cylinder": CYLINDER}
NAMES = {row: name for name, row in ROWS.items()}


def sizes_of(prior: Any) -> np.ndarray:
    """Return the table (4, 3, FIRST + NODES) of a prior over structures.

    Several shapes of one type are mixed axis by axis. A type that the prior does not have is left without sizes: the
    search does not look for it.
    """
    table = np.zeros((4, 3, FIRST + NODES))
    table[:, :, LOW], table[:, :, HIGH] = np.log(ENDS)
    for kind, names in AXES.items():
        entries = [entry for entry in prior.shapes.values() if entry.type == kind]
        defaults = {parameter.name: parameter.default for parameter in shapes[kind].parameters}
        for axis, name in enumerate(names):
            values = [(entry.weight, entry.values.get(name, defaults[name])) for entry in entries]
            if values:
                table[ROWS[kind], axis] = tabulated(values, 2.0 if name == "radius" else 1.0)
    return table


def tabulated(values: list[tuple[float, Distribution | float]], factor: float) -> np.ndarray:
    """Return (FIRST + NODES,) the row of `factor` times a mixture of (weight, number or Distribution)."""
    ends = factor * np.array([ends_of(value) for _, value in values])
    low, high = max(ends[:, 0].min(), ENDS[0]), ends[:, 1].max()
    grid = np.geomspace(low, high, NODES)
    density = np.zeros(NODES)
    for weight, value in values:
        density += weight * np.exp([log_density_of(value, x / factor) for x in grid])
    density = np.maximum(density, 1e-12 * density.max())
    inside = 0.5 * ((density[1:] + density[:-1]) * np.diff(grid)).sum()
    tails = EDGE * np.sqrt(0.5 * np.pi) * (density[0] + density[-1])
    return np.concatenate([np.log([low, high]), np.log(density / (inside + tails))])


def ends_of(value: Distribution | float) -> tuple[float, float]:
    """Return (low, high) between which a value lies."""
    if not isinstance(value, Distribution):
        return value - EDGE, value + EDGE
    low, high = value.support
    return (value.quantile(REST) if not np.isfinite(low) or low <= 0.0 else low,
            value.quantile(1.0 - REST) if not np.isfinite(high) else high)  # fmt: skip


def log_density_of(value: Any, x: float) -> float:
    """Return the log density of a number or Distribution at x: a number's is even between its ends."""
    if isinstance(value, Distribution):
        return value.log_density(x)
    return 0.0 if abs(x - value) <= 1.01 * EDGE else -np.inf


@njit(cache=True, nogil=True, borrows=True)
def log_density_at(row, extent):
    """Return the log density of an extent by a row of the table."""
    inside = min(max(np.log(extent), row[LOW]), row[HIGH])
    place = (inside - row[LOW]) / (row[HIGH] - row[LOW]) * (NODES - 1)
    node = min(int(place), NODES - 2)
    share = place - node
    beyond = (extent - np.exp(inside)) / EDGE
    return (1.0 - share) * row[FIRST + node] + share * row[FIRST + node + 1] - 0.5 * beyond * beyond


@njit(cache=True, nogil=True, borrows=True)
def box_log_density(table, extents, upright):
    """Return the log density of a box's three extents, whichever of its names each has.

    upright : the third is the height; otherwise any may be.
    """
    best, total = -np.inf, 0.0
    for turn in range(1 if upright else 3):  # which extent is the height; none but the last of an upright box
        c = (2 + turn) % 3
        for flip in range(2):
            a, b = ((c + 1) % 3, (c + 2) % 3) if flip == 0 else ((c + 2) % 3, (c + 1) % 3)
            value = log_density_at(table[0], extents[a]) + log_density_at(table[1], extents[b])
            value += log_density_at(table[2], extents[c])
            if value > best:
                total = total * np.exp(best - value) + 1.0 if best > -np.inf else 1.0
                best = value
            else:
                total += np.exp(value - best)
    return best + np.log(total / (2.0 if upright else 6.0))


BARE_IMAGE = "bare-image"  # the name of the prior where none is given
MOST = 40  # solids on a floor or on a top that are told apart by their number
IMPOSSIBLE = -30.0  # nats of a number of solids, or a kind, that a prior rules out: inference comes from somewhere
AROUND = ("face-to-face", "point-on-face")  # contacts by which solids stand upright


class Beliefs(NamedTuple):
    """What is believed before an image is seen.

    on_floor : (MOST + 1,) log (p(n) n! / area^n) of n solids on the floor: the density of n places as a set.
    """

    sizes: np.ndarray  # (4, 3, FIRST + NODES), see `sizes_of`
    kinds: np.ndarray  # (4,) log probability of each kind by its row of `sizes`
    upright: np.ndarray  # (4,) log probability that one of the kind is upright
    tilted: np.ndarray  # (4,) log probability that one of the kind is not upright
    on_floor: np.ndarray
    on_top: np.ndarray  # (4, MOST + 1) log (p(n) n!) of n solids on the top of one of each kind
    loose: Loose
    sensor: LikelihoodPrior | None  # LikelihoodPrior, or None where the file has none


# Numbers of what neighbours share, and all numbers of a sensor that are fitted.
SHARED = ("step", "step_growth", "reach", "reach_down", "white", "tail")
UNKNOWN = ("sigma", "sigma_growth", "blur", "outlier", "flying", *SHARED)
RULED_OUT = -30.0  # nats of a number that a prior rules out: a fit comes from somewhere


@cache
def bare_image() -> Beliefs:
    """Return what is believed where no prior is given."""
    document = read_prior_document(BARE_IMAGE)
    return beliefs_of(document.prior, document.likelihood)


@cache
def any_sensor() -> LikelihoodPrior:
    """Return what is believed of a sensor of which nothing is known but that neighbouring pixels share noise."""
    found = read_document(data_path("sensors/any.yaml")).likelihood
    assert found is not None
    return found


def sensor_beliefs(beliefs: Beliefs, shared: bool) -> LikelihoodPrior | None:
    """Return what is believed of a sensor.

    shared : whether the image shows that its neighbouring pixels share noise: then it is `any_sensor`, but for what the
    prior's file says itself.
    """
    said = beliefs.sensor
    if not shared or (said is not None and said.type == "correlated"):
        return said
    known = any_sensor().values
    own = {} if said is None else {name: value for name, value in said.values.items() if name in known}
    return LikelihoodPrior("correlated", {**known, **own})


def log_prior_of(prior: LikelihoodPrior | None, numbers: dict[str, float]) -> float:
    """Return the log density of a sensor's numbers under a LikelihoodPrior; never minus infinity."""
    if prior is None:
        return 0.0
    known = [(value, numbers[name]) for name, value in prior.values.items() if name in UNKNOWN and name in numbers]
    return float(sum(max(value.log_density(x), RULED_OUT) for value, x in known if isinstance(value, Distribution)))


def beliefs_of(prior: Any, likelihood: LikelihoodPrior | None = None) -> Beliefs:
    """Return what a prior over structures says; of a prior that is no grammar, its shapes alone.

    likelihood : what its file says of the sensor; only a prior of the type bare-image is taken at its word.
    """
    table = sizes_of(prior)
    kinds = np.full(4, IMPOSSIBLE)
    for name, row in ROWS.items():
        weight = sum(entry.weight for entry in prior.shapes.values() if entry.type == name)
        total = sum(entry.weight for entry in prior.shapes.values())
        if weight > 0.0:
            kinds[row] = math.log(weight / total)
    usual = None if isinstance(prior, BareImagePrior) else bare_image()
    if not isinstance(prior, GrammarPrior):
        assert usual is not None
        return usual._replace(sizes=table, kinds=kinds)
    upright = np.array([math.log(max(share_upright(prior, NAMES[row]), math.exp(IMPOSSIBLE))) for row in range(4)])
    tilted = np.array([math.log(max(1.0 - share_upright(prior, NAMES[row]), math.exp(IMPOSSIBLE)))
                       for row in range(4)])  # fmt: skip
    on_top = np.zeros((4, MOST + 1))
    for name, row in ROWS.items():
        counts = [prior.offspring.get(key) for key, entry in prior.shapes.items() if entry.type == name]
        on_top[row] = set_density(counts[0] if counts else None, 1.0)
    floors = [item.name for item in prior.base if shapes[item.shape.type].solid_kind == PLANE]
    count = next((prior.offspring[name] for name in floors if name in prior.offspring), None)
    if count is None:  # nothing grows on a floor: any number may
        assert usual is not None
        return usual._replace(sizes=table, kinds=kinds)
    loose = prior.loose if isinstance(prior, BareImagePrior) else usual.loose  # type: ignore[union-attr]
    return Beliefs(
        table, kinds, upright, tilted, set_density(count, floor_area(prior)), on_top, loose,
        likelihood if usual is None else usual.sensor,
    )  # fmt: skip


def set_density(count: Any, area: float) -> np.ndarray:
    """Return (MOST + 1,) the log of p(n) n! / area^n for a distribution over how many; None: never more than none."""
    numbers = range(MOST + 1)
    if count is None:
        return np.array([n * IMPOSSIBLE for n in numbers])
    found = np.array([count.log_density(n) + math.lgamma(n + 1) - n * math.log(area) for n in numbers])
    return np.where(np.isfinite(found), found, IMPOSSIBLE)


def floor_area(prior: GrammarPrior) -> float:
    """Return the square metres of floor over which a prior spreads solids, by the entropy of their places."""
    for rule in prior.contacts.rules:
        if rule.values.get("x") is not None and rule.values.get("y") is not None:
            return math.exp(entropy(rule.values["x"]) + entropy(rule.values["y"]))
    return 1.0


def entropy(value: Distribution) -> float:
    """Return the differential entropy of a distribution: minus the mean of its log density over its quantiles."""
    if not isinstance(value, Distribution):
        return 0.0
    middles = (np.arange(512) + 0.5) / 512
    return -float(np.mean([value.log_density(value.quantile(p)) for p in middles]))


def share_upright(prior: GrammarPrior, kind: str) -> float:
    """Return the probability that a solid of a kind stands upright on a floor."""
    found = prior.contacts.choices("plane", kind, "+z")
    if found is None:
        return 1.0
    return float(sum(share for choice, share in found[0].probabilities.items() if choice[0] in AROUND))


class Rules(NamedTuple):
    """What solids may do to each other.

    overlap : metres by which solids may interpenetrate, inf: the term against interpenetration is off; None: as the
        prior says.
    """

    slack: float  # metres within which a solid that is not held stands on its support
    overlap: float | None = None
    floating: bool = False  # whether the term against floating is off: then any height is as likely
    beliefs: Beliefs | None = None  # what is believed of solids; None: what data/priors/bare-image.yaml says
    faces: float = 0.0  # metres by which faces of solids lie off where they appear to, see draws/faces.py
