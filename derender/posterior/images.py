"""A likelihood bound to one observed image: what a scene's target asks of the rendering side."""

import threading
from collections.abc import Mapping
from typing import Any

import numpy as np

from derender.scene.graph import SceneGraph


class ObservedImage:
    """One depth image under one likelihood.

    Parameters
    ----------
    camera : Camera. observed : (H, W) metres, NaN where nothing returned.
    type : registered likelihood. values : its fixed numbers by name.
    """

    def __init__(self, camera, observed: np.ndarray, type: str = "gaussian", values: Mapping[str, float] | None = None):
        self.camera, self.observed, self.type = camera, np.ascontiguousarray(observed, np.float64), type
        self.values = dict(values or {})
        self._evaluators = threading.local()

    def evaluator(self):
        """Return a new DepthEvaluator: each chain, which may run in a thread of its own, has one."""
        from derender.render.raycast.evaluator import DepthEvaluator

        return DepthEvaluator(self.camera, self.observed, self.type, self.values)

    def log_likelihood(self, graph: SceneGraph, parameters: Mapping[str, float]) -> float:
        """Return the log likelihood of a scene; `parameters` are the likelihood's unknowns by name."""
        if not hasattr(self._evaluators, "own"):
            self._evaluators.own = self.evaluator()
        return self._evaluators.own.log_likelihood(graph.solids(), parameters)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_evaluators"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _evaluators=threading.local())
