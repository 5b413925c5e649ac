"""A prior over structures as the numbers that compiled densities read: what a bare image is inferred under.

They come from a file: data/priors/bare-image.yaml where no other is given. Of a file that says nothing of slack,
tipping and the like (any other grammar) the shapes, their sizes and how many there are count, and the rest is as in
that one. `Rules` are what solids may do to each other: the terms of the density that detection and draws share.
"""

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from derender import data_path
from derender.detection.solids.sizes import CUBE, ROWS, sizes_of
from derender.document import LikelihoodPrior, read_document, read_prior_document
from derender.scene.distributions import Distribution
from derender.scene.priors.bare_image import BareImagePrior, Loose
from derender.scene.priors.grammar import GrammarPrior
from derender.scene.shapes import shapes
from derender.scene.solids import BOX, CYLINDER, PLANE, SPHERE

BARE_IMAGE = "bare-image"  # the name of the prior where none is given
MOST = 40  # solids on a floor or on a top that are told apart by their number
IMPOSSIBLE = -30.0  # nats of a number of solids, or a kind, that a prior rules out: inference comes from somewhere
KINDS = {BOX: "box", CUBE: "cube", CYLINDER: "cylinder", SPHERE: "sphere"}
AROUND = ("face-to-face", "point-on-face")  # contacts by which solids stand upright


class Beliefs(NamedTuple):
    """What is believed before an image is seen.

    sizes : (4, 3, FIRST + NODES), see sizes.py.
    kinds : (4,) log probability of each kind by its row of `sizes`. tilted : (4,) log probability that one of the kind
        is not upright; upright : (4,) that it is.
    on_floor : (MOST + 1,) log (p(n) n! / area^n) of n solids on the floor: the density of n places as a set.
    on_top : (4, MOST + 1) log (p(n) n!) of n solids on the top of one of each kind.
    loose : Loose. sensor : LikelihoodPrior, or None where the file has none.
    """

    sizes: np.ndarray
    kinds: np.ndarray
    upright: np.ndarray
    tilted: np.ndarray
    on_floor: np.ndarray
    on_top: np.ndarray
    loose: Loose
    sensor: LikelihoodPrior | None


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


def beliefs_of(prior: Any, likelihood: LikelihoodPrior | None = None) -> Beliefs:
    """Return what a prior over structures says; of a prior that is no grammar, its shapes alone.

    likelihood : what its file says of the sensor; only a prior of the type bare-image is taken at its word.
    """
    table = sizes_of(prior)
    kinds = np.full(4, IMPOSSIBLE)
    for row, name in KINDS.items():
        weight = sum(entry.weight for entry in prior.shapes.values() if entry.type == name)
        total = sum(entry.weight for entry in prior.shapes.values())
        if weight > 0.0:
            kinds[row] = math.log(weight / total)
    usual = None if isinstance(prior, BareImagePrior) else bare_image()
    if not isinstance(prior, GrammarPrior):
        assert usual is not None
        return usual._replace(sizes=table, kinds=kinds)
    upright = np.array([math.log(max(share_upright(prior, KINDS[row]), math.exp(IMPOSSIBLE))) for row in range(4)])
    tilted = np.array([math.log(max(1.0 - share_upright(prior, KINDS[row]), math.exp(IMPOSSIBLE)))
                       for row in range(4)])  # fmt: skip
    on_top = np.zeros((4, MOST + 1))
    for row, name in KINDS.items():
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


def entropy(value: Any) -> float:
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


__all__ = ["BARE_IMAGE", "CUBE", "ROWS", "Beliefs", "bare_image", "beliefs_of"]


class Rules(NamedTuple):
    """What solids may do to each other.

    slack : metres within which a solid that is not held stands on its support.
    overlap : metres by which solids may interpenetrate, inf: the term against interpenetration is off; None: as the
        prior says.
    faces : metres by which faces of solids lie off where they appear to, see draws/faces.py.
    floating : whether the term against floating is off: then any height is as likely.
    beliefs : what is believed of solids; None: what data/priors/bare-image.yaml says.
    """

    slack: float
    overlap: float | None = None
    floating: bool = False
    beliefs: Beliefs | None = None
    faces: float = 0.0
