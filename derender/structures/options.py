"""What may be asked of the inference of a bare image, as one typed object."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from derender.errors import DerenderError
from derender.registry import suggest

if TYPE_CHECKING:
    from derender.document import Document

RANGES = {  # of whole numbers, so that memory holds what is asked for
    "chains": (1, 1000), "draws": (1, 10_000_000), "warmup": (0, 10_000_000), "jobs": (1, 1000),
    "max_objects": (1, 1000), "seed": (0, 2**128),
}  # fmt: skip
SECONDS = {"": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0}  # in one of a unit of time
METHODS = ("auto", "mcmc", "map", "smc")
GRADIENTS = ("exact", "finite-difference")


class Frame(NamedTuple):
    """A further image of a scene: depth (H, W) metres, NaN = no return; its Camera; into (4, 4) float64, the first
    camera's axes to its own, None: it is found."""

    depth: np.ndarray
    camera: Any
    into: np.ndarray | None
    name: str  # what a person calls it


@dataclass(frozen=True)
class Options:
    """How a bare image is inferred, and what is known of it beforehand. Every field may be left out.

    method : "auto" (search, then draws under the best structures, weighed by integrals), "map" (the best scene only),
        "mcmc" (reversible jumps under a prior of open structure, see jumps/run.py), "smc" (of given objects only).
    quick : with "map", one search and one climb to the mode: twice as fast, and sometimes beside the best.
    gradient : one of GRADIENTS, by which "map" climbs in the end, of given objects.
    chains, draws, warmup : numbers of chains, of kept draws of each, and of the rounds in which one adapts; None: those
        of the method.
    folder, resume : of their checkpoints, and whether to go on with them.
    floor : None or "auto" (find it), "none", or the plane (4,) a x + b y + c z + d = 0 in camera axes, metres.
    may_overlap, may_float : whether solids may interpenetrate and hang in the air.
    budget : seconds after which draws that do not agree yet are not gone on with; None: they go on for so long as is
        worth it, and a seed gives the same draws however fast the machine is.
    unit : metres for one unit of the depths, once that is known; None: it is found where the depths tell.
    """

    method: str = "auto"
    quick: bool = False
    gradient: str = "exact"
    seed: int | None = None  # of the random numbers
    chains: int | None = None
    draws: int | None = None
    warmup: int | None = None
    jobs: int | None = None  # chains that walk side by side
    folder: Path | None = None
    resume: bool = False
    shapes: Sequence[str] | None = None  # names of the shapes to look for; None: all
    max_objects: int | None = None  # at most so many solids and free-form things; None: no such limit
    floor: str | Sequence[float] | np.ndarray | None = None
    known: Any = None  # a library of known objects or its file
    only_known: bool = False  # whether there is nothing besides them
    may_overlap: bool = False
    may_float: bool = False
    assume_stable: bool = False  # whether draws that could not stand by themselves are ruled out
    prior: Any = None  # an open prior that the search obeys, or None: the one of bare images
    likelihood: Any = None  # what its document says of the sensor, or None
    budget: float | None = None
    unit: float | None = None
    frames: Sequence[Frame] = ()  # further images of the same scene, which stands still, from elsewhere

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise DerenderError(f"no method is called {self.method!r}", "--method", suggest(self.method, METHODS))
        if self.gradient not in GRADIENTS:
            remedy = suggest(self.gradient, GRADIENTS)
            raise DerenderError(f"no gradient is called {self.gradient!r}", "--gradient", remedy)
        if self.shapes:
            from derender.detection.search.greedy import SHAPES

            if wrong := [name for name in self.shapes if name not in SHAPES]:
                remedy = suggest(wrong[0], sorted(SHAPES))
                raise DerenderError(f"{wrong[0]!r} is no shape to look for", "--shapes", remedy)
        for name, (least, most) in RANGES.items():
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                raise DerenderError(f"{name} is {value!r}", remedy=f"give a whole number from {least} to {most:g}")
        if self.budget is not None and not 0.0 < self.budget < np.inf:
            raise DerenderError(f"budget is {self.budget!r}", remedy="give seconds, more than none")
        if self.only_known and self.known is None:
            raise DerenderError("nothing is known", "--only-known", "give a library with --known FILE")

    def deciding(self) -> str:
        """Return what of the options decides about the draws, as text: two runs with the same can go on together."""
        return repr([(f.name, getattr(self, f.name)) for f in fields(self) if f.name not in NOT_DECIDING])


NOT_DECIDING = frozenset(
    {"assume_stable", "folder", "gradient", "resume", "jobs", "draws", "prior", "likelihood", "budget", "unit",
     "frames"}
)  # fmt: skip


def seconds_of(budget: str | float | None) -> float | None:
    """Return the seconds of a time such as "30s", "2min" or "1.5h"; a plain number counts seconds, None stays."""
    if not isinstance(budget, str):
        return budget
    found = re.fullmatch(r"(\d+\.?\d*)\s*(s|min|h|)", budget.strip())
    if found is None or float(found[1]) <= 0.0:
        raise DerenderError(f"{budget!r} is no time", "--budget", "give one such as 30s, 2min or 1h")
    return float(found[1]) * SECONDS[found[2]]


def names_objects(document: "Document | None") -> bool:
    """Return whether there is a document that names its objects: then chains can walk over their numbers."""
    from derender.scene.priors.tree import TreePrior

    return document is not None and isinstance(document.prior, TreePrior)
