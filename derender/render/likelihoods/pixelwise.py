"""What a likelihood of depth images is; and those of pixels that err each for itself: normal (Eq. 6), and a mixture."""

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.registry import Parameter, Registry
from derender.render.blur import blur

likelihoods: Registry["Likelihood"] = Registry("likelihood", "derender.likelihoods")

Numbers = Mapping[str, float] | None  # of a likelihood, by name

SIGMA = Parameter("sigma", "m", 1e-6, 10.0, 0.005)
BLUR = Parameter("blur", "", 0.0, 5.0, 0.0)
BACKGROUND = Parameter("background", "m", 0.01, 1000.0, 10.0)


class Likelihood:
    """A type of likelihood: pixels are independent given the clean depth image of the scene (Eq. 6).

    Everywhere `depth` is the clean (H, W) depth in metres, NaN where no surface is hit; `observed` an (H, W) image, NaN
    (or 0, or infinite) where nothing returned; `values` numbers by parameter name, defaults where they say nothing.

    The clean image ends at a wall at depth `background`: what lies beyond it, or hits nothing, has that depth. So the
    model image is finite everywhere, and Eq. 6 a density over whole images.
    """

    name: str  # registered name
    parameters: tuple[Parameter, ...]  # the numbers that a file can give, or distributions over them
    code: int  # which compiled score the engine uses (raycast.state.GAUSSIAN, ROBUST or CORRELATED)
    scored: tuple[str, ...] = ()  # names of the type's own numbers that the engine's score reads, in its order
    of_image: tuple[str, ...] = ()  # names of the numbers on which `beside` depends
    of_field: tuple[str, ...] = ()  # names of the numbers of a field of noise, where images can be drawn as one

    @cached_property
    def known(self) -> dict[str, Parameter]:
        """The parameters by name."""
        return {parameter.name: parameter for parameter in self.parameters}

    @cached_property
    def defaults(self) -> dict[str, float]:
        """What the parameters are where nothing is said."""
        return {name: float(parameter.default or 0.0) for name, parameter in self.known.items()}

    def complete(self, values: Numbers) -> dict[str, float]:
        """Return a number for every parameter. Raises DerenderError : an unknown name, or a number out of range."""
        known, result = self.known, self.defaults.copy()
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
        if values.get("near", 0.0) >= values.get("far", math.inf):
            raise DerenderError("outliers range from far to near", "likelihood.far", "give a far beyond near")

    @cached_property
    def places(self) -> dict[str, int]:
        """Where the engine's row has its numbers: sigma, background, after a place to fill those of `scored`."""
        return {"sigma": 0, "background": 1, **{name: place for place, name in enumerate(self.scored, 3)}}

    def row(self, values: Mapping[str, float]) -> np.ndarray:
        """Return the engine's numbers, see `places`."""
        row = np.zeros(3 + len(self.scored))
        row[list(self.places.values())] = [values[name] for name in self.places]
        return row

    def beside(self, observed: np.ndarray, values: Mapping[str, float]) -> np.ndarray | None:
        """Return what of an image (H, W) the engine's score needs that no scene changes; None: nothing."""
        return None

    def per_pixel(self, observed: np.ndarray, depth: np.ndarray, values: Numbers = None) -> np.ndarray:
        """Return the log density of each pixel, (H, W) float64; 0 where it says nothing: the readable reference."""
        raise NotImplementedError

    def sample(self, rng: np.random.Generator, depth: np.ndarray, values: Numbers = None) -> np.ndarray:
        """Draw an observed image: (H, W) float64, NaN where nothing returns."""
        raise NotImplementedError

    def field(self, rng: np.random.Generator, depth: np.ndarray, values: Numbers = None) -> np.ndarray:
        """Draw an image whose noise is one field, where a likelihood has such noise beside its density."""
        raise DerenderError(f"a {self.name} likelihood draws no field of noise", "likelihood", "leave out drawn")

    def log_density(self, observed: np.ndarray, depth: np.ndarray, values: Numbers = None) -> float:
        """Return the log density of an observed image."""
        return math.fsum(self.per_pixel(observed, depth, values).ravel())


def with_wall(depth: np.ndarray, background: float) -> np.ndarray:
    """Return the clean depth in front of the wall: no pixel is missing, none is deeper than `background`."""
    return np.fmin(np.where(np.isnan(depth), np.inf, depth), background)


