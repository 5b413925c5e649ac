"""What the image says about the sensor: noise, its growth with depth, blur, outliers, given a first explanation."""

from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.detection.noise import LEAST_SIGMA, MOST_SIGMA, noise_of
from derender.detection.solids.image import ROW
from derender.render.blur import blur
from derender.render.likelihoods import likelihoods
from derender.render.raycast.depth import render_depth
from derender.scene.solids import PLANE, Solids
from derender.structures.draws.chart import camera_poses, place_rows

BLURS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5)  # pixels, tried first
# Outliers: of a first look, when edges may still be pixels away, and those that the final one may have.
FIRST_OUTLIERS, RATES = 0.02, (1e-4, 1e-3, 1e-2, 0.05)
LEAST_MISSING, MOST_MISSING = 1e-4, 0.99
BACKGROUND = 10.0
LOOKED_AT = 160  # columns, at least, from which an image's likelihood is fitted
NEAR, FAR = 0.1, 10.0  # metres, of outliers
FAR_AWAY = 2.5  # times the median depth: pixels beyond it are left out


class Sensor(NamedTuple):
    """A likelihood bound to an image.

    Attributes
    ----------
    camera : Camera; observed : (H, W) metres, NaN where nothing returned or the pixel is left out.
    likelihood : of render.likelihoods; values : all its numbers.
    """

    camera: Camera
    observed: np.ndarray
    likelihood: Any
    values: dict[str, float]

    def changed(self, name=None, **values):
        """Return the sensor with another likelihood or other numbers."""
        likelihood = self.likelihood if name is None else likelihoods[name]
        known = {p.name for p in likelihood.parameters}
        kept = {k: v for k, v in {**self.values, **values}.items() if k in known}
        return self._replace(likelihood=likelihood, values=likelihood.complete(kept))

    def to_data(self):
        """Return the likelihood's type and its finite numbers: what stands under `likelihood:` in a scene file."""
        return {"type": self.likelihood.name, **{k: v for k, v in self.values.items() if np.isfinite(v)}}


def model_image(chart, values, camera):
    """Return the clean depth (H, W) of a chart's solids, with the wall behind, and label (H, W): 1 + k for solid k."""
    rows = np.empty((len(chart.flags), ROW))
    poses, sizes = np.empty((len(rows) + 1, 4, 4)), np.empty((len(rows) + 1, 3))
    place_rows(chart, values, rows)
    camera_poses(chart, values, rows, poses, sizes)
    kinds = np.array([PLANE, *chart.flags[:, 0]], np.int32)
    solids = Solids(kinds, poses, sizes, np.full(len(kinds), -1, np.int32), ())
    depth, label = render_depth(solids, camera, background=BACKGROUND)
    return np.minimum(depth, BACKGROUND), label


def model_depth(chart, values, camera):
    """Return the clean depth (H, W) of a chart's solids, with the wall behind."""
    return model_image(chart, values, camera)[0]


def too_far(observed):
    """Return (H, W) bool: pixels so far behind most others that inference leaves them out."""
    return observed > FAR_AWAY * np.nanmedian(observed)


def first_sensor(camera, observed, chart, values):
    """Return the robust Sensor that explains the image best given a first state."""
    observed = np.where(too_far(observed), np.nan, observed)
    clean = model_depth(chart, values, camera)
    best = max((robust_fit(observed, clean, blurred, FIRST_OUTLIERS) for blurred in BLURS), key=density_of)
    return Sensor(camera, observed, likelihoods["robust"], {}).changed("robust", **best[2])


def density_of(fit):
    """Return the log density of a fit."""
    return fit[0]


