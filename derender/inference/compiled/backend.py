"""The compiled backend: a mixture on a scene's target without Python between the steps."""

import numpy as np

from derender.inference.compiled.evaluate import load
from derender.inference.compiled.layout import DENSITY, NOW, PRIOR, STEPS, Kernels
from derender.inference.compiled.program import NotCompiled, chain_of, kernels_of, model_of
from derender.inference.compiled.steps import WINDOW, sweep
from derender.inference.kernels import kernels
from derender.inference.kernels.base import Part, Tuning
from derender.inference.sampler import Stretch


class CompiledBackend:
    """Runs a mixture on a SceneTarget compiled; one object per thread.

    Raises
    ------
    NotCompiled : something of the model or of the mixture has no compiled form.
    """

    def __init__(self, target, parts: list[Part], cycle: bool = False) -> None:
        self.target, self.parts, self.cycle = target, parts, cycle
        for part in parts:
            if kernels[part.type].code is None:
                raise NotCompiled(f"the kernel {part.type}")
        self.model = model_of(target)
        counts = [int(part.options["count"]) for part in parts if kernels[part.type].code == WINDOW]
        self.chain = chain_of(target, self.model, max(counts, default=1), cycle)
        evaluator = target.images.evaluator()
        evaluator.load(target.graph(self._somewhere()).solids())
        self.engine = evaluator.state
        self._tuned: tuple[Tuning, Kernels] | None = None

    def _somewhere(self) -> np.ndarray:
        """Return values inside the support: the engine needs one scene to size its arrays."""
        return self.target.space.sample(np.random.default_rng(0))

    def evaluate(self, values):
        """Return log prior and log likelihood; -inf and -inf outside the prior's support."""
        if self.target.log_prior(values) == -np.inf:
            return -np.inf, -np.inf
        load(self.model, self.chain, self.engine, np.ascontiguousarray(values, np.float64))
        return float(self.chain.values[NOW, PRIOR]), float(self.chain.values[NOW, DENSITY])

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
        sweep(rng, self.model, program, self.chain, self.engine, draws, thin, tuning.temperature, kept, counts)
        return Stretch(kept[:, :size].copy(), kept[:, size : size + 2].copy(), counts)
