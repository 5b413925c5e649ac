"""What a kernel is: a proposal that, with the Metropolis-Hastings decision, leaves the target's posterior invariant.

A kernel type names its proposal: a compiled function that writes the proposed values and returns the log of

    proposal(old | new) / proposal(new | old),

to which a step adds the change of the log posterior and, where an object's children stay in the world, the log
Jacobian of their contacts; the step is accepted with probability min(1, exp(log ratio)). There is one source of each
proposal and of the sweep: numba compiles it, and Python runs the same text where a model has no compiled form
(`compiled/backend.py`).

Warm-up learns from where the chain has been: a centre, a covariance, a scale for each kernel. Then it stops.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from derender.compilation.cache import Kernel, njit
from derender.errors import DerenderError, at_fault
from derender.posterior.compiled.prior import (
    NEXT,
    NOW,
    OFFSET,
    PERIOD,
    directions,
    log_prior,
    move,
    moved,
    resample,
    shaped,
    wrap,
)
from derender.posterior.space import Block, Space
from derender.registry import Registry
from derender.sampling.metropolis import Steps

STEP, PLACING = range(2)  # forms of kernels: one proposal, objects put down anew


class Tuning(NamedTuple):
    """What warm-up learns, and what is fixed afterwards.

    archive : (K, P) float64, places that all chains saw in warm-up, or None: `mean` is the only one.
    """

    mean: np.ndarray  # (P,) float64, a typical place
    covariance: np.ndarray  # (D, D) float64, of the posterior in tangent directions around it
    scale: np.ndarray | None = None  # (K,), of the steps of a mixture's kernels; None: 1 each
    temperature: float = 1.0  # exponent on the likelihood; below 1 only while warming up or tempering
    archive: np.ndarray | None = None

    @property
    def places(self) -> np.ndarray:
        """The archive, or the mean as its only place."""
        return self.mean[None] if self.archive is None else self.archive


class KernelType:
    """A registered family of kernels, chosen by name in `inference: {kernels: [{NAME: {weight: 0.2}}, ...]}`.

    keeps_children : whether it leaves the children of the object that it moves where they are in the world.
    proposal : the compiled function. Of a STEP: (rng, unknowns, laws, values, tangents, members, factor, scale) -> log
        ratio, NaN where there is no proposal; see `compiled/prior.py` for the arrays. Of PLACING: (rng, places,
        periods, old, new) -> log ratio, from the place `old` of some objects to their place `new`.
    """

    name: str = ""  # in the registry
    options: Mapping[str, float] = {}  # the options that YAML may set, with their defaults; all numbers
    per_block: bool = True  # whether there is one kernel for each block of the space, or a single one for all unknowns
    adapts: bool = False  # whether warm-up tunes its scale towards `acceptance`
    acceptance: float = 0.3
    keeps_children: bool = False
    form: int = STEP  # STEP or PLACING
    proposal: Kernel

    def blocks(self, space: Space) -> Sequence[Block]:
        """Return the blocks that have a kernel of their own."""
        blocks = space.blocks if self.per_block else (space.everything,)
        return [block for block in blocks if self.applies(space, block)]

    def applies(self, space: Space, block: Block) -> bool:
        """Return whether the block has anything that this kernel can move."""
        return bool(block.unknowns)

    def moves(self, space: Space, block: Block) -> Sequence[int]:
        """Return which unknowns of the block it can move anywhere."""
        return block.unknowns

    def members(self, space: Space, block: Block) -> Sequence[int]:
        """Return the unknowns that its proposal is told of."""
        return block.unknowns

    def factor(self, space: Space, part: "Part", tuning: Tuning) -> np.ndarray:
        """Return the (D, D) lower triangle that its proposal shapes normals with; empty where it needs none."""
        return np.empty(0)

    def reach(self, space: Space, part: "Part") -> float:
        """Return what the scale of its steps is multiplied by."""
        return 1.0


kernels: Registry[KernelType] = Registry("kernel", "derender.kernels")


class Part(NamedTuple):
    """One kernel of a mixture before it is tuned: its type, block, options and share of the steps."""

    type: str
    block: Block
    options: Mapping[str, float]
    weight: float

    @property
    def name(self) -> str:
        return f"{self.type} {self.block.name}"


def mixture(
    space: Space, entries: Sequence[Mapping[str, Mapping[str, Any] | None]], where: object = None
) -> list[Part]:
    """Return the parts of a mixture given as data; an entry's weight is shared by its blocks according to their size.

    entries : such as [{"resimulate": {"weight": 0.2}}, {"drift": None}].

    Raises DerenderError : unknown kernel or option, a weight that is no number from 0 up, a mixture that moves nothing.
    """
    parts = []
    for entry in entries:
        for name, given in entry.items():
            with at_fault(where):
                kind = kernels[name]
            given = dict(given or {})
            weight = given.pop("weight", 1.0)
            _check(weight, f"{name}.weight", where, lower=0.0)
            for key, value in given.items():
                if key not in kind.options:
                    raise DerenderError(
                        f"the kernel {name} has no option {key!r}",
                        where,
                        "it has " + ", ".join(["weight", *kind.options]),
                    )
                _check(value, f"{name}.{key}", where)
            options = {**kind.options, **given}
            blocks = kind.blocks(space)
            total = sum(len(block.unknowns) for block in blocks)
            parts += [Part(name, block, options, weight * len(block.unknowns) / total) for block in blocks]
    whole = math.fsum(part.weight for part in parts)
    moved = {i for part in parts if part.weight > 0 for i in kernels[part.type].moves(space, part.block)}
    missing = set(range(len(space.unknowns))) - moved
    if missing:
        address = space.unknowns[min(missing)].address
        raise DerenderError(f"no kernel moves {address}", where, "add resimulate: {weight: 0.05}")
    return [part._replace(weight=part.weight / whole) for part in parts if part.weight > 0]


def _check(value: object, what: str, where: object, lower: float = -math.inf) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value < lower:
        raise DerenderError(f"{what} is {value!r}", where, "give a number" + (" from 0 up" if lower == 0 else ""))


# Scale of a kernel's steps, in the spread that it has learned. Where nothing refuses one, as about a circle of which an
# image says nothing, it would grow until rounding takes each step to one point; so long a one already ends anywhere.
MOST_SCALE = 100.0
PRIOR_SHARE = 1e-4  # of the prior's variance, with the weight of five draws: keeps a covariance of few draws regular


def first_tuning(space: Space, values: np.ndarray) -> Tuning:
    """Return the tuning of a chain that knows only its prior: a tenth of its spread."""
    return Tuning(values, np.diag((0.1 * space.scales) ** 2))


def centre_of(space: Space, history: np.ndarray) -> np.ndarray:
    """Return (P,) a typical place: means on lines; on circles and rotations the mean step from the last place.

    history : (n, P) float, places in the order of the chain.
    """
    last = history[-1]
    centre = last
    for _ in range(2):  # the second time from a better origin, for rotations
        centre = moved(space, centre, space.everything, space.differences(history, centre).mean(axis=0))
    return centre


def covariance_of(space: Space, history: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return (D, D) the covariance of tangents from `centre`, kept regular by a little of the prior's."""
    steps = space.differences(history, centre)
    count = len(steps)
    seen = steps.T @ steps / count
    return (count * seen + 5 * PRIOR_SHARE * np.diag(space.scales**2)) / (count + 5)


