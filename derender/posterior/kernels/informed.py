"""Steps whose density depends on where they start: what `langevin` and `newton` have in common."""

import math
from typing import Any

import numpy as np

from derender.posterior.kernels.base import decide, evaluate


class Informed:
    """Propose tangent t with a density q(t | place) that knows the place: its gradient, and perhaps its curvature.

    With b the tangent back, from new to old,
    log ratio = log posterior(new) - log posterior(old) + log q(b | new) - log q(t | old).
    Refused: steps of more than half a period, which `difference` would read the short way. Any gradient leaves the
    step exact if it depends on the place alone; a good one makes it fast.
    """

    name: str

    def __init__(self, target, block, derivative, scale, temperature=1.0):
        self.target, self.block, self.derivative = target, block, derivative
        self.scale, self.temperature = scale, temperature

    def known(self, values: np.ndarray) -> Any:
        """Return what q takes from a place, such as its mean (D,)."""
        raise NotImplementedError

    def tangent(self, normal: np.ndarray, known: Any) -> np.ndarray:
        """Return the tangent (D,) that a standard normal vector (D,) stands for."""
        raise NotImplementedError

    def log_proposal(self, tangent: np.ndarray, known: Any) -> float:
        """Return log q of a tangent up to a constant."""
        raise NotImplementedError

    def __call__(self, rng, state):
        space = self.target.space
        normal = np.array([rng.standard_normal() for _ in range(space.size(self.block))])
        here = self.known(state.values)
        tangent = self.tangent(normal, here)
        new = evaluate(self.target, space.move(state.values, self.block, tangent))
        correction = 0.0
        if new.log_prior > -math.inf:
            back = space.difference(state.values, new.values, self.block)
            if np.allclose(back, -tangent, rtol=1e-6, atol=1e-9):
                correction = self.log_proposal(back, self.known(new.values)) - self.log_proposal(tangent, here)
            else:
                new = new._replace(log_prior=-math.inf)
        return decide(rng, state, new, correction, self.temperature, self.name)
