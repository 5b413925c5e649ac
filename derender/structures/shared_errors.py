"""How much several images of one scene tell together, where their errors are not independent.

A sensor's slow bias, and what real solids are off their ideal shapes, come again in each image from about the same
side. How much of it two images share is measured: the correlation r of their residuals at the same places of the
scene's surface. Of V images each of which shares r with each other the mean is as sure as that of V / (1 + (V - 1) r)
independent ones (the design effect of cluster samples: Kish, Survey Sampling, 1965). So image v counts with the
exponent 1 / (1 + sum over the others of r): a hundred images that share all their errors count as one, and those of
independent noise as a hundred.
"""

import numpy as np

from derender.render.blur import blur
from derender.structures.draws.refined import Refined, with_sensor_refitted
from derender.structures.draws.sensor import Sensor, model_depth

SAME_SURFACE = 0.01  # share of the depth within which a point seen in one image is the one seen in another
FEWEST = 50  # places that both see, fewer of which tell nothing
SURE = 3.0  # standard deviations of a correlation, 1 / sqrt(places), below which it is none
CLIPPED = 3.0  # standard deviations at which residuals are cut off: edges and outliers would outweigh all others


def with_shared_errors(rng: np.random.Generator, refined: Refined) -> Refined:
    """Return the Refined whose views count for as much as they tell beside the others, at its mode again."""
    views = refined.sensor.views
    if len(views) == 1 or any("effective_pixels" not in view.values for view in views):
        return refined
    shares = 1.0 / (1.0 + shared(refined).sum(axis=1))
    if np.all(shares == 1.0):
        return refined
    tempered = [view.changed(effective_pixels=share * min(view.values["effective_pixels"],
                                                          view.likelihood.counted_pixels(view.observed)))
                for view, share in zip(views, shares, strict=True)]  # fmt: skip
    sensor = tempered[0]._replace(others=tuple(tempered[1:]))
    return with_sensor_refitted(rng, refined._replace(sensor=sensor))


def shared(refined: Refined) -> np.ndarray:
    """Return (V, V) the correlation of the residuals of each two views of a Refined at the same places, 0 with itself.

    Those that chance alone may make are 0.
    """
    views = refined.sensor.views
    models = [model_depth(refined.chart, refined.values, view.camera, view.into) for view in views]
    residuals = [residual_of(view, model) for view, model in zip(views, models, strict=True)]
    found = np.zeros((len(views), len(views)))
    for a in range(len(views)):
        for b in range(a):
            found[a, b] = found[b, a] = correlation(
                views[a], views[b], models[a], models[b], residuals[a], residuals[b]
            )
    return found


def residual_of(view: Sensor, model: np.ndarray) -> np.ndarray:
    """Return (H, W) the residuals of a view in standard deviations of its noise, cut off, NaN where it says nothing."""
    smooth = blur(model, view.values["blur"])
    noise = view.values["sigma"] + view.values.get("sigma_growth", 0.0) * smooth**2
    return np.clip((view.returned - smooth) / noise, -CLIPPED, CLIPPED)


def correlation(
    one: Sensor,
    other: Sensor,
    model: np.ndarray,
    other_model: np.ndarray,
    residual: np.ndarray,
    other_residual: np.ndarray,
) -> float:
    """Return the correlation of two views' residuals (H, W) at places that both see, given their models' depths."""
    camera, to = one.camera, other.camera
    rows, columns = np.nonzero(np.isfinite(residual))
    z = model[rows, columns]
    points = np.stack([(columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z, np.ones_like(z)])
    x, y, depth, _ = other.into @ np.linalg.inv(one.into) @ points
    ahead = depth > 0.0
    deep = np.where(ahead, depth, 1.0)
    u, v = np.rint(x / deep * to.fx + to.cx).astype(int), np.rint(y / deep * to.fy + to.cy).astype(int)
    inside = ahead & (u >= 0) & (u < to.width) & (v >= 0) & (v < to.height)
    rows, columns, u, v, depth = rows[inside], columns[inside], u[inside], v[inside], depth[inside]
    same = (np.abs(other_model[v, u] - depth) < SAME_SURFACE * depth) & np.isfinite(other_residual[v, u])
    if same.sum() < FEWEST:
        return 0.0
    here, there = residual[rows[same], columns[same]], other_residual[v[same], u[same]]
    norm = np.sqrt(np.mean(here**2) * np.mean(there**2))
    found = float(np.mean(here * there) / norm) if norm > 0.0 else 0.0
    return min(found, 1.0) if found > SURE / np.sqrt(same.sum()) else 0.0