def blurred_depth(depth: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
    """Return the blurred model image b(d) of Eq. 6, with the wall."""
    return blur(with_wall(depth, values["background"]), values["blur"])


def noise_at(depth: Any, values: Mapping[str, float]) -> Any:
    """Return the standard deviation in metres of a likelihood's noise at depths: sigma + sigma_growth depth^2."""
    return values["sigma"] + values.get("sigma_growth", 0.0) * depth**2


def surface_density(residual: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return the normal density, per metre, of what a surface is off by under noise of this standard deviation."""
    return np.exp(-0.5 * (residual / spread) ** 2) / (spread * math.sqrt(2.0 * math.pi))


def drawn_image(
    kind: str, rng: np.random.Generator, depth: np.ndarray, values: Mapping[str, Any], drawn: Mapping[str, Any] | None
) -> np.ndarray:
    """Return an image (H, W) drawn by the density of a likelihood, or where `drawn` says more as a field of noise."""
    likelihood = likelihoods[kind]
    return likelihood.field(rng, depth, {**values, **drawn}) if drawn else likelihood.sample(rng, depth, values)


@likelihoods.register("gaussian")
class Gaussian(Likelihood):
    """Norm(observed; b(d), sigma) in every pixel with a return; a pixel without one is evidence of nothing."""

    parameters = (SIGMA, BLUR, BACKGROUND)
    code = 0

    def per_pixel(self, observed: np.ndarray, depth: np.ndarray, values: Numbers = None) -> np.ndarray:
        values = self.complete(values)
        seen = np.isfinite(observed) & (observed > 0)
        spread = values["sigma"]
        residual = np.where(seen, observed, 0.0) - blurred_depth(depth, values)
        density = -0.5 * (residual / spread) ** 2 - math.log(spread) - 0.5 * math.log(2.0 * math.pi)
        return np.where(seen, density, 0.0)

    def sample(self, rng: np.random.Generator, depth: np.ndarray, values: Numbers = None) -> np.ndarray:
        values = self.complete(values)
        return blurred_depth(depth, values) + rng.normal(scale=values["sigma"], size=depth.shape)


NOWHERE = 1e-30  # density, per metre, of depths outside the range
RATE = (1e-30, 1.0 - 1e-12)  # of a share: its logarithm and that of the rest are finite; {uniform: [0, 1]} fits in


def mixture(observed: np.ndarray, depth: np.ndarray, values: Mapping[str, float]) -> tuple[np.ndarray, ...]:
    """Return of each pixel (H, W) what it holds, 0 where nothing returned, the model's depth and the noise there, and
    the densities of its surface and of outliers: see `Robust`."""
    value, model = np.abs(np.where(np.isfinite(observed), observed, 0.0)), blurred_depth(depth, values)
    model = np.where((value > 0.0) & (observed < 0.0), np.minimum(model, value), model)
    spread = noise_at(model, values)
    inside = (value >= values["near"]) & (value <= values["far"])
    outliers = np.where(inside, values["outlier"] / (values["far"] - values["near"]), NOWHERE)
    return value, model, spread, (1.0 - values["outlier"]) * surface_density(value - model, spread), outliers


STEPS = ((0, 1), (1, 0), (1, 1), (1, -1))  # (rows, columns) to a neighbour: along rows, down columns, the diagonals


def bends(clean: np.ndarray, steps: tuple[tuple[int, int], ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return of each pixel (H, W) the greatest second difference of a clean depth (H, W), with the wall, along some
    steps, and the nearest and the farthest depth of it and those neighbours."""
    height, width = clean.shape
    padded = np.pad(clean, 1, mode="edge")
    bend, nearest, farthest = np.zeros(clean.shape), clean, clean
    for down, right in steps:
        one, other = (padded[1 + way * down :, 1 + way * right :][:height, :width] for way in (1, -1))
        bend = np.maximum(bend, np.abs(one + other - 2.0 * clean))
        nearest, farthest = np.minimum(nearest, np.minimum(one, other)), np.maximum(farthest, np.maximum(one, other))
    return bend, nearest, farthest


def near_edges(clean: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where pixels may fly, (H, W) bool, and between which depths, (H, W) each: see `Robust`."""
    bend, nearest, farthest = bends(clean, STEPS)
    return bend > step, nearest, farthest


def flying_density(
    value: np.ndarray, nearest: np.ndarray, farthest: np.ndarray, values: Mapping[str, float]
) -> np.ndarray:
    """Return the density, per metre, of what flies at an edge, see `Robust`; no nearest depth is a farthest one."""
    within = ((value >= nearest) & (value <= farthest)) / (farthest - nearest)
    on_one = sum(surface_density(value - one, noise_at(one, values)) for one in (nearest, farthest))
    return 0.5 * within + 0.25 * on_one


@likelihoods.register("robust")
class Robust(Likelihood):
    """With m the blurred depth and d the clean one, a pixel

        has no return with probability q = `missing_edge` at an edge, else `missing`;
        otherwise its density is (1 - outlier) Norm(m, sigma + sigma_growth m^2) + outlier Uniform(near, far).

    An edge is a pixel at which the second difference of d along the row or the column is more than `edge_step`:
    surfaces that are flat in space, at whatever slant, have next to none. A pixel's value is a depth or "no return", so
    missing pixels count: a hole where the scene has no edge is evidence.

    Of the returns at an edge, be it along a diagonal, the share `flying` lie between the surfaces beside it, the
    nearest and the farthest clean depth of the pixel and its eight neighbours, in place of all that: half of them
    anywhere, as a time-of-flight camera mixes what it sees in a pixel, a quarter on either one, as of a camera whose
    pixels look a little beside where they should.

    A pixel may show what is no part of the scene: background, or a thing of no known form. Nothing is known of such a
    surface but that it is where it was seen, unless the scene hides it. Such a pixel holds minus that depth, and its
    density is the one above with min(m, that depth) in place of m: solids behind it make no difference, and those
    before it are as improbable as they would be before any other surface.
    """

    parameters = (
        SIGMA,
        BLUR,
        BACKGROUND,
        Parameter("sigma_growth", "1/m", 0.0, 1.0, 0.0),
        Parameter("outlier", "", *RATE, 0.02),
        Parameter("near", "m", 0.0, 1000.0, 0.1),
        Parameter("far", "m", 0.0, 1000.0, 10.0),
        Parameter("missing", "", *RATE, 0.02),
        Parameter("missing_edge", "", *RATE, 0.3),
        Parameter("edge_step", "m", 1e-4, 100.0, 0.02),
        Parameter("flying", "", 0.0, RATE[1], 0.0),
    )
    code = 1
    scored = ("sigma_growth", "outlier", "near", "far", "missing", "missing_edge", "edge_step", "flying")

    def missing_rate(self, depth: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
        """Return the probability of no return, (H, W)."""
        bend, _, _ = bends(with_wall(depth, values["background"]), STEPS[:2])
        return np.where(bend > values["edge_step"], values["missing_edge"], values["missing"])

    def per_pixel(self, observed: np.ndarray, depth: np.ndarray, values: Numbers = None) -> np.ndarray:
        values = self.complete(values)
        missing, (value, _, _, surface, outliers) = self.missing_rate(depth, values), mixture(observed, depth, values)
        density = surface + outliers
        edge, nearest, farthest = near_edges(with_wall(depth, values["background"]), values["edge_step"])
        edge &= ~(observed < 0.0)
        flies = flying_density(value[edge], nearest[edge], farthest[edge], values)
        density[edge] = (1.0 - values["flying"]) * density[edge] + values["flying"] * flies
        return np.where(value > 0.0, np.log((1.0 - missing) * density), np.log(missing))

    def sample(self, rng: np.random.Generator, depth: np.ndarray, values: Numbers = None) -> np.ndarray:
        values = self.complete(values)
        model, missing = blurred_depth(depth, values), self.missing_rate(depth, values)
        result = model + noise_at(model, values) * rng.standard_normal(depth.shape)
        outliers = rng.random(depth.shape) < values["outlier"]
        result[outliers] = rng.uniform(values["near"], values["far"], size=int(outliers.sum()))
        if values["flying"] > 0.0:
            edge, *sides = near_edges(with_wall(depth, values["background"]), values["edge_step"])
            flies = edge & (rng.random(depth.shape) < values["flying"])
            nearest, farthest = (side[flies] for side in sides)
            one = np.where(rng.random(len(nearest)) < 0.5, nearest, farthest)
            one += noise_at(one, values) * rng.standard_normal(len(one))
            result[flies] = np.where(rng.random(len(one)) < 0.5, rng.uniform(nearest, farthest), one)
        return np.where((rng.random(depth.shape) < missing) | (result <= 0.0), np.nan, result)
