"""What a likelihood of depth images is: a normalised density over images given the clean depth of a scene."""

import math
from collections.abc import Mapping

import numpy as np

from derender.errors import DerenderError
from derender.registry import Parameter, Registry
from derender.render.blur import blur

likelihoods: Registry["Likelihood"] = Registry("likelihood", "derender.likelihoods")

SIGMA = Parameter("sigma", "m", 1e-6, 10.0, 0.005)
BLUR = Parameter("blur", "", 0.0, 5.0, 0.0)
BACKGROUND = Parameter("background", "m", 0.01, 1000.0, 10.0)


class Likelihood:
    """A type of likelihood: pixels are independent given the clean depth image of the scene (Eq. 6).

    Everywhere `depth` is the clean (H, W) depth in metres, NaN where no surface is hit; `observed` an (H, W) image, NaN
    (or 0, or infinite) where nothing returned; `values` numbers by parameter name, defaults where they say nothing.

    The clean image ends at a wall at depth `background`: what lies beyond it, or hits nothing, has that depth. So the
    model image is finite everywhere, and Eq. 6 a density over whole images.

    Attributes
    ----------
    name : registered name.
    parameters : the numbers that a file can give, or distributions over them.
    code : which compiled score the engine uses (raycast.state.GAUSSIAN, ROBUST or CORRELATED).
    of_image : names of the numbers on which `beside` depends.
    """

    name: str
    parameters: tuple[Parameter, ...]
    code: int
    of_image: tuple[str, ...] = ()

    def complete(self, values: Mapping[str, float] | None) -> dict[str, float]:
        """Return a number for every parameter.

        Raises
        ------
        DerenderError : an unknown name, or a number out of range.
        """
        known = {parameter.name: parameter for parameter in self.parameters}
        result = {name: float(parameter.default or 0.0) for name, parameter in known.items()}
        for name, value in (values or {}).items():
            if name not in known:
                raise DerenderError(
                    f"a {self.name} likelihood has no {name!r}", "likelihood", "it has " + ", ".join(known)
                )
            parameter = known[name]
            if not parameter.lower <= value <= parameter.upper:
                raise DerenderError(
                    f"{name} is {value:g}",
                    f"likelihood.{name}",
                    f"it lies in [{parameter.lower:g}, {parameter.upper:g}]",
                )
            result[name] = float(value)
        self.check(result)
        return result

    def check(self, values: Mapping[str, float]) -> None:
        """Raise a DerenderError where complete values do not fit together."""

    def row(self, values: Mapping[str, float]) -> np.ndarray:
        """Return the engine's numbers: sigma, background, a place to fill, then the type's own."""
        raise NotImplementedError

    def beside(self, observed: np.ndarray, values: Mapping[str, float]) -> np.ndarray | None:
        """Return what of an image (H, W) the engine's score needs that no scene changes; None: nothing."""
        return None

    def per_pixel(
        self, observed: np.ndarray, depth: np.ndarray, values: Mapping[str, float] | None = None
    ) -> np.ndarray:
        """Return the log density of each pixel, (H, W) float64; 0 where it says nothing: the readable reference."""
        raise NotImplementedError

    def sample(
        self, rng: np.random.Generator, depth: np.ndarray, values: Mapping[str, float] | None = None
    ) -> np.ndarray:
        """Draw an observed image: (H, W) float64, NaN where nothing returns."""
        raise NotImplementedError

    def log_density(self, observed: np.ndarray, depth: np.ndarray, values: Mapping[str, float] | None = None) -> float:
        """Return the log density of an observed image."""
        return math.fsum(self.per_pixel(observed, depth, values).ravel())


def with_wall(depth: np.ndarray, background: float) -> np.ndarray:
    """Return the clean depth in front of the wall: no pixel is missing, none is deeper than `background`."""
    return np.fmin(np.where(np.isnan(depth), np.inf, depth), background)


def blurred_depth(depth: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
    """Return the blurred model image b(d) of Eq. 6, with the wall."""
    return blur(with_wall(depth, values["background"]), values["blur"])


def has_return(observed: np.ndarray) -> np.ndarray:
    """Return where a pixel holds a depth: positive and finite."""
    return np.isfinite(observed) & (observed > 0)
