"""The engine for Python: log likelihoods of scenes of one image, in full or incrementally."""

from collections.abc import Mapping
from copy import copy

import numpy as np

from derender.camera.intrinsics import Camera
from derender.errors import DerenderError
from derender.render.likelihoods import Likelihood, likelihoods
from derender.render.raycast.engine import change_blur, for_steps, load_state, new_engine, rescore_state
from derender.render.raycast.state import (
    CURRENT,
    DEPTH,
    GAUSSIAN,
    GOING_ON,
    LIKELIHOOD,
    OBSERVED,
    OBSERVED_IMAGE,
    PAD,
    SCORE,
    SIGMA,
    EngineState,
    array_by_array,
)
from derender.scene.solids import Solids


def engine_under(likelihood: Likelihood, values: Mapping[str, float], camera: Camera, observed: np.ndarray,
                 solids: Solids, beside: np.ndarray | None = None) -> EngineState:  # fmt: skip
    """Return the state for an image (H, W) under a likelihood's numbers and for scenes of such solids.

    beside : see `Likelihood.beside`; None: it is made here.
    """
    beside = likelihood.beside(observed, values) if beside is None else beside
    return new_engine(camera, observed, solids, likelihood.code, likelihood.row(values), values["blur"], beside)


class DepthEvaluator:
    """Evaluates scenes against one observed image. Each chain has its own.

    camera : Camera.
    observed : (height, width) metres; NaN, 0 or infinite where nothing returned.
    likelihood : registered name.
    values : the likelihood's numbers by name; what is left out has its default.

    state : EngineState of the scene loaded last; None before.

    Raises DerenderError : an image of another size than the camera's, or likelihood values out of range.
    """

    def __init__(
        self,
        camera: Camera,
        observed: np.ndarray,
        likelihood: str = "gaussian",
        values: Mapping[str, float] | None = None,
    ) -> None:
        observed = np.asarray(observed, np.float64)
        if observed.shape != (camera.height, camera.width):
            raise DerenderError(
                f"the image has {observed.shape[1]} x {observed.shape[0]} pixels and the camera "
                f"{camera.width} x {camera.height}",
                remedy="give the camera of this image",
            )
        self.camera = camera
        self.observed = observed
        self.likelihood = likelihoods[likelihood]
        self.values = self.likelihood.complete(values)
        self.state: EngineState | None = None
        self._meshes: tuple = ()

    def copy(self) -> "DepthEvaluator":
        """Return another evaluator of the same image that goes on from here: cheaper than a new one."""
        other = copy(self)
        if self.state is not None:
            other.state = array_by_array(np.copy, self.state)
        return other

    @classmethod
    def of_depth(
        cls, observed: np.ndarray, depth: np.ndarray, likelihood: str, values: Mapping[str, float]
    ) -> "DepthEvaluator":
        """Return an evaluator of a clean depth image (height, width) that is given, not drawn: see `set_values`."""
        height, width = depth.shape
        evaluator = cls(Camera(1.0, 1.0, 0.0, 0.0, width, height), observed, likelihood, values)
        nothing = Solids(np.zeros(0, np.int32), np.zeros((0, 4, 4)), np.zeros((0, 3)), np.zeros(0, np.int32))
        evaluator.load(nothing)
        assert evaluator.state is not None
        image = evaluator.state.images[DEPTH]
        image[:, PAD : PAD + width] = depth
        image[:, :PAD], image[:, PAD + width :] = depth[:, :1], depth[:, -1:]
        return evaluator

    def log_likelihood(self, solids: Solids, values: Mapping[str, float] | None = None) -> float:
        """Return the log likelihood of a scene: the full evaluation. The scene becomes the current one.

        values : changed numbers of the likelihood; they stay.
        """
        if values and any(self.values.get(name) != value for name, value in values.items()):
            self.set_values(values, rescore=False)
        return self.load(solids)

    def load(self, solids: Solids) -> float:
        """Make a scene the current one; return its log likelihood. Another structure than the last gets a new state."""
        state = self.state
        if state is None or not self._fits(state, solids):
            self.state = state = engine_under(self.likelihood, self.values, self.camera, self.observed, solids)
            self._meshes = solids.meshes
        return load_state(
            state, np.ascontiguousarray(solids.pose, np.float64), np.ascontiguousarray(solids.size, np.float64)
        )

    def _fits(self, state: EngineState, solids: Solids) -> bool:
        same_meshes = len(self._meshes) == len(solids.meshes) and all(
            a[0] is b[0] and a[1] is b[1] for a, b in zip(self._meshes, solids.meshes, strict=True)
        )
        return same_meshes and np.array_equal(state.kind[0], solids.kind) and np.array_equal(state.kind[1], solids.mesh)

    def set_values(self, values: Mapping[str, float], rescore: bool = True) -> float | None:
        """Change numbers of the likelihood; return the current scene's log likelihood under them (None without one).

        Nothing is drawn again unless the background changed, and then, without `rescore`, by the next `load` alone.
        """
        former, self.values = self.values, self.likelihood.complete({**self.values, **values})
        if self.state is None:
            return None
        if self.values["blur"] != former["blur"]:
            change_blur(self.state, self.values["blur"])
        state, row = self.state, self.likelihood.row(self.values)
        observed = state.parameters[OBSERVED]
        state.parameters[SIGMA : SIGMA + len(row)] = row
        state.parameters[OBSERVED] = observed
        if any(self.values[name] != former[name] for name in self.likelihood.of_image):
            beside = self.likelihood.beside(self.observed, self.values)
            state.images[-GOING_ON, :, PAD : PAD + self.camera.width] = beside
        if not rescore:
            return None
        if self.values["background"] != former["background"]:
            return load_state(state, state.pose[CURRENT].copy(), state.size[CURRENT].copy())
        return rescore_state(state)

    def per_pixel(self) -> np.ndarray:
        """Return the log density of each pixel under the current scene, (height, width) float64."""
        state = self._loaded()
        seen = slice(PAD, PAD + self.camera.width)
        score = state.images[SCORE + CURRENT, :, seen].astype(float)
        if state.settings[LIKELIHOOD] != GAUSSIAN:
            return score
        sigma = state.parameters[SIGMA]
        density = -0.5 * score / (sigma * sigma) - np.log(sigma) - 0.5 * np.log(2.0 * np.pi)
        return np.where(np.isnan(state.images[OBSERVED_IMAGE, :, seen]), 0.0, density)

    def model_depth(self) -> np.ndarray:
        """Return the clean model image of the current scene, with the background wall: (height, width) float32."""
        return self._loaded().images[1, :, PAD : PAD + self.camera.width].copy()

    def for_steps(self) -> EngineState:
        """Return the state for compiled code that calls the engine's kernels."""
        return for_steps(self._loaded())

    def _loaded(self) -> EngineState:
        if self.state is None:
            raise ValueError("load a scene first")
        return self.state
