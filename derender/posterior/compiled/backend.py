"""What runs a mixture on a target: the compiled walk, without Python between the steps, or the same source by Python.

Python runs it for models of which something has no compiled form, and takes the steps that redo the whole image.
"""

import math
from collections.abc import Callable
from copy import copy
from typing import Any

import numpy as np

from derender.compilation.cache import Kernel, address_of, interpreted
from derender.posterior.compiled.evaluate import attempt, loader, settle
from derender.posterior.compiled.model import (
    Calls,
    NotCompiled,
    Places,
    calls_of,
    chain_of,
    held,
    kernels_of,
    laws_of,
    model_of,
    places_seen,
    taken_elsewhere,
)
from derender.posterior.compiled.prior import NEXT, NOW, Chain, Kernels, Model, Target, log_prior
from derender.posterior.kernels.base import PLACING, Part, Tuning, kernels, steps_of
from derender.posterior.target import SceneTarget
from derender.render.blur import blur_radius
from derender.render.raycast.engine import allow_blur
from derender.sampling.metropolis import DENSITY, PRIOR, Steps, Stretch, walk

NO_ARRAY: Any = None  # in place of the arrays of Model and Chain that only compiled functions read


class _Programmed:
    """What both kinds of backends keep of tunings, and how they walk.

    target, parts : the posterior and the mixture. elsewhere : numbers of kernels whose steps are taken between those of
    a walk. calls : what each kernel calls.
    """

    def __init__(self, target: Any, parts: list[Part], elsewhere: frozenset[int], calls: list[Calls]) -> None:
        self.target, self.parts, self._elsewhere, self._calls = target, parts, elsewhere, calls
        self._programs: dict[tuple[int, int], tuple[Tuning, Kernels]] = {}
        self._choices: Steps | None = None  # with scales that are nobody's

    def program(self, tuning: Tuning) -> Kernels:
        """Return the kernels' arrays under a tuning; made once for each fit, for all twins."""
        key = id(tuning.covariance), id(tuning.archive)  # of arrays that live on in the tuning that is kept
        if key not in self._programs:
            made = kernels_of(self.target.space, self.parts, tuning, self._elsewhere, self._places(tuning), self._calls)
            self._programs[key] = tuning, made
        return self._programs[key][1]

    def _places(self, tuning: Tuning) -> Places:
        """Return the places of kernels that put objects down."""
        return {}

    def _stretch(self, rng: np.random.Generator, walk: Callable, calls: np.ndarray, target: Target, tuning: Tuning,
                 draws: int, thin: int, gain: float) -> Stretch:  # fmt: skip
        """Return the Stretch of draws * thin steps from where a Target's chain is; every `thin`-th place is kept."""
        if self._choices is None:
            self._choices = steps_of(self.parts, tuning)
        scale = np.ones(len(self.parts)) if tuning.scale is None else tuning.scale.copy()
        steps, now, temperature = (
            self._choices._replace(scale=scale), target.chain.values[NOW], float(tuning.temperature)
        )  # fmt: skip
        kept, counts, done = np.empty((draws, len(now))), np.zeros((len(self.parts), 2), np.int64), 0
        if isinstance(walk, Kernel):
            walk = walk.bound(rng, calls, target, steps, now, temperature, gain, done, thin, kept, counts)
        while done < draws * thin:
            done, k = walk(rng, calls, target, steps, now, temperature, gain, done, thin, kept, counts)
            if k >= 0:
                target = self._take(rng, k, steps.scale[k : k + 1], target, tuning, gain, counts[k])
                now, done = target.chain.values[NOW], done + 1
                if done % thin == 0:
                    kept[done // thin - 1] = now
        return Stretch(kept[:, :PRIOR].copy(), kept[:, PRIOR:].copy(), counts, steps.scale)

    def _take(self, rng: np.random.Generator, k: int, scale: np.ndarray, target: Target, tuning: Tuning, gain: float,
              counts: np.ndarray) -> Target:  # fmt: skip
        """Take a step of kernel k, whose scale (1,) and counts (2,) change in place; return the Target after it."""
        raise NotImplementedError


class InterpretedBackend(_Programmed):
    """Runs a mixture on any target that has a `space`, and the `log_prior` and `log_likelihood` of values (P,): the
    compiled walk's own source, not compiled, a few thousand steps a second.

    Where objects are in the world it does not know: what stands on an object rides along with it, and none is put down
    anew.

    engine : what is asked for densities by `evaluate`; None: the target, by this backend itself.
    replaced : functions by name, in place of those that the walk and the proposals call by that name.
    """

    def __init__(self, target: Any, parts: list[Part], engine: Any = None, **replaced: Callable) -> None:
        self.replaced, self._called, self._engine = replaced, list[Callable](), engine or self
        space, size = target.space, len(target.space.addresses)
        taken = [part._replace(weight=0.0) if kernels[part.type].form == PLACING else part for part in parts]
        super().__init__(target, taken, frozenset(), [self._calls_of(part) for part in parts])
        unknowns, laws = laws_of(space, getattr(target, "folds", {}), self._number_of)
        self._model = Model(unknowns, laws, np.zeros((4, size), np.int64), NO_ARRAY, NO_ARRAY, NO_ARRAY, 0)
        self._chain = Chain(
            values=np.zeros((2, size + 2)), numbers=NO_ARRAY, pose=NO_ARRAY, marks=NO_ARRAY, moved_pose=NO_ARRAY,
            moved_size=NO_ARRAY, tangents=np.zeros((2, max(int(space.directions[-1]), 3))),
            relative=NO_ARRAY, flags=np.array([0]),
        )  # fmt: skip
        own: dict[str, Callable] = {"call_for_number": self._call, "call_for_nothing": self._call, **replaced}
        self._walk = interpreted(walk, **own)
        steps = interpreted(attempt, evaluate=_evaluate, **own), _settle
        self._steps = np.array([self._numbered(step) for step in steps])

    def twin(self) -> "InterpretedBackend":
        return InterpretedBackend(self.target, self.parts, **self.replaced)

    def evaluate(self, values: np.ndarray) -> tuple[float, float]:
        """Return log prior and log likelihood; outside the prior's support the likelihood is not asked for."""
        log_prior = self.target.log_prior(values)
        return (log_prior, self.target.log_likelihood(values)) if log_prior > -math.inf else (-math.inf, -math.inf)

    def sweep(
        self, rng: np.random.Generator, values: np.ndarray, tuning: Tuning, draws: int, thin: int, gain: float = 0.0
    ) -> Stretch:
        """Take draws * thin steps from `values`; keep every `thin`-th state. gain : of the scales' adaptation."""
        return self.walked(rng, np.array([*values, *self.evaluate(values)]), tuning, draws, thin, gain)

    def walked(
        self, rng: np.random.Generator, state: np.ndarray, tuning: Tuning, draws: int, thin: int, gain: float = 0.0
    ) -> Stretch:
        """Return what `sweep` does, from (P + 2,) values with their log prior and log likelihood."""
        self._chain.values[:] = state
        target = Target(self._model, self.program(tuning), self._chain, self._engine)
        return self._stretch(rng, self._walk, self._steps, target, tuning, draws, thin, gain)

    def _call(self, number: int, *arguments: Any) -> float:
        return self._called[number](*arguments)

    def _number_of(self, kernel: Kernel, *types: Any) -> int:
        """Return the number by which the walk calls a kernel, interpreted."""
        return self._numbered(interpreted(kernel, call_for_number=self._call, **self.replaced))

    def _numbered(self, function: Callable) -> int:
        self._called.append(function)
        return len(self._called) - 1

    def _calls_of(self, part: Part) -> Calls:
        kind = kernels[part.type]
        if kind.form == PLACING:
            return Calls(place=self._numbered(lambda *_: math.nan))
        return Calls(self._number_of(kind.proposal))


def _evaluate(model: Model, chain: Chain, engine: Any) -> None:
    """Write log prior and log likelihood of the proposed values beside them."""
    chain.values[NEXT, PRIOR:] = engine.evaluate(chain.values[NEXT, :PRIOR].copy())


def _settle(target: Target, accepted: bool) -> None:
    """Make the proposed values the current ones, or forget them."""
    source = NEXT if accepted else NOW
    target.chain.values[1 - source] = target.chain.values[source]


class CompiledBackend(_Programmed):
    """Runs a mixture on a SceneTarget compiled; one object per thread, the others of which are its twins.

    Kernels that move numbers of a likelihood which take more than to score the whole image anew are interpreted, in
    between.

    Raises NotCompiled : something of the model has no compiled form.
    """

    def __init__(self, target: Any, parts: list[Part]) -> None:
        self.model, self.held = model_of(target), held(target)
        somewhere = target.space.sample(np.random.default_rng(0))
        self._first = target.graph(somewhere).solids()  # the engine needs one scene to size its arrays
        evaluator = target.images.evaluator()
        evaluator.load(self._first)
        if blur := target.likelihood.get("blur"):
            most = min(blur.support[1], evaluator.likelihood.known["blur"].upper)
            for radius in range(blur_radius(most) + 1):
                allow_blur(evaluator.for_steps(), radius)
        chain = chain_of(target)
        self._blank = chain, evaluator
        somewhere = np.ascontiguousarray(somewhere, np.float64)
        self._log_prior = log_prior.bound(self.model.unknowns, self.model.laws, somewhere)
        self._load = loader(self.model, chain, evaluator.for_steps(), somewhere)
        super().__init__(target, parts, taken_elsewhere(target, parts), calls_of(target, parts, self.model, chain))
        self._begin()

    def _begin(self) -> None:
        """Take a chain and an engine of its own, in which nothing has happened yet."""
        chain, evaluator = self._blank
        self.chain, self.evaluator = Chain(*(array.copy() for array in chain)), evaluator.copy()
        self._loaded = b""
        if not self._elsewhere:
            return
        self._trial = copy(self)
        self._trial.chain, self._trial.evaluator = Chain(*(array.copy() for array in chain)), evaluator.copy()
        only: Callable = lambda *_: 0  # noqa: E731 - which kernel takes the step has been drawn already
        self._interpreted = {
            k: InterpretedBackend(self.target, [self.parts[k]], engine=self._trial, pick=only) for k in self._elsewhere
        }

    def twin(self) -> "CompiledBackend":
        """Return a backend for another thread or stretch; they share what follows from the model and from tunings."""
        other = copy(self)
        other._begin()
        return other

    def load(self, values: np.ndarray) -> None:
        """Make (P,) values inside the prior's support the current ones."""
        values = np.ascontiguousarray(values, np.float64)
        if values.tobytes() == self._loaded:
            return
        if self.held:
            self.evaluator.set_values({name: float(values[at]) for name, at in self.held.items()}, rescore=False)
            if self.evaluator.state is None:
                self.evaluator.load(self._first)
        self._load(self.model, self.chain, self.evaluator.for_steps(), values)
        self._loaded = values.tobytes()

    def evaluate(self, values: np.ndarray) -> tuple[float, float]:
        """Return log prior and log likelihood; -inf and -inf outside the prior's support."""
        values = np.ascontiguousarray(values, np.float64)
        if self._log_prior(self.model.unknowns, self.model.laws, values) == -np.inf:
            return -np.inf, -np.inf
        self.load(values)
        prior, likelihood = self.chain.values[NOW, [PRIOR, DENSITY]]
        return (float(prior), float(likelihood)) if prior > -np.inf else (-np.inf, -np.inf)

    def _places(self, tuning: Tuning) -> Places:
        chain = Chain(*(array.copy() for array in self._blank[0]))
        return places_seen(self.target, self.parts, self.model, chain, tuning.places)

    def sweep(
        self, rng: np.random.Generator, values: np.ndarray, tuning: Tuning, draws: int, thin: int, gain: float = 0.0
    ) -> Stretch:
        """Take draws * thin steps from `values`, loaded in full; keep every `thin`-th state.

        gain : of the scales' adaptation.
        """
        self.load(values)
        target = Target(self.model, self.program(tuning), self.chain, self.evaluator.for_steps())
        calls = np.array([address_of(attempt, rng, target, np.int64(0), 1.0, 1.0), address_of(settle, target, True)])
        self._loaded = b""
        stretch = self._stretch(rng, walk, calls, target, tuning, draws, thin, gain)
        self._loaded = stretch.values[-1].tobytes()
        return stretch

    def _take(self, rng: np.random.Generator, k: int, scale: np.ndarray, target: Target, tuning: Tuning, gain: float,
              counts: np.ndarray) -> Target:  # fmt: skip
        step = self._interpreted[k].walked(rng, target.chain.values[NOW], tuning._replace(scale=scale), 1, 1, gain)
        counts += step.counts[0]
        scale[:] = step.scale
        if not step.counts[0, 1]:
            return target  # a step is tried on arrays of its own, so nothing has to be loaded again
        trial = self._trial
        self.chain, trial.chain = trial.chain, self.chain
        self.evaluator, trial.evaluator = trial.evaluator, self.evaluator
        trial._loaded = b""
        return target._replace(chain=self.chain, engine=self.evaluator.for_steps())


Backend = CompiledBackend | InterpretedBackend


def backend_of(target: Any, parts: list[Part]) -> Backend:
    """Return what runs a mixture: compiled, or interpreted where something of the target has no compiled form."""
    if isinstance(target, SceneTarget):
        try:
            return CompiledBackend(target, parts)
        except NotCompiled as reason:
            target.uncompiled = str(reason)
    return InterpretedBackend(target, parts)
