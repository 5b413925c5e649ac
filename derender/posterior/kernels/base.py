"""What a kernel is: `kernel(rng, state) -> (state, info)`, leaving the target's posterior invariant.

These are the readable kernels, the reference for the compiled sweep. Both draw the same random numbers in the same
order, so that one generator makes both do the same steps. Every log ratio is the log of

    posterior(new) proposal(old | new) / (posterior(old) proposal(new | old)),

positive where the new state is the better one; the step is accepted with probability min(1, exp(log ratio)).
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from derender.errors import DerenderError, at_fault
from derender.posterior.space import Block, Space
from derender.registry import Registry
from derender.sampling import metropolis
from derender.sampling.metropolis import Info


class Target(Protocol):
    """A posterior density over the values of a space."""

    space: Space

    def log_prior(self, values: np.ndarray) -> float:
        """Return the log prior of (P,) values: the space's, and further terms where the prior has any."""

    def log_likelihood(self, values: np.ndarray) -> float:
        """Return the log likelihood of (P,) values inside the prior's support."""


class State(NamedTuple):
    """What the next step needs. values : (P,) float64; log_prior, log_likelihood : at those values."""

    values: np.ndarray
    log_prior: float
    log_likelihood: float


class Kernel(Protocol):
    """A step that leaves the posterior invariant; `name` says which, such as "drift red.contact"."""

    name: str

    def __call__(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Take a step."""


class Tuning(NamedTuple):
    """What warm-up learns, and what is fixed afterwards.

    Attributes
    ----------
    mean : (P,) float64, a typical place.
    covariance : (D, D) float64, of the posterior in tangent directions around it.
    scale : step scale by kernel name; 1 where a name is missing.
    temperature : exponent on the likelihood; below 1 only while warming up or tempering.
    archive : (K, P) float64, places that all chains saw in warm-up, or None: `mean` is the only one.
    """

    mean: np.ndarray
    covariance: np.ndarray
    scale: Mapping[str, float]
    temperature: float = 1.0
    archive: np.ndarray | None = None

    @property
    def places(self) -> np.ndarray:
        """The archive, or the mean as its only place."""
        return self.mean[None] if self.archive is None else self.archive


class KernelType:
    """A registered family of kernels, chosen by name in `inference: {kernels: [{NAME: {weight: 0.2}}, ...]}`.

    Attributes
    ----------
    name : in the registry.
    options : the options that YAML may set, with their defaults; all numbers.
    per_block : whether there is one kernel for each block of the space, or a single one for all unknowns.
    adapts : whether warm-up tunes its scale towards `acceptance`.
    keeps_children : whether it leaves the children of the object that it moves where they are in the world.
    code : the compiled twin's number, or None.
    """

    name: str = ""
    options: Mapping[str, float] = {}
    per_block: bool = True
    adapts: bool = False
    acceptance: float = 0.3
    keeps_children: bool = False
    code: int | None = None

    def blocks(self, space: Space, options: Mapping[str, float]) -> Sequence[Block]:
        """Return the blocks that have a kernel of their own."""
        blocks = space.blocks if self.per_block else (space.everything,)
        return [block for block in blocks if self.applies(space, block)]

    def applies(self, space: Space, block: Block) -> bool:
        """Return whether the block has anything that this kernel can move; by default, a direction to go."""
        return space.size(block) > 0

    def moves(self, space: Space, block: Block) -> Sequence[int]:
        """Return which unknowns of the block it can move: by default those with a direction to go."""
        return [i for i in block.unknowns if space.unknowns[i].ways]

    def build(self, target: Target, block: Block, tuning: Tuning, options: Mapping[str, float]) -> Kernel:
        """Return the kernel for a block."""
        raise NotImplementedError


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

    Parameters
    ----------
    entries : such as [{"resimulate": {"weight": 0.2}}, {"drift": None}].

    Raises
    ------
    DerenderError : unknown kernel or option, a weight that is not a number from 0 up, a mixture that moves nothing.
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
            blocks = kind.blocks(space, options)
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


def evaluate(target: Target, values: np.ndarray) -> State:
    """Return the state at some values; outside the prior's support the likelihood is not asked for."""
    log_prior = target.log_prior(values)
    if not log_prior > -math.inf:
        return State(values, -math.inf, -math.inf)
    return State(values, log_prior, target.log_likelihood(values))


def evaluate_kept(target: Any, old: State, moved: np.ndarray, block: Block) -> tuple[State, float]:
    """Return the state after the block of an object has `moved` and its children have stayed, and the log Jacobian.

    The target knows how (`keep_children`). Where a child would lose its contact the density is zero.
    """
    if target.log_prior(moved) > -math.inf:
        kept = target.keep_children(old.values, moved, block)
        if kept is not None:
            return evaluate(target, kept[0]), kept[1]
    return State(moved, -math.inf, -math.inf), 0.0


def decide(
    rng: np.random.Generator, old: State, new: State, correction: float, temperature: float, name: str
) -> tuple[State, Info]:
    """Accept or reject: log ratio = change of log prior + temperature * change of log likelihood + correction.

    Parameters
    ----------
    correction : log of proposal(old | new) / proposal(new | old), and of the Jacobian where the proposal has one.
    """
    if new.log_prior == -math.inf:
        log_ratio = -math.inf
    else:
        log_ratio = new.log_prior - old.log_prior + temperature * (new.log_likelihood - old.log_likelihood) + correction
    return metropolis.decide(rng, old, new, log_ratio, name)
