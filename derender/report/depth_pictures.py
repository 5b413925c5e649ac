"""The pictures of a report: what was seen, what explains it, what is left, and what the posterior predicts."""

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np

from derender.camera.intrinsics import Camera
from derender.report import pictures
from derender.report.contents import Report
from derender.report.marks import marks_svg, scale_bar
from derender.results.regions import Region
from derender.scene import solids as kinds

# A residual picture's scale: what holds all but 5 % of the residuals, yet no less than 2 mm and no more than 5 cm.
RESIDUAL_SCALE = (0.002, 0.05)
PREDICTED = 320  # columns of the pictures of the posterior predictive, at most
SURPRISE = 4.0  # standard deviations at the ends of that picture's scale


def depth_pictures(report: Report) -> str:
    """Return the pictures of a report's image and of what explains it, as HTML; none without a camera."""
    if report.camera is None:
        return ""
    from derender.render.raycast.depth import render_depth

    clean, label = render_depth(report.solids, report.camera)
    explained = as_compared(clean, report.likelihood)
    objects = [(name, label == index) for index, name in enumerate(report.solid_names)
               if report.solids.kind[index] != kinds.PLANE]  # fmt: skip
    near = np.isin(label, np.flatnonzero(report.solids.kind != kinds.PLANE))
    if report.observed is None:
        low, high = pictures.depth_limits(explained, near)
        still = pictures.png_uri(pictures.shade(report.solids, report.camera, report.solid_names))
        marks = marks_svg(report.camera.shape, objects)
        shown = [picture("explained depth", explained, low, high, "m", pictures.DEPTH_ANCHORS, marks),
                 f'<figure><div class="layers"><img src="{still}" alt="the scene">{marks}</div></figure>']  # fmt: skip
        return '<h2>Depth</h2><div class="pictures">' + "".join(shown) + "</div>"
    low, high = pictures.depth_limits(report.observed, near)
    regions: list[Region] = [region for doubt in report.doubts for region in doubt.regions]
    middle = report.observed[near & np.isfinite(report.observed)]
    middle = middle if middle.size else report.observed[np.isfinite(report.observed)]
    bar = scale_bar(report.camera, float(np.median(middle))) if middle.size else ""
    marks = marks_svg(report.camera.shape, objects, regions, bar)
    plain, doubtful = marks_svg(report.camera.shape, objects), marks_svg(report.camera.shape, objects, regions)
    residual = report.observed - explained
    known = np.abs(residual[np.isfinite(residual)])
    scale = float(np.clip(np.percentile(known, 95), *RESIDUAL_SCALE)) if known.size else RESIDUAL_SCALE[0]
    words = "residual: observed − explained"
    words += f" (median |r| {1000 * np.median(known):.1f} mm)" if known.size else ""
    ends = -1000 * scale, 1000 * scale
    shown = [
        picture("observed depth", report.observed, low, high, "m", pictures.DEPTH_ANCHORS, marks),
        picture("explained depth", explained, low, high, "m", pictures.DEPTH_ANCHORS, plain),
        picture(words, 1000 * residual, *ends, "mm", pictures.RESIDUAL_ANCHORS, doubtful),
    ]
    return '<h2>Depth</h2><div class="pictures">' + "".join(shown) + "</div>" + _predictive(report, report.observed)


def as_compared(depth: np.ndarray, likelihood: Mapping[str, Any], step: int = 1) -> np.ndarray:
    """Return the depth image that the likelihood compares with the observed one: background filled in, blurred.

    step : each so many pixels of a row and column are there.
    """
    from derender.render.blur import blur

    background, sigma = likelihood.get("background"), likelihood.get("blur")
    filled = depth if not isinstance(background, float) else np.fmin(depth, background)
    return blur(filled, sigma / step) if isinstance(sigma, float) and np.all(np.isfinite(filled)) else filled


def _predictive(report: Report, observed: np.ndarray) -> str:
    """Return pictures of the posterior predictive: how far its draws scatter, and how surprising the image is."""
    from derender.render.raycast.depth import render_depth

    camera = report.camera
    if len(report.draws) < 2 or camera is None or all(row["draws"].size == 1 for row in report.parameters):
        return ""
    step = max(1, -(-camera.width // PREDICTED))
    seen = observed[::step, ::step]
    small = Camera(camera.fx / step, camera.fy / step, camera.cx / step, camera.cy / step, seen.shape[1], seen.shape[0])
    drawn = np.array([as_compared(render_depth(each, small)[0], report.likelihood, step) for each in report.draws])
    mean, spread = drawn.mean(axis=0), drawn.std(axis=0, ddof=1)
    noise = report.likelihood.get("sigma", 0.0) + report.likelihood.get("sigma_growth", 0.0) * mean**2
    with np.errstate(invalid="ignore", divide="ignore"):
        surprise = (seen - mean) / np.hypot(spread, noise)
    widest = np.nanpercentile(spread, 90) if np.isfinite(spread).any() else 0.0
    widest = float(np.clip(widest, 5e-4, 0.05))
    words = f"surprise: (observed − predicted) / sd, of {len(report.draws)} draws and the noise"
    shown = [
        picture(
            "spread of the posterior's draws (sd)", 1000 * spread, 0.0, 1000 * widest, "mm", pictures.DEPTH_ANCHORS
        ),
        picture(words, surprise, -SURPRISE, SURPRISE, "sd", pictures.RESIDUAL_ANCHORS),
    ]
    return '<h2>What the posterior predicts</h2><div class="pictures">' + "".join(shown) + "</div>"


def picture(
    words: str, values: np.ndarray, low: float, high: float, unit: str, anchors: tuple[str, ...], marks: str = ""
) -> str:
    """Return a figure of values (H, W) with its scale, and marks over it."""
    ramp = ", ".join("#" + colour for colour in anchors)
    form = ".2f" if unit == "m" else "+.1f"
    return (
        f'<figure><div class="layers"><img src="{pictures.png_uri(pictures.paint(values, low, high, anchors))}" '
        f'alt="{escape(words)}">{marks}</div><figcaption><span>{escape(words)}</span><span>{low:{form}} '
        f'<span class="bar" style="background:linear-gradient(90deg, {ramp})"></span> {high:{form}} {unit}</span>'
        "</figcaption></figure>"
    )