def steps_of(parts: Sequence[Part], tuning: Tuning) -> Steps:
    """Return the Steps of a mixture, with scales of their own."""
    kinds = [kernels[part.type] for part in parts]
    return Steps(
        cumulative=np.cumsum([part.weight for part in parts]),
        scale=np.ones(len(parts)) if tuning.scale is None else tuning.scale.copy(),
        wanted=np.array([kind.acceptance if kind.adapts else 0.0 for kind in kinds]),
        most=np.full(len(parts), MOST_SCALE),
    )


@njit(cache=True, nogil=True)
def drifted(rng, unknowns, laws, values, tangents, members, factor, scale):
    """Random-walk Metropolis: tangent = scale * factor @ z with z standard normal.

    The tangent's density is even and does not depend on where the step starts, and `move` is symmetric, so
    proposal(new | old) = proposal(old | new):
    log ratio = log posterior(new) - log posterior(old).
    """
    shaped(rng, factor, directions(unknowns, members), tangents[1], tangents[0])
    move(unknowns, laws, members, values[NOW], tangents[0], scale, values[NEXT])
    return 0.0


def factor_of(covariance: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the lower Cholesky factor of the conditional spread of some directions, the others held fixed.

    Held-fixed spread is the inverse of the block of the precision matrix: a step of one block alone must fit between
    the others, which stay.
    """
    precision = np.linalg.inv(covariance)
    return np.linalg.cholesky(np.linalg.inv(precision[np.ix_(directions, directions)]))


def directions_of(space: Space, block: Block) -> np.ndarray:
    """Return the indices of a block's directions in the tangents of the whole space."""
    return np.concatenate([np.arange(space.directions[i], space.directions[i + 1]) for i in block.unknowns])


class DriftType(KernelType):
    """Random-walk Metropolis."""

    options = {"scale": 1.0}
    adapts = True
    proposal = drifted

    def factor(self, space: Space, part: Part, tuning: Tuning) -> np.ndarray:
        return factor_of(tuning.covariance, directions_of(space, part.block))

    def reach(self, space: Space, part: Part) -> float:
        # 2.4 / sqrt(D): best for a normal posterior (Roberts, Gelman, Gilks 1997)
        return part.options["scale"] * 2.4 / np.sqrt(len(directions_of(space, part.block)))


@kernels.register("drift")
class BlockDriftType(DriftType):
    """Random-walk step of one edge's contact or one object's shape; its scale is learned in warm-up."""


@kernels.register("drift-all")
class AllDriftType(DriftType):
    """Random-walk step of all unknowns at once, shaped by their learned covariance."""

    per_block = False
    acceptance = 0.234


@kernels.register("slide")
class SlideType(DriftType):
    """Move an object and leave what stands on it where it is.

    The edge's new phi' = phi + even noise, as in `drift`. Each child's contact becomes phi_c' = invert(pose of the
    child in the new frame of its parent), a function of (phi_c, phi, phi'), undone by the step back. For fixed (phi,
    phi') it is a bijection of phi_c; the change of (phi, phi_c) at given noise is triangular, so its Jacobian is the
    product of |d phi_c' / d phi_c| over the children:
    log ratio = log posterior(new) - log posterior(old) + sum of log |d phi_c' / d phi_c|.
    `reattach` finds the contacts and the Jacobian; where a child would lose its contact there is none, and the step
    is refused (as is the way back to there).
    """

    keeps_children = True

    def applies(self, space: Space, block: Block) -> bool:
        return block.name in space.slides

    def factor(self, space: Space, part: Part, tuning: Tuning) -> np.ndarray:
        """Return the factor of the spread of the block's directions, whatever the others do: here they give way."""
        directions = directions_of(space, part.block)
        return np.linalg.cholesky(tuning.covariance[np.ix_(directions, directions)])


@njit(cache=True, nogil=True)
def resimulated(rng, unknowns, laws, values, tangents, members, factor, scale):
    """Propose the block from its own prior, which knows no constraints between objects.

    proposal(new | old) = own prior(new block), so that prior and proposal cancel up to the constraints:
    log ratio = temperature * (log likelihood(new) - log likelihood(old)) + constraints(new) - constraints(old).
    """
    resample(rng, unknowns, laws, members, values[NEXT])
    return log_prior(unknowns, laws, values[NOW]) - log_prior(unknowns, laws, values[NEXT])


@kernels.register("resimulate")
class ResimulateType(KernelType):
    """Draw one edge's contact, or one object's shape, anew from the prior."""

    proposal = resimulated


@njit(cache=True, nogil=True)
def half_turn(unknowns, laws, values, i):
    """Turn angle i of the proposed values by half its period."""
    start, period = unknowns[OFFSET, i], laws[i, PERIOD]
    values[NEXT, start] = wrap(values[NOW, start] + 0.5 * period, period)


@njit(cache=True, nogil=True)
def flipped(rng, unknowns, laws, values, tangents, members, factor, scale):
    """Add half a period to one angle of the block, chosen at random; exchange the box's sides too, every other time.

    An involution: half a period forward is half a period back, exchanging twice is nothing, and each has the same
    probability both ways. It permutes coordinates of one unit and shifts one on a circle, so the Jacobian is one:
    log ratio = log posterior(new) - log posterior(old).

    members : for each angle three unknowns: itself, and the length and width that it may exchange, or -1 twice.
    """
    chosen = 3 * int(rng.random() * (len(members) // 3))
    half_turn(unknowns, laws, values, members[chosen])
    if members[chosen + 1] >= 0 and rng.random() < 0.5:
        length, width = unknowns[OFFSET, members[chosen + 1]], unknowns[OFFSET, members[chosen + 2]]
        values[NEXT, length], values[NEXT, width] = values[NOW, width], values[NOW, length]
    return 0.0


@kernels.register("flip")
class FlipType(KernelType):
    """Turn an object by half the period of its angle, a quarter turn for a box, whose extents along the face that it
    rests on may change places then."""

    proposal = flipped

    def applies(self, space: Space, block: Block) -> bool:
        return bool(self.members(space, block))

    def moves(self, space: Space, block: Block) -> Sequence[int]:
        return ()  # half periods alone reach two places

    def members(self, space: Space, block: Block) -> Sequence[int]:
        index = {unknown.address: i for i, unknown in enumerate(space.unknowns)}
        told: list[int] = []
        for i in block.unknowns:
            name, _, rest = space.unknowns[i].address.partition(".")
            if space.unknowns[i].period is not None:
                sides = tuple(index.get(f"{name}.{side}") for side in space.spans.get(name, ("length", "width")))
                told += (i, -1, -1) if None in sides or rest != "contact.theta" else (i, *sides)  # type: ignore[arg-type]
        return told
