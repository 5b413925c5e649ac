"""What the image says about the sensor: noise, its growth with depth, blur, outliers, given a first explanation."""

from typing import Any, NamedTuple

import numpy as np

from derender.inference.structure.chart import camera_poses, place_rows
from derender.inference.structure.image import ROW
from derender.model.solids import PLANE, Solids
from derender.vision.blur import blur
from derender.vision.camera import Camera
from derender.vision.likelihoods import likelihoods
from derender.vision.raycast.depth import render_depth

BLURS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5)  # pixels, tried first
LEAST_SIGMA = 1e-4
# Outliers: of a first look, when edges may still be pixels away, and of what is asked of the final one.
FIRST_OUTLIERS, RARE_OUTLIERS = 0.02, 1e-4
BACKGROUND = 10.0
FAR_AWAY = 2.5  # times the median depth: pixels beyond it are left out


class Sensor(NamedTuple):
    """A likelihood bound to an image.

    Attributes
    ----------
    camera : Camera; observed : (H, W) metres, NaN where nothing returned or the pixel is left out.
    likelihood : of vision.likelihoods; values : all its numbers.
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


def noise_of(residual, model):
    """Return (sigma, growth) of noise sigma + growth depth^2 in metres, from medians over a near and a far half.

    A constant one where the difference is not clear.
    """
    seen = np.isfinite(residual)
    r, z = np.abs(residual[seen]), model[seen]
    near = z <= np.median(z)
    spreads = [1.4826 * np.median(r[half]) + 1e-9 for half in (near, ~near)]
    squares = [np.mean(z[half] ** 2) for half in (near, ~near)]
    if spreads[1] < 1.08 * spreads[0]:
        return max(1.4826 * float(np.median(r)), LEAST_SIGMA), 0.0
    growth = (spreads[1] - spreads[0]) / (squares[1] - squares[0])
    sigma = spreads[0] - growth * squares[0]
    if sigma < LEAST_SIGMA:
        sigma, growth = LEAST_SIGMA, (spreads[1] - LEAST_SIGMA) / squares[1]
    return float(sigma), float(growth)


def robust_values(sigma, growth, blurred, outliers):
    """Return the numbers of a robust likelihood in which missing pixels say nothing."""
    return {"sigma": sigma, "sigma_growth": growth, "blur": blurred, "outlier": outliers, "missing": 0.02,
            "missing_edge": 0.02, "background": BACKGROUND}  # fmt: skip


def first_sensor(camera, observed, chart, values):
    """Return the robust Sensor that explains the image best given a first state."""
    observed = np.where(observed > FAR_AWAY * np.nanmedian(observed), np.nan, observed)
    sensor = Sensor(camera, observed, likelihoods["robust"], {})
    return refit(sensor, chart, values, BLURS, FIRST_OUTLIERS)


def refit(sensor, chart, values, blurs, outliers):
    """Return the robust sensor with the noise and the best of the blurs given a state."""
    clean = model_depth(chart, values, sensor.camera)
    best = None
    for pixels in blurs:
        density, trial = robust_fit(sensor, clean, pixels, outliers)
        if best is None or density > best[0]:
            best = density, trial
    return best[1]


def robust_fit(sensor, clean, pixels, outliers):
    """Return (log density, Sensor) with a blur of so many pixels, the noise fitted."""
    model = blur(clean, pixels)
    sigma, growth = noise_of(sensor.observed - model, model)
    trial = sensor.changed("robust", **robust_values(sigma, growth, pixels, outliers))
    return trial.likelihood.log_density(trial.observed, clean, trial.values), trial


def final_sensor(sensor, chart, values):
    """Return the sensor refitted given a good state: the blur to a hundredth of a pixel; gaussian where it suffices."""
    clean = model_depth(chart, values, sensor.camera)
    centre = sensor.values["blur"]
    outliers = RARE_OUTLIERS

    def score(pixels):
        return robust_fit(sensor, clean, pixels, outliers)

    best = max((score(b) for b in {0.0, *np.clip(centre + np.array([-0.2, -0.1, 0.0, 0.1, 0.2]), 0.0, 3.0)}),
               key=lambda pair: pair[0])  # fmt: skip
    for step in (0.05, 0.025, 0.0125):
        at = best[1].values["blur"]
        if at > 0.0:
            trials = [score(max(at + way * step, 0.0)) for way in (-1, 1)]
            best = max([best, *trials], key=lambda pair: pair[0])
    tried = [best]
    for rate in (1e-3, 1e-2, 0.05):
        tried.append(robust_fit(sensor, clean, best[1].values["blur"], rate))
    residual = sensor.observed - blur(clean, best[1].values["blur"])
    rms = max(float(np.sqrt(np.nanmean(residual**2))), LEAST_SIGMA)
    plain = sensor.changed("gaussian", sigma=rms, blur=best[1].values["blur"], background=BACKGROUND)
    # the robust density has a term for each pixel's being there at all
    bonus = -float(np.isnan(sensor.observed).sum()) * np.log(0.02) - float(
        np.isfinite(sensor.observed).sum()) * np.log(0.98)
    chosen = max(tried, key=lambda pair: pair[0])
    density = plain.likelihood.log_density(plain.observed, clean, plain.values)
    return plain if density > chosen[0] + bonus else chosen[1]