def robust_fit(observed, clean, blurred, outliers, every=1):
    """Return (log density, name, numbers) of a robust likelihood with a blur of so many pixels, the noise fitted.

    The density is that of the depths where something returned; whether it did says nothing here: pixels are lost at
    edges and elsewhere at one rate, the image's own.
    every : look at each `every`-th pixel of each `every`-th row.
    """
    model = blur(clean, blurred)[::every, ::every]
    residual = observed[::every, ::every] - model
    sigma, growth = noise_of(residual, model)
    seen = np.isfinite(residual)
    missing = float(np.clip(np.mean(np.isnan(observed)), LEAST_MISSING, MOST_MISSING))
    numbers = {"sigma": sigma, "sigma_growth": growth, "blur": float(blurred), "outlier": outliers, "missing": missing,
               "missing_edge": missing, "background": BACKGROUND, **outlier_range(observed)}  # fmt: skip
    spread = sigma + growth * model[seen] ** 2
    surface = np.exp(-0.5 * (residual[seen] / spread) ** 2) / (spread * np.sqrt(2.0 * np.pi))
    density = np.log((1.0 - outliers) * surface + outliers / (numbers["far"] - numbers["near"])).sum()
    return float(density), "robust", numbers


def outlier_range(observed):
    """Return `near` and `far` of a robust likelihood: the default ones, or wider where the image has such depths."""
    seen = observed[np.isfinite(observed)]
    low, high = (seen.min(), seen.max()) if len(seen) else (NEAR, FAR)
    return {"near": float(min(NEAR, 0.9 * low)), "far": float(max(FAR, 1.1 * high))}


def gaussian_fit(observed, clean, blurred, every=1):
    """Return (log density, name, numbers) of a normal likelihood with a blur of so many pixels, the noise fitted."""
    residual = (observed - blur(clean, blurred))[::every, ::every]
    square = float(np.nanmean(residual**2)) if np.isfinite(residual).any() else 0.0
    sigma = float(np.clip(np.sqrt(square), LEAST_SIGMA, MOST_SIGMA))
    count = int(np.isfinite(residual).sum())
    density = -count * (0.5 * square / sigma**2 + np.log(sigma) + 0.5 * np.log(2.0 * np.pi))
    return density, "gaussian", {"sigma": sigma, "blur": float(blurred), "background": BACKGROUND}


def best_fit(observed, clean, blurs, rates, steps, every=1):
    """Return (log density, name, numbers): the blur near the best of `blurs`, gaussian where that suffices.

    rates : of outliers, the first while the blur is sought. steps : pixels by which the blur is then improved.
    """
    best = max((robust_fit(observed, clean, blurred, rates[0], every) for blurred in blurs), key=density_of)
    for step in steps:
        at = best[2]["blur"]
        if at > 0.0:
            trials = [robust_fit(observed, clean, max(at + way * step, 0.0), rates[0], every) for way in (-1, 1)]
            best = max([best, *trials], key=density_of)
    at = best[2]["blur"]
    robust = max([best, *(robust_fit(observed, clean, at, rate, every) for rate in rates[1:])], key=density_of)
    plain = gaussian_fit(observed, clean, at, every)
    return plain if density_of(plain) > density_of(robust) else robust


def final_sensor(sensor, chart, values):
    """Return the sensor refitted given a good state: the blur to a hundredth of a pixel; gaussian where it suffices."""
    clean = model_depth(chart, values, sensor.camera)
    about = np.clip(sensor.values["blur"] + np.array([-0.2, -0.1, 0.0, 0.1, 0.2]), 0.0, 3.0)
    _, name, numbers = best_fit(sensor.observed, clean, {0.0, *about}, RATES, (0.05, 0.025, 0.0125))
    return sensor.changed(name, **numbers)


def image_likelihood(camera, observed, solids, effective_pixels=np.inf):
    """Return (name, numbers) of the likelihood that a whole image suggests, given a scene.

    What inference looked at may be reduced, and cut where it is far away; this is of the image as it came.
    observed : (H, W) metres, NaN where nothing returned. effective_pixels : how many independent ones it is worth.
    """
    clean, _ = render_depth(solids, camera, background=BACKGROUND)
    every = max(1, camera.width // LOOKED_AT)
    numbers: dict[str, float]
    _, name, numbers = best_fit(observed, np.minimum(clean, BACKGROUND), (*BLURS, 2.5, 4.0), (*RATES, 0.2, 0.4),
                                (0.25, 0.1), every)  # fmt: skip
    return name, numbers if np.isinf(effective_pixels) else {**numbers, "effective_pixels": float(effective_pixels)}
