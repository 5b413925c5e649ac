"""The compiled backend: a mixture on a scene's target without Python between the steps."""

from collections import deque
from copy import copy
from typing import Any

import numpy as np

from derender.posterior.compiled.evaluate import load
from derender.posterior.compiled.interpreted import InterpretedBackend
from derender.posterior.compiled.layout import DENSITY, NOW, PRIOR, STEPS, Chain, Kernels, Stretch
from derender.posterior.compiled.model import (
    NotCompiled,
    calls_of,
    chain_of,
    held,
    kernels_of,
    model_of,
    objects_below,
    places_seen,
    rescaled,
    taken_elsewhere,
)
from derender.posterior.compiled.steps import sweep
from derender.posterior.kernels.base import Part, Tuning
from derender.posterior.target import SceneTarget


class LoadedTarget:
    """A SceneTarget whose densities are those of a backend's engine, a tenth of the cost of the target's own."""

    def __init__(self, backend: "CompiledBackend") -> None:
        self._backend, self._target = backend, backend.target

    def __getattr__(self, name: str) -> Any:
        return getattr(self._target, name)

    def log_prior(self, values: np.ndarray) -> float:
        """Return the log prior of (P,) values."""
        return self._backend.evaluate(values)[0]

    def log_likelihood(self, values: np.ndarray) -> float:
        """Return the log likelihood of values inside the prior's support."""
        return self._backend.evaluate(values)[1]


MOST_PROGRAMS = 24  # that are remembered: those of a ladder and of the chains that warm up


class CompiledBackend:
    """Runs a mixture on a SceneTarget compiled; one object per thread, the others of which are its twins.

    Kernels that move likelihood numbers whose change means to draw or score the whole image anew are interpreted, in
    between.

    Raises NotCompiled : something of the model has no compiled form.
    """

    def __init__(self, target: Any, parts: list[Part], cycle: bool = False) -> None:
        self.target, self.parts, self.cycle = target, parts, cycle
        self.model = model_of(target)
        self.held, self._elsewhere = held(target), taken_elsewhere(target, parts)
        self._first = target.graph(self._somewhere()).solids()  # the engine needs one scene to size its arrays
        evaluator = target.images.evaluator()
        evaluator.load(self._first)
        self._blank = chain_of(target, self.model, cycle), evaluator
        self._calls = calls_of(target, parts, self.model, self._blank[0])
        self._programs: deque[tuple[Tuning, Kernels, dict[int, np.ndarray]]] = deque(maxlen=MOST_PROGRAMS)
        self._begin()

    def _begin(self) -> None:
        """Take a chain and an engine of its own, in which nothing has happened yet."""
        chain, evaluator = self._blank
        self.chain, self.evaluator = Chain(*(array.copy() for array in chain)), evaluator.copy()
        self._loaded = np.empty(0)
        self._tuned: tuple[Tuning, Kernels] | None = None
        target = LoadedTarget(self)
        self._interpreted = {k: InterpretedBackend(target, [self.parts[k]], pick=_only) for k in self._elsewhere}

    def twin(self) -> "CompiledBackend":
        """Return a backend for another thread or stretch; they share what follows from the model and from tunings."""
        other = copy(self)
        other._begin()
        return other

    def _somewhere(self) -> np.ndarray:
        return self.target.space.sample(np.random.default_rng(0))

    def load(self, values: np.ndarray) -> None:
        """Make (P,) values inside the prior's support the current ones."""
        if np.array_equal(values, self._loaded):
            return
        if self.held:
            self.evaluator.set_values({name: float(values[at]) for name, at in self.held.items()}, rescore=False)
            if self.evaluator.state is None:
                self.evaluator.load(self._first)
        load(self.model, self.chain, self.evaluator.for_steps(), np.ascontiguousarray(values, np.float64))
        self._loaded = np.array(values)

    def evaluate(self, values: np.ndarray) -> tuple[float, float]:
        """Return log prior and log likelihood; -inf and -inf outside the prior's support."""
        if self.target.space.log_prior(values) == -np.inf:
            return -np.inf, -np.inf
        self.load(values)
        prior, likelihood = self.chain.values[NOW, [PRIOR, DENSITY]]
        return (float(prior), float(likelihood)) if prior > -np.inf else (-np.inf, -np.inf)

    def program(self, tuning: Tuning) -> Kernels:
        """Return the mixture's arrays under a tuning; those of the last ones are kept, for all twins."""
        tuned = self._tuned
        if tuned is None or tuned[0] is not tuning:
            tuned = self._tuned = tuning, self._program(tuning)
        return tuned[1]

    def _program(self, tuning: Tuning) -> Kernels:
        places = None
        for former, program, seen in list(self._programs):
            same = [getattr(former, field) is getattr(tuning, field) for field in ("mean", "covariance", "archive")]
            if all(same):
                return rescaled(self.target.space, self.parts, tuning, program)
            if same[2] and (tuning.archive is not None or same[0]):
                places = seen
        if places is None:
            chain = Chain(*(array.copy() for array in self._blank[0]))
            places = places_seen(self.target, self.parts, self.model, chain, tuning.places)
        program = kernels_of(self.target.space, self.parts, tuning, self._elsewhere, places, self._calls,
                             lambda objects: objects_below(self.target, objects))  # fmt: skip
        self._programs.append((tuning, program, places))
        return program

    def sweep(
        self, rng: np.random.Generator, values: np.ndarray, tuning: Tuning, draws: int, thin: int, taken: int = 0
    ) -> Stretch:
        """Take draws * thin steps from `values`, loaded in full; keep every `thin`-th state."""
        program, size = self.program(tuning), len(values)
        kept, counts = np.empty((draws, size + 2)), np.zeros((len(self.parts), 2), np.int64)
        self.load(values)
        self.chain.flags[STEPS] = taken
        now = self.chain.values[NOW]
        done, k = 0, -1
        while done < draws * thin:
            done, k = sweep(rng, self.model, program, self.chain, self.evaluator.state, done, draws, thin,
                            tuning.temperature, kept, counts)  # fmt: skip
            self._loaded = now[:size].copy()
            if k >= 0:
                step = self._interpreted[k].walked(rng, now.copy(), tuning, 1, 1)
                counts[k] += step.counts[0]
                self.load(step.values[0])
                done += 1
                if done % thin == 0:
                    kept[done // thin - 1] = now
        return Stretch(kept[:, :size].copy(), kept[:, size:].copy(), counts)


def backend_of(target: Any, parts: list[Part], cycle: bool = False) -> CompiledBackend | InterpretedBackend:
    """Return what runs a mixture: compiled, or interpreted where something of the target has no compiled form."""
    if isinstance(target, SceneTarget):
        try:
            return CompiledBackend(target, parts, cycle)
        except NotCompiled as reason:
            target.uncompiled = str(reason)
    return InterpretedBackend(target, parts, cycle)


def _only(rng: np.random.Generator, table: Any, numbers: Any, flags: Any) -> int:
    """Return the number of a mixture's only kernel: which one takes the step has been drawn already."""
    return 0
