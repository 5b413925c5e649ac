"""What the image says about the sensor: noise, its growth with depth, blur, outliers, given a first explanation."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.detection.calibration import likeliest
from derender.detection.pyramid import LEAST_SIGMA, MOST_SIGMA, noise_of, single_pixels, unmixed_by
from derender.detection.solids.beliefs import SHARED, log_prior_of
from derender.document import LikelihoodPrior
from derender.render.blur import blur
from derender.render.likelihoods import likelihoods
from derender.render.likelihoods.correlated import independent_share, innovations, shown_share
from derender.render.likelihoods.pixelwise import flying_density, near_edges, noise_at, surface_density
from derender.render.raycast.depth import render_depth
from derender.render.raycast.evaluator import DepthEvaluator
from derender.results.fit import median
from derender.scene.solids import PLANE, Solids
from derender.structures.draws.chart import Chart, placed

ROUNDS, NOISE_ROUNDS = 60, 120  # in which what neighbours share is sought, and noise and outliers
OF_NOISE = ("sigma", "sigma_growth", "outlier")
BLURS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5)  # pixels, tried first
# Outliers: of a first look, when edges may still be pixels away, and those that the final one may have.
FIRST_OUTLIERS, RATES = 0.02, (1e-4, 1e-3, 1e-2, 0.05)
LAST_STEPS = (0.05, 0.025, 0.0125)  # pixels by which the blur near the best one is improved at the end
STEPS, WALKED = (0.3, 0.1, 0.03), 4  # pixels by which a blur is improved, and how many such steps at most
APART, NODES = 0.02, 11  # pixels from a blur to the first that is tried beside it; blurs over which is summed
RULES_OUT = 15.0  # nats by which a blur explains less, solids held: where they give way the blur is more open
MOST_BLUR = 5.0  # pixels, as a likelihood allows them
TOLD_BY = 320  # columns, at least, by which the blur of a whole image is sought: 640 tell it no better
LEAST_MISSING, MOST_MISSING = 1e-4, 0.99
BACKGROUND = 10.0  # metres to the wall behind everything, where the image shows none
LOOKED_AT = 160  # columns, at least, from which an image's likelihood is fitted
NEAR, FAR = 0.1, 10.0  # metres, of outliers
FAR_AWAY = 2.5  # times the median depth: of pixels beyond it, only that nothing stands before that is believed
EDGE = 0.025  # of the median depth: neighbours whose depths bend by more lie at an edge, where pixels may fly
MOST_FLYING, FLYING_ROUNDS = 0.99, 8  # of the pixels at edges; of Dempster, Laird and Rubin's EM
FLYING_GAIN = 30.0  # nats by which some have to explain an image better than none: of 12 without any at most 21
NEARLY = 0.1  # share of a scene's depth by which noise may have it off, and hardly anything that it does not explain


class SensorFields(NamedTuple):
    """What a Sensor holds; a NamedTuple itself can cache no property."""

    camera: Camera
    observed: np.ndarray
    likelihood: Any  # of render.likelihoods
    values: dict[str, float]  # all its numbers
    prior: Any = None  # LikelihoodPrior, what is believed of those numbers; None: of each value as much
    into: np.ndarray = np.eye(4)
    others: tuple["Sensor", ...] = ()  # Sensors of the other views, each of one
    beside: np.ndarray | None = None


class Sensor(SensorFields):
    """A likelihood bound to an image, or to several of one scene that stands still: then their product.

    observed : (H, W) metres, NaN where nothing returned or the pixel is left out, below zero where it shows what is no
        part of the scene, see `Robust`.
    into : (4, 4) float64, the scene's axes (those of the first view's camera) to those of this camera.
    beside : see `Likelihood.beside`; None: not made yet. Of another `observed` there is none.
    """

    @property
    def returned(self) -> np.ndarray:
        """The image (H, W) in metres where it shows the scene, else NaN."""
        return shown(self.observed)

    @property
    def worth(self) -> float:
        """How many independent pixels one of the first view tells as much as: at most 1."""
        return independent_share(self.values) if self.likelihood.name == "correlated" else 1.0

    @property
    def shows(self) -> float:
        """How many independent pixels one of the first view is worth, as a sign that something is there: at most 1."""
        return shown_share(self.values) if self.likelihood.name == "correlated" else 1.0

    @property
    def views(self) -> "tuple[Sensor, ...]":
        """The Sensors of all views, each of one."""
        return (self._replace(others=()), *self.others)

    def each(self, change: Callable[..., Any]) -> "Sensor":
        """Return the sensor with every view as a function makes it from a Sensor of one."""
        first, *others = map(change, self.views)
        return first._replace(others=tuple(others))

    def changed(self, name: str | None = None, **values: Any) -> "Sensor":
        """Return the sensor with another likelihood or other numbers of the first view."""
        likelihood = self.likelihood if name is None else likelihoods[name]
        known = {p.name for p in likelihood.parameters}
        numbers = likelihood.complete({k: v for k, v in {**self.values, **values}.items() if k in known})
        same = likelihood is self.likelihood and all(numbers[k] == self.values.get(k) for k in likelihood.of_image)
        beside = self.beside if same and self.beside is not None else likelihood.beside(self.observed, numbers)
        return self._replace(likelihood=likelihood, values=numbers, beside=beside)

    def blurred(self, more: float) -> "Sensor":
        """Return the sensor with a blur that is wider by so many pixels, as far as likelihoods allow it."""
        return self.changed(blur=min(max(self.values["blur"] + more, 0.0), MOST_BLUR))

    def clean(self, chart: Chart, values: np.ndarray) -> np.ndarray:
        """Return the clean depth (H, W) of a chart's solids in this view, with its likelihood's wall behind."""
        return model_depth(chart, values, self.camera, self.into, self.values.get("background", BACKGROUND))

    def noise(self, clean: np.ndarray, believed: LikelihoodPrior | None = None) -> "Noise":
        """Return the Noise that the first view beside a clean depth (H, W) tells under its likelihood's type."""
        held = {"flying": self.values.get("flying", 0.0), **held_by(self.prior)}
        held["background"] = self.values.get("background", BACKGROUND)
        return Noise(self.observed, clean, held, believed, outliers=self.likelihood.name != "gaussian")

    @cached_property
    def log_density_beyond(self) -> float:
        """The log density of the first view's pixels that show no part of the scene, where it does not hide them."""
        beyond = self.observed < 0.0
        if not beyond.any():
            return 0.0
        nothing = np.full(beyond.shape, np.inf)
        return float(self.likelihood.per_pixel(self.observed, nothing, self.values)[beyond].sum())

    def log_prior(self, without: tuple[str, ...] = ()) -> float:
        """Return the log density of those of its numbers that are unknown; 0 for one that the prior does not know.
        without : names of those that do not count."""
        return sum(log_prior_of(view.prior, {k: v for k, v in view.values.items() if k not in without})
                   for view in self.views)  # fmt: skip

    def to_data(self) -> dict[str, float | str]:
        """Return the first view's likelihood and its finite numbers, as `likelihood:` in a scene file has them."""
        return {"type": self.likelihood.name, **{k: v for k, v in self.values.items() if np.isfinite(v)}}


