"""The compiled backend: a mixture on a scene's target without Python between the steps."""

from typing import Any

import numpy as np

from derender.inference.compiled.evaluate import load
from derender.inference.compiled.layout import DENSITY, NOW, PRIOR, STEPS, Kernels
from derender.inference.compiled.program import chain_of, kernels_of, model_of
from derender.inference.compiled.steps import WINDOW, sweep
from derender.inference.kernels import kernels
from derender.inference.kernels.base import Part, State, Tuning
from derender.inference.sampler import Stretch


class CompiledBackend:
    """Runs a mixture on a SceneTarget compiled; one object per thread.

    Kernels without a compiled form take their steps as they stand, in between.

    Raises
    ------
    NotCompiled : something of the model has no compiled form.
    """

    def __init__(self, target, parts: list[Part], cycle: bool = False) -> None:
        self.target, self.parts, self.cycle = target, parts, cycle
        self.model = model_of(target)
        counts = [int(part.options["count"]) for part in parts if kernels[part.type].code == WINDOW]
        self.chain = chain_of(target, self.model, max(counts, default=1), cycle)
        evaluator = target.images.evaluator()
        evaluator.load(target.graph(self._somewhere()).solids())
        self.engine = evaluator.state
        self._tuned: tuple[Tuning, Kernels] | None = None
        self._readable: tuple[Tuning, dict[int, Any]] | None = None

    def _somewhere(self) -> np.ndarray:
        """Return values inside the support: the engine needs one scene to size its arrays."""
        return self.target.space.sample(np.random.default_rng(0))

    def evaluate(self, values):
        """Return log prior and log likelihood; -inf and -inf outside the prior's support."""
        if self.target.log_prior(values) == -np.inf:
            return -np.inf, -np.inf
        load(self.model, self.chain, self.engine, np.ascontiguousarray(values, np.float64))
        return float(self.chain.values[NOW, PRIOR]), float(self.chain.values[NOW, DENSITY])

    def readable(self, tuning: Tuning) -> dict[int, Any]:
        """Return the kernels without a compiled form by their numbers, tuned; those of the last tuning are kept."""
        if self._readable is None or self._readable[0] is not tuning:
            self._readable = tuning, {
                k: kernels[part.type].build(self.target, part.block, tuning, part.options)
                for k, part in enumerate(self.parts)
                if kernels[part.type].code is None
            }
        return self._readable[1]

    def program(self, tuning: Tuning) -> Kernels:
        """Return the mixture's arrays under a tuning; those of the last one are kept."""
        if self._tuned is None or self._tuned[0] is not tuning:
            self._tuned = tuning, kernels_of(self.target, self.parts, tuning)
        return self._tuned[1]

    def sweep(self, rng, values, tuning: Tuning, draws: int, thin: int, taken: int = 0) -> Stretch:
        """Take draws * thin steps from `values`, loaded in full; keep every `thin`-th state."""
        program = self.program(tuning)
        load(self.model, self.chain, self.engine, np.ascontiguousarray(values, np.float64))
        self.chain.flags[STEPS] = taken
        size = len(values)
        kept = np.empty((draws, size + 3))
        counts = np.zeros((len(self.parts), 2), np.int64)
        done, k = 0, -1
        while done < draws * thin:
            done, k = sweep(rng, self.model, program, self.chain, self.engine, done, draws, thin, tuning.temperature,
                            kept, counts)  # fmt: skip
            if k >= 0:
                now = self.chain.values[NOW]
                state = State(now[:size].copy(), float(now[PRIOR]), float(now[DENSITY]))
                state, info = self.readable(tuning)[k](rng, state)
                counts[k] += 1, info.accepted
                if info.accepted:
                    load(self.model, self.chain, self.engine, state.values)
                done += 1
                if done % thin == 0:
                    kept[done // thin - 1] = self.chain.values[NOW]
        return Stretch(kept[:, :size].copy(), kept[:, size : size + 2].copy(), counts)
