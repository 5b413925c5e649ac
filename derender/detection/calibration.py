"""A sensor's noise from frames of a bare table: the numbers of the likelihood `correlated` that explain them best."""

import math
from typing import Any, NamedTuple

import numpy as np

from derender.detection.floor import back_project, find_floor
from derender.errors import DerenderError
from derender.render.likelihoods.correlated import SHARE, offset_variances, tree_log_density, whitened

LEAST_PIXELS = 2000  # on the table, in each frame: fewer tell nothing of what neighbours share
ROUNDS, AGAIN = 200, 2  # of the simplex, at most, and how often it is begun
ACCURATE = 0.05  # nats, and a part of each number, to which it goes on
BEGIN = {"sigma": 0.001, "sigma_growth": 0.002, "white": 0.2, "reach": 8.0, "bias": 1.0}
KNOWN = 0.3  # spread of the logarithm with which the numbers of a few frames hold for the next


class Fit(NamedTuple):
    """values : numbers of the likelihood `correlated`. pixels : looked at. correlation : of neighbours as they come
    and when whitened; beyond : share of whitened differences beyond the normal's 99 % quantile."""

    values: dict[str, float]
    pixels: int
    correlation: tuple[float, float]
    beyond: float


def residuals(depth: np.ndarray, camera: Any, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return (residual (H, W) metres, NaN off the table; the table's depth (H, W)) of a frame of a bare table.

    name : of the frame, for messages.
    """
    floor = find_floor(depth, camera)
    normal = floor.pose[:3, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = floor.pose[:3, 3] @ normal / (back_project(np.ones_like(depth), camera) @ normal)
    if floor.inliers.sum() < LEAST_PIXELS:
        what = f"{int(floor.inliers.sum())} pixels lie on a plane: fewer than {LEAST_PIXELS}"
        raise DerenderError(what, name, "give frames that show a bare table and little else")
    return np.where(floor.inliers, depth - plane, np.nan), np.where(np.isfinite(plane), plane, 0.0)


def fit_sensor(pairs: list[tuple[np.ndarray, np.ndarray]]) -> Fit:
    """Return the Fit of (residual, depth) pairs of frames by one sensor: most likely numbers, by a simplex search."""
    from scipy.optimize import minimize

    def loss(free: np.ndarray) -> float:
        values = numbers(free)
        return -sum(log_density(residual, depth, values) for residual, depth in pairs)

    start = np.array([
        math.log(BEGIN["sigma"]), math.log(BEGIN["sigma_growth"]), math.log(BEGIN["white"] / (1.0 - BEGIN["white"])),
        math.log(BEGIN["reach"]), math.log(BEGIN["bias"]),
    ])  # fmt: skip
    for _ in range(AGAIN):
        settings = {"maxfev": ROUNDS, "fatol": ACCURATE, "xatol": ACCURATE, "adaptive": True}
        start = minimize(loss, start, method="Nelder-Mead", options=settings).x
    values = numbers(start)
    apart = np.concatenate(
        [np.ravel(level) for residual, depth in pairs for level in levels_of(residual, depth, values)]
    )
    apart = apart[np.isfinite(apart)]
    first = [next(iter(levels_of(residual, depth, values))) for residual, depth in pairs]
    return Fit(values, int(sum(np.isfinite(residual).sum() for residual, _ in pairs)),
               (neighbours([residual for residual, _ in pairs]), neighbours(first)),
               float(np.mean(np.abs(apart) > NORMAL_99)))  # fmt: skip


NORMAL_99 = 2.5758  # standard deviations that a normal number exceeds once in a hundred


def numbers(free: np.ndarray) -> dict[str, float]:
    """Return the likelihood's numbers of five free ones."""
    white = float(np.clip(1.0 / (1.0 + math.exp(-float(np.clip(free[2], -30.0, 30.0)))), *SHARE))
    sigma, growth, reach, bias = (math.exp(float(np.clip(free[k], -16.0, 4.0))) for k in (0, 1, 3, 4))
    return {"sigma": max(sigma, 1e-6), "sigma_growth": min(growth, 1.0), "white": white,
            "reach": float(np.clip(reach, 0.1, 1000.0)), "bias": bias}  # fmt: skip


def scaled_by(residual: np.ndarray, depth: np.ndarray, values: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    spread = values["sigma"] + values["sigma_growth"] * depth**2
    return residual / spread, spread


def log_density(residual: np.ndarray, depth: np.ndarray, values: dict[str, float]) -> float:
    """Return the log density of residuals (H, W), NaN where there is none, about a surface at `depth`."""
    scaled, spread = scaled_by(residual, depth, values)
    total, _ = tree_log_density(scaled, values["white"], offset_variances(scaled.shape, values))
    return total - float(np.log(spread[np.isfinite(residual)]).sum())


def levels_of(residual: np.ndarray, depth: np.ndarray, values: dict[str, float]) -> Any:
    """Return the iterator of whitened differences of a frame, level by level."""
    scaled, _ = scaled_by(residual, depth, values)
    return whitened(scaled, values["white"], offset_variances(scaled.shape, values))


def neighbours(images: list[np.ndarray]) -> float:
    """Return the correlation of neighbours along rows of images (H, W), NaN where missing; of one pixel in each block
    of two and the next block's, for what the blocks share is taken out of whitened ones."""
    pairs = [(image[:, 1:-1:2].ravel(), image[:, 2::2].ravel()) for image in images]
    left = np.concatenate([a[: min(len(a), len(b))] for a, b in pairs])
    right = np.concatenate([b[: min(len(a), len(b))] for a, b in pairs])
    both = np.isfinite(left) & np.isfinite(right)
    return float(np.corrcoef(left[both], right[both])[0, 1]) if both.sum() > 2 else math.nan


def sensor_text(fit: Fit, camera: Any, frames: int) -> str:
    """Return the YAML of a sensor as a prior over its numbers, about those of the fit, seen on a bare table."""
    held = {key: f"{{log-normal: [{value:.4g}, {KNOWN}]}}" for key, value in fit.values.items() if key != "white"}
    worth, own = 20.0, fit.values["white"]  # draws of a share that its beta density is worth
    white = f"{{beta: [{max(worth * own, 0.5):.3g}, {max(worth * (1.0 - own), 0.5):.3g}, {SHARE[0]}, {SHARE[1]}]}}"
    camera_line = ", ".join(f"{key}: {value}" for key, value in camera.to_dict().items() if key != "depth_scale")
    lines = [
        f"# The noise of a depth camera, from {frames} frame{'s' if frames > 1 else ''} of a bare table: "
        f"{fit.pixels} pixels.",
        "derender: 1",
        f"camera: {{{camera_line}}}",
        "root: {distance: {uniform: [0.5, 1.0]}, elevation: {uniform: [30 deg, 60 deg]}}",
        "objects:",
        "  table: {shape: plane, contact: {type: 6dof}}",
        "likelihood:",
        "  type: correlated",
        *(f"  {key}: {held[key] if key in held else white}" for key in fit.values),
    ]
    return "\n".join(lines) + "\n"