def model_image(
    chart: Chart, values: np.ndarray, camera: Camera, into: np.ndarray | None = None, wall: float = BACKGROUND
) -> tuple[np.ndarray, np.ndarray]:
    """Return the clean depth (H, W) of a chart's solids, with the wall behind, and label (H, W): 1 + k for solid k.
    into : (4, 4), the scene's axes to this camera's; None: they are the same. wall : how far away that is."""
    _, poses, sizes = placed(chart, values)
    kinds = np.array([PLANE, *chart.flags[:, 0]], np.int32)
    poses = poses if into is None else into @ poses
    solids = Solids(kinds, poses, sizes, np.full(len(kinds), -1, np.int32), ())
    depth, label = render_depth(solids, camera, background=wall)
    return np.minimum(depth, wall), label


def model_depth(
    chart: Chart, values: np.ndarray, camera: Camera, into: np.ndarray | None = None, wall: float = BACKGROUND
) -> np.ndarray:
    """Return the clean depth (H, W) of a chart's solids, with the wall behind; into, wall : see `model_image`."""
    return model_image(chart, values, camera, into, wall)[0]


def too_far(observed: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: pixels so far behind most others that they only tell that nothing stands nearer."""
    return observed > FAR_AWAY * np.nanmedian(np.abs(observed))


def cut_off(observed: np.ndarray, scene: np.ndarray) -> np.ndarray:
    """Return an image (H, W) of which what is too far is below zero, as what is no part of the scene; what a scene (H,
    W) explains is as far as that, lest noise leave the nearer ones of a row of pixels at the limit."""
    depth = np.where(np.abs(observed - scene) < NEARLY * scene, scene, observed)
    limit = FAR_AWAY * np.nanmedian(np.abs(observed))
    return np.where(depth > limit, -limit, observed)


def shown(observed: np.ndarray) -> np.ndarray:
    """Return an image (H, W) where it shows the scene, NaN where it shows something else or nothing."""
    return np.where(observed > 0.0, observed, np.nan)


def held_by(prior: LikelihoodPrior | None) -> dict[str, float]:
    """Return {name: value} of a sensor's numbers that a prior gives as numbers: they are known, and not fitted."""
    return {} if prior is None else prior.fixed


def first_sensor(camera: Camera, observed: np.ndarray, chart: Chart, values: np.ndarray,
                 prior: LikelihoodPrior | None = None, into: np.ndarray | None = None,
                 wall: float | None = None) -> Sensor:  # fmt: skip
    """Return the robust Sensor of one view that explains it best given a first state. prior, into : see Sensor.
    wall : how far away what lies behind everything is seen, see `Observation`; None: it is not."""
    into = np.eye(4) if into is None else into
    held = behind_all(wall) | ({} if shares_noise(prior) else held_by(prior))
    clean = model_depth(chart, values, camera, into, held["background"])
    observed = cut_off(observed, clean)
    noise = Noise(observed, clean, {"flying": 0.0, **held})  # before edges are where they are all pixels there fly
    best = max((noise.fitted(blurred, (FIRST_OUTLIERS,)) for blurred in BLURS), key=itemgetter(0))
    sensor = Sensor(camera, observed, likelihoods["robust"], {}, prior, into).changed("robust", **best[2])
    if not shares_noise(prior):
        return sensor
    return under_shared_noise(sensor, clean, ROUNDS)


def behind_all(wall: float | None) -> dict[str, float]:
    """Return {"background": metres to the wall behind everything}; wall : see `first_sensor`."""
    return {"background": BACKGROUND if wall is None else wall}


def shares_noise(prior: LikelihoodPrior | None) -> bool:
    """Return whether what is believed of a sensor (LikelihoodPrior or None) is that neighbouring pixels share noise."""
    return prior is not None and prior.type == "correlated"


def under_shared_noise(sensor: Sensor, clean: np.ndarray, rounds: int | None) -> Any:
    """Return the Sensor of one view under `correlated`, with the numbers that explain a clean depth (H, W) best.

    What its prior gives as a number holds. What neighbours share is sought by a simplex search of so many `rounds`;
    with 0 surfaces go on otherwise by as much as they are seen to, and None leaves all that as it is.
    """
    held = held_by(sensor.prior)
    begin = {name: value.quantile(0.5) for name, value in sensor.prior.free.items()}
    begin = sensor._replace(values={**begin, **sensor.values, **held}).changed("correlated").values
    if rounds is not None:
        step, growth = noise_of(innovations(sensor.returned, begin), clean)
        begin = {**begin, "step": step, "step_growth": growth, **held}
    image = DepthEvaluator.of_depth(sensor.returned, clean, "correlated", begin)
    believed = partial(log_prior_of, sensor.prior)
    for names, most in ((SHARED, rounds), (OF_NOISE, NOISE_ROUNDS)):
        sought = tuple(name for name in names if name not in held)
        begin = likeliest([image], begin, sought, most, believed) if most and sought else begin

    def density(blurred):
        return image.set_values({**begin, "blur": blurred}) + believed({"blur": blurred})

    blurred = begin["blur"] if "blur" in held else better_blur(begin["blur"], density)
    return sensor.changed("correlated", **{**begin, "blur": blurred})


def better_blur(at: float, density: Callable[[float], float]) -> float:
    """Return the blur in pixels to which STEPS to either side of one lead, while they explain an image better.
    density : the image's, of a blur. Where a step to one side was better, on the other lies what was there before."""
    height = density(at)
    for step in STEPS:
        ways: tuple[float, ...] = (-step, step)
        for _ in range(WALKED):
            trials = {at + way: density(at + way) for way in ways if 0.0 <= at + way <= MOST_BLUR}
            best = max(trials, key=lambda blurred: trials[blurred], default=at)
            if not trials or trials[best] <= height:
                break
            height, at, ways = trials[best], best, (best - at,)
    return at


@dataclass(frozen=True)
class Noise:
    """What says which noise there is: an image beside the clean depth of a scene, and what is known of the sensor.

    observed : (H, W) metres, see Sensor. clean : (H, W) metres, with the wall behind. held : numbers that are known.
    believed : LikelihoodPrior of the others, which counts too. every : look at each `every`-th pixel of each `every`-th
    row. outliers : whether the likelihood is robust, else it is normal.
    """

    observed: np.ndarray
    clean: np.ndarray
    held: Mapping[str, float]
    believed: LikelihoodPrior | None = None
    every: int = 1
    outliers: bool = True

    def model(self, blurred: float) -> np.ndarray:
        """Return the depth of the pixels looked at under a blur of so many pixels."""
        return blur(self.clean, blurred)[:: self.every, :: self.every]

    @property
    def known(self) -> np.ndarray:
        """The image at the pixels looked at, NaN where it does not show the scene."""
        return shown(self.observed)[:: self.every, :: self.every]

    @cached_property
    def seen(self) -> np.ndarray:
        """Which of the pixels looked at show the scene."""
        return np.isfinite(self.known)

    @cached_property
    def edge_step(self) -> float:  # metres
        return float(np.clip(EDGE * median(self.clean.ravel()), 1e-4, 100.0))

    @cached_property
    def edges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Which of the pixels seen lie at an edge, (n,) bool; the nearest and the farthest depth beside those (e,)."""
        edge, *sides = (
            each[:: self.every, :: self.every][self.seen] for each in near_edges(self.clean, self.edge_step)
        )
        return edge, sides[0][edge], sides[1][edge]

    def flying(self, numbers: Mapping[str, float]) -> np.ndarray:
        """Return the densities (e,) of the pixels at edges if they fly, see `flying_density`."""
        edge, nearest, farthest = self.edges
        return flying_density(self.known[self.seen][edge], nearest, farthest, numbers)

    def share_flying(self, stays: np.ndarray, numbers: Mapping[str, float]) -> float:
        """Return the share of pixels at edges that fly, given densities (n,) of all if none does; few are none."""
        if "flying" in self.held or not self.edges[0].any():
            return self.held.get("flying", 0.0)
        flies, stays, share = self.flying(numbers), stays[self.edges[0]], 0.5
        for _ in range(FLYING_ROUNDS):
            share = min(float(np.mean(share * flies / (share * flies + (1.0 - share) * stays))), MOST_FLYING)
        return share if np.log(share * flies / stays + 1.0 - share).sum() > FLYING_GAIN else 0.0

    def fitted(self, blurred: float, rates: tuple[float, ...] = RATES[:1]) -> tuple[float, str, dict[str, float]]:
        """Return (log density, name, numbers) of the likelihood with a blur of so many pixels, the noise fitted.

        The density is that of the depths where something returned: pixels are lost at edges and elsewhere at one rate.
        rates : of outliers, the best of which is taken. What is held is so, whatever is asked.
        """
        blurred = float(self.held.get("blur", blurred))
        model = self.model(blurred)
        residual = self.known - model
        if not self.outliers:
            return self._normal(residual, blurred)
        sigma, growth = noise_of(residual[self.seen], model[self.seen])
        missing = float(np.clip(np.mean(np.isnan(self.observed)), LEAST_MISSING, MOST_MISSING))
        numbers = {"sigma": sigma, "sigma_growth": growth, "blur": blurred, "missing": missing,
                   "missing_edge": missing, "edge_step": self.edge_step,
                   "background": BACKGROUND}  # fmt: skip
        numbers |= {name: self.held[name] for name in numbers if name in self.held} | outlier_range(self.observed)
        surface = surface_density(residual[self.seen], noise_at(model[self.seen], numbers))
        found = []
        for outlier in (self.held["outlier"],) if "outlier" in self.held else rates:
            told = {**numbers, "outlier": outlier}
            stays = mixed_density(surface, told)
            told["flying"] = self.share_flying(stays, told)
            found.append((self.density(stays, told) + log_prior_of(self.believed, told), "robust", told))
        return max(found, key=itemgetter(0))

    def density(self, stays: np.ndarray, numbers: Mapping[str, float]) -> float:
        """Return the log density of the pixels seen, (n,) that if none flies, under a robust likelihood."""
        if (share := numbers["flying"]) > 0.0:
            stays, edge = stays.copy(), self.edges[0]
            stays[edge] = (1.0 - share) * stays[edge] + share * self.flying(numbers)
        return float(np.log(stays).sum())

    def _normal(self, residual: np.ndarray, blurred: float) -> tuple[float, str, dict[str, float]]:
        """Return what `fitted` does of a normal likelihood."""
        square = float(np.nanmean(residual**2)) if self.seen.any() else 0.0
        sigma = self.held.get("sigma", float(np.clip(np.sqrt(square), LEAST_SIGMA, MOST_SIGMA)))
        density = -int(self.seen.sum()) * (0.5 * square / sigma**2 + np.log(sigma) + 0.5 * np.log(2.0 * np.pi))
        numbers = {"sigma": sigma, "blur": blurred, "background": self.held.get("background", BACKGROUND)}
        return density + log_prior_of(self.believed, numbers), "gaussian", numbers

    def by_blur(self, numbers: Mapping[str, float]) -> Callable[[float], float]:
        """Return the log density as a function of the blur alone: a robust likelihood's other numbers stay as they are,
        for near blurs are compared so at a fifth of the work of a fit; a normal one's noise is fitted."""
        if not self.outliers:
            return lambda blurred: self.fitted(blurred)[0]
        told = self.known[self.seen]

        def density(blurred: float) -> float:
            model = self.model(blurred)[self.seen]
            own = log_prior_of(self.believed, {**numbers, "blur": blurred})
            stays = mixed_density(surface_density(told - model, noise_at(model, numbers)), numbers)
            return self.density(stays, numbers) + own

        return density

    def with_blur(
        self, blurs: Iterable[float], rates: tuple[float, ...], steps: tuple[float, ...]
    ) -> tuple[float, str, dict[str, float]]:
        """Return what `fitted` does with the blur near the best of `blurs`, improved by steps of so many pixels.
        rates : of outliers, the first while the blur is sought."""
        robust = replace(self, outliers=True)
        best = max((robust.fitted(blurred, rates[:1]) for blurred in blurs), key=itemgetter(0))
        at, density = best[2]["blur"], robust.by_blur(best[2])
        for step in () if "blur" in self.held else steps:
            if at > 0.0:
                at = max((at, max(at - step, 0.0), at + step), key=density)
        return self.fitted(at, rates)


def noise_told_by(
    observed: np.ndarray, clean: np.ndarray, prior: LikelihoodPrior | None, wall: float, every: int = 1, **held: float
) -> Noise:
    """Return the Noise of an image and a clean depth under a Sensor's prior: its numbers hold as others `held`, and
    noise that it says is gaussian is so where all the image shows is part of the scene. wall : behind the scene."""
    normal = prior is not None and prior.type == "gaussian" and not (observed < 0.0).any()
    return Noise(observed, clean, held | held_by(prior) | {"background": wall}, every=every, outliers=not normal)


def mixed_density(surface: np.ndarray, numbers: Mapping[str, float]) -> np.ndarray:
    """Return the densities (n,) of depths whose surface_density this is, outliers counted."""
    outlier = numbers["outlier"]
    return (1.0 - outlier) * surface + outlier / (numbers["far"] - numbers["near"])


def outlier_range(observed: np.ndarray) -> dict[str, float]:
    """Return `near` and `far` of a robust likelihood: the default ones, or wider where the image has such depths."""
    seen = np.abs(observed[np.isfinite(observed)])
    low, high = (seen.min(), seen.max()) if len(seen) else (NEAR, FAR)
    most = likelihoods["robust"].known["far"].upper
    return {"near": float(min(NEAR, 0.9 * low)), "far": float(max(FAR, min(1.1 * high, most)))}


def whole_sensor(
    sensor: Sensor,
    camera: Camera,
    whole: np.ndarray,
    chart: Chart,
    values: np.ndarray,
    blurs: tuple[float, ...] = BLURS,
) -> Sensor:
    """Return the Sensor of a whole image of which that of one view has single pixels, its numbers fitted.

    The pixels beside a jump tell the blur by how much of its other side each shows, which only the whole image says.
    whole : (H, W) metres, below zero where it shows what is no part of the scene. values : (D,) coordinates at which a
    chart's solids explain it. blurs : in pixels, about the best of which it is sought.
    """
    wall, every = sensor.values["background"], max(1, camera.width // TOLD_BY)
    scene = model_depth(chart, values, camera, sensor.into, wall)
    observed = cut_off(whole, scene)
    noise = noise_told_by(observed, scene, sensor.prior, wall, every, flying=sensor.values.get("flying", 0.0))
    _, name, told = noise.with_blur(blurs, RATES, LAST_STEPS)
    return sensor._replace(camera=camera, observed=observed, beside=None).changed(name, **told)


def without_blur(sensor: Sensor, whole: Sensor, depth: np.ndarray, chart: Chart, values: np.ndarray) -> Sensor:
    """Return the Sensor of one view whose pixels, single ones of a whole image, are as they were without its blur.
    whole : the `whole_sensor` given the scene at coordinates (D,). depth : (H, W) metres, what it shows, all of it."""
    scene, told = whole.clean(chart, values), whole.values
    single = single_pixels(
        unmixed_by(scene, depth, told["blur"], noise_at(scene, told)), whole.camera.width // sensor.camera.width
    )
    single = np.where(sensor.observed < 0.0, sensor.observed, single)
    prior = (LikelihoodPrior("robust") if sensor.prior is None else sensor.prior).with_values({"blur": 0.0})
    return sensor._replace(observed=single, prior=prior, beside=None).changed(blur=0.0)


def final_sensor(sensor: Sensor, chart: Chart, values: np.ndarray) -> Sensor:
    """Return the sensor refitted given a good state, the blur to a hundredth of a pixel."""

    def refitted(view):
        clean = view.clean(chart, values)
        if shares_noise(view.prior):
            return under_shared_noise(view, clean, None)
        about = np.clip(view.values["blur"] + np.array([-0.2, -0.1, 0.0, 0.1, 0.2]), 0.0, 3.0)
        noise = noise_told_by(view.observed, clean, view.prior, view.values["background"])
        _, name, numbers = noise.with_blur({0.0, *about}, RATES, LAST_STEPS)
        return view.changed(name, **numbers)

    return sensor.each(refitted)


def same_sensor_refitted(sensor: Sensor, chart: Chart, values: np.ndarray) -> Sensor:
    """Return the sensor with the numbers that explain a state best, each view's likelihood of the same type."""
    return sensor.each(lambda view: _same_refitted(view, view.clean(chart, values)))


def _same_refitted(sensor: Sensor, clean: np.ndarray) -> Sensor:
    """Return the Sensor of one view with the numbers that explain a clean depth (H, W) best."""
    if shares_noise(sensor.prior):
        return under_shared_noise(sensor, clean, None)
    noise = sensor.noise(clean, believed=sensor.prior)
    rate, at = sensor.values.get("outlier", RATES[0]), sensor.values["blur"]
    if "blur" not in noise.held:
        at = better_blur(at, noise.by_blur(noise.fitted(at, (rate,))[2]))
    _, name, numbers = noise.fitted(at, (rate, *RATES))
    return sensor.changed(name, **numbers)


def blurs_about(sensor: Sensor, clean: np.ndarray) -> np.ndarray:
    """Return (NODES,) blurs in equal steps over which a view of this clean depth (H, W) leaves the blur open.
    One that is known is the only one."""
    at, noise = sensor.values["blur"], sensor.noise(clean)
    if "blur" in noise.held:
        return np.array([at])
    if sensor.likelihood.name == "correlated":
        image = DepthEvaluator.of_depth(sensor.returned, clean, "correlated", sensor.values)
        density: Callable = lambda blurred: image.set_values({"blur": blurred})  # noqa: E731
    else:
        density = noise.by_blur(noise.fitted(at)[2])
    ends = []
    for way in (-1.0, 1.0):  # outwards, ever farther, to where the image rules a blur out
        away, held = APART, density(at)
        while 0.0 < at + way * away < MOST_BLUR and density(at + way * away) > held - RULES_OUT:
            away *= 1.5
        ends.append(min(max(at + way * away, 0.0), MOST_BLUR))
    return np.linspace(*ends, NODES)


def image_likelihood(
    camera: Camera, observed: np.ndarray, solids: Solids, prior: Any = None, wall: float | None = None
) -> tuple[str, dict[str, float]]:
    """Return (name, numbers) of the likelihood that a whole image suggests as it came, given a scene.
    observed : (H, W) metres, NaN where nothing returned. prior, wall : see `first_sensor`.
    """
    held = behind_all(wall) | held_by(prior)
    clean, _ = render_depth(solids, camera, background=held["background"])
    clean = np.minimum(clean, held["background"])
    every = max(1, camera.width // LOOKED_AT)
    if shares_noise(prior):
        found = Noise(observed, clean, {"flying": 0.0, **behind_all(wall)}).fitted(0.0, (FIRST_OUTLIERS,))[2]
        sensor = Sensor(camera, observed, likelihoods["robust"], {}, prior).changed("robust", **found)
        found = under_shared_noise(sensor, clean, 0)
        return found.likelihood.name, found.values
    noise = noise_told_by(observed, clean, prior, held["background"], every)
    _, name, numbers = noise.with_blur((*BLURS, 2.5, 4.0), (*RATES, 0.2, 0.4), (0.25, 0.1))
    return name, numbers
