"""A sensor's noise from frames of a bare table: the numbers of the likelihood `correlated` that explain them best."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.camera.windows import grown, shrunk
from derender.detection.floor import floor_depth
from derender.detection.floors import find_floor
from derender.detection.pyramid import noise_of
from derender.detection.rounding import least_step
from derender.detection.solids.beliefs import any_sensor, log_prior_of
from derender.document import FORMAT
from derender.errors import DerenderError
from derender.render.likelihoods.correlated import NEIGHBOURS, RATE, SHARE, SPIKE, Correlated, covariance, innovations
from derender.render.likelihoods.pixelwise import noise_at
from derender.render.raycast.evaluator import DepthEvaluator
from derender.scene.codec.yaml_tree import to_yaml

NOISE = Correlated()
LEAST_NOISE = 1e-6  # metres: what was rendered without noise scatters less
LEAST_PIXELS = 2000  # on the table, in each frame: fewer tell nothing of what neighbours share
MOST_PIXELS = 15_000  # of all frames from which the numbers are sought: 640 columns take seconds, not a minute
ROUNDS, AGAIN = 400, 8  # of the simplex, at most, and how often it is begun
GAINED = 1.0  # nats that it has to gain to be begun again
BETWEEN = 3  # pixels: gaps and bridges among those on the table that are less than twice as wide are closed, or cut
ACCURATE = 0.05  # nats, and a part of each number, to which it goes on
BEGIN = {"white": 0.05, "reach": 4.0, "reach_down": 2.0, "tail": 0.1}  # where the simplex begins, and a step
SHARES = ("white", "tail", "outlier", "shared", "alone")
BEFORE = 1e-3  # share of outliers where the simplex begins
# Of a number whose logarithm is taken, where it begins; less growth makes no difference, and a search stays there.
LEAST, LEAST_GROWTH = 1e-5, 3e-4
KNOWN, DRAWS = 0.3, 20.0  # spread of the logarithm, and draws that a share's beta density is worth, in the next frames
LAGS = (1, 2, 4, 8)  # pixels apart at which a field of noise has to correlate as frames do
NEVER_LESS = 6.5  # such spreads above the least that a number may be: what is believed of it does not go below
NORMAL_99 = 2.5758  # standard deviations that a normal number exceeds once in a hundred


class Fit(NamedTuple):
    """values : numbers of the likelihood `correlated`; drawn : of a field of noise that scatters as frames do. pixels :
    looked at. correlation : of neighbours as they come, and the greatest of those when whitened; beyond : 99 % quantile
    of whitened residuals, times the normal's."""

    values: dict[str, float]
    drawn: dict[str, float]
    pixels: int
    correlation: tuple[float, float]
    beyond: float


def residuals(depth: np.ndarray, camera: Camera, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return (residual (H, W) metres, NaN off the table; the table's depth (H, W)) of a frame of a bare table.

    Depths that were rounded lie anywhere within a step, as probably here as there (dithered: Schuchman, IEEE
    Transactions on Communication Technology, 1964): of such as repeat themselves no step is too small to be likely.

    name : of the frame, for messages.
    """
    floor = find_floor(depth, camera)
    plane = floor_depth(floor.pose, camera)
    if floor.inliers.sum() < LEAST_PIXELS:
        what = f"{int(floor.inliers.sum())} pixels lie on a plane: fewer than {LEAST_PIXELS}"
        raise DerenderError(what, name, "give frames that show a bare table and little else")
    seen = np.isfinite(depth) & (depth > 0)
    residual = np.where(whole_patches(floor.inliers) & seen, depth - plane, np.nan)
    if np.nanstd(residual) < LEAST_NOISE:
        what = f"the table shows no noise ({1e6 * np.nanstd(residual):.2g} micrometres)"
        raise DerenderError(what, name, "give frames of a real sensor, as it writes them")
    within = np.random.default_rng(0).random(depth.shape) - 0.5  # of a step; one frame has one residual
    return residual + least_step(np.unique(depth[seen])) * within, np.where(np.isfinite(plane), plane, 0.0)


def whole_patches(inliers: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: patches of pixels that lie on a plane (H, W) and the few others among them.

    What is chosen by its own residual has lost those that a fit has to see: outliers, tails, drifts.
    """
    closed = shrunk(grown(inliers, BETWEEN), BETWEEN)
    return grown(shrunk(closed, BETWEEN), BETWEEN)


def fit_sensor(
    pairs: list[tuple[np.ndarray, np.ndarray]],
    progress: Callable[[float], None] = lambda done: None,
    also: tuple[str, ...] = (),
) -> Fit:
    """Return the Fit of (residual, depth) pairs of frames by one sensor: its most probable numbers under what is
    believed of any sensor. Noise alone is not how residuals scatter: pixels that go on drift away from the surface.

    progress : called with the fraction done, at the least. also : names of further numbers that are sought.
    """
    depths = np.concatenate([depth.ravel() for _, depth in pairs])
    sigma, growth = noise_of(np.concatenate([residual.ravel() for residual, _ in pairs]), depths)
    some = [middle_columns(*pair, MOST_PIXELS / len(pairs)) for pair in pairs]
    steps = [innovations(depth + residual, NOISE.complete(BEGIN)).ravel() for residual, depth in pairs]
    step, step_growth = noise_of(np.concatenate(steps), depths)
    begin = {**BEGIN, "step": step, "step_growth": step_growth}
    values = {"sigma": sigma, "sigma_growth": growth, **begin, "outlier": BEFORE}
    sought, believed = (*values, *also), partial(log_prior_of, any_sensor())
    values = NOISE.complete(values)
    tables = [DepthEvaluator.of_depth(depth + residual, depth, "correlated", values) for residual, depth in some]
    gained, height, again = np.inf, -np.inf, 0
    while gained > GAINED and again < AGAIN:
        values = likeliest(tables, values, sought, ROUNDS, believed)
        found = sum(table.set_values(values) or 0.0 for table in tables) + believed(values)
        gained, height, again = found - height, found, again + 1
        progress(again / AGAIN)
    white = [NOISE.whitened(depth + residual, depth, values) for residual, depth in pairs]
    every = np.abs(np.concatenate([image[np.isfinite(image)] for image in white]))
    return Fit({name: values[name] for name in ("sigma", "sigma_growth", *begin, *also)}, field_of(pairs), every.size,
               (correlation([residual for residual, _ in pairs], 0, 1),
                max((correlation(white, *neighbour) for neighbour in NEIGHBOURS), key=abs)),
               float(np.quantile(every, 0.99)) / NORMAL_99)  # fmt: skip


def field_of(pairs: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, float]:
    """Return the numbers of a `Correlated.field` that scatters and correlates as frames do; pairs : see fit_sensor."""
    from scipy.optimize import least_squares

    residual, depth = (np.concatenate([image.ravel() for image in images]) for images in zip(*pairs, strict=True))
    noise = dict(zip(("sigma", "sigma_growth"), noise_of(residual, depth), strict=True))
    within = [
        np.where(np.abs(off) < SPIKE * noise_at(at, noise), off / noise_at(at, noise), np.nan) for off, at in pairs
    ]
    rows, columns = np.array([(lag, 0) for lag in LAGS] + [(0, lag) for lag in LAGS]).T
    told = np.array([correlation(within, *way) for way in zip(rows, columns, strict=True)])

    def numbers(free: np.ndarray) -> dict[str, float]:
        return {"white": free[0], "reach": math.exp(free[1]), "reach_down": math.exp(free[2])}

    found = least_squares(lambda free: covariance(rows, columns, numbers(free)) - told, [0.5, 0.0, 0.0],
                          bounds=([SHARE[0], -3.0, -3.0], [SHARE[1], 5.0, 5.0])).x  # fmt: skip
    seen = np.isfinite(residual)
    kept, depths = sum(np.isfinite(image).sum() for image in within), (depth + residual)[seen]
    outlier = max(1.0 - kept / seen.sum(), RATE[0])
    return {**noise, **numbers(found), "outlier": outlier, "near": float(depths.min()), "far": float(depths.max())}


def middle_columns(residual: np.ndarray, depth: np.ndarray, pixels: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what a residual (H, W), NaN off the table, and the table's depth are in columns that show so many pixels
    of it: a table reaches from near to far along them."""
    seen = np.cumsum(np.isfinite(residual).sum(axis=0))
    middle = np.abs(seen - 0.5 * seen[-1]) <= 0.5 * pixels
    return residual[:, middle], depth[:, middle]


def likeliest(
    images: list[DepthEvaluator],
    begin: dict[str, float],
    names: tuple[str, ...],
    rounds: int,
    believed: Callable[[dict[str, float]], float] = lambda values: 0.0,
) -> dict[str, float]:
    """Return the numbers of the likelihood under which images of given clean depth are likeliest, by a simplex search.

    begin : all numbers, where it begins. names : of those that are sought. rounds : evaluations at most. believed :
    their log prior.
    """
    from scipy.optimize import minimize

    limits = np.array([(p.lower, p.upper) for name in names for p in NOISE.parameters if p.name == name])
    is_share = np.array([name in SHARES for name in names])

    def numbers(free: np.ndarray) -> dict[str, float]:
        free = np.clip(free, -30.0, 10.0)
        found = np.clip(np.where(is_share, 1.0 / (1.0 + np.exp(-free)), np.exp(free)), *limits.T)
        return {**begin, **dict(zip(names, map(float, found), strict=True))}

    def loss(free: np.ndarray) -> float:
        values = numbers(free)
        return -believed(values) - sum(image.set_values(values) or 0.0 for image in images)

    first = np.maximum([begin[name] for name in names], [LEAST_GROWTH if "growth" in name else LEAST for name in names])
    free = np.where(is_share, np.log(first / np.where(is_share, 1.0 - first, 1.0)), np.log(first))
    settings = {"maxfev": rounds, "fatol": ACCURATE, "xatol": ACCURATE, "adaptive": True}
    return numbers(minimize(loss, free, method="Nelder-Mead", options=settings).x)


def correlation(images: list[np.ndarray], up: int, left: int) -> float:
    """Return the correlation of pixels of images (H, W), NaN where missing, with those some rows up, columns left."""
    wide = max(up, abs(left))
    there = np.concatenate([np.pad(image, wide, constant_values=np.nan)[wide - up :, wide - left :][: image.shape[0],
                            : image.shape[1]].ravel() for image in images])  # fmt: skip
    here = np.concatenate([image.ravel() for image in images])
    both = np.isfinite(here) & np.isfinite(there)
    return float(np.corrcoef(here[both], there[both])[0, 1]) if both.sum() > 2 else math.nan


def written(*values: float) -> list[float]:
    """Return numbers to the four digits that they are known to at most."""
    return [float(f"{value:.4g}") for value in values]


def sensor_text(fit: Fit, camera: Camera, frames: int) -> str:
    """Return the YAML of a sensor as a prior over its numbers, about those of the fit, seen on a bare table."""
    believed: dict[str, Any] = {}
    for key, value in fit.values.items():
        if key == "white":  # as well known as a reach is; what a table shows of tails says little of other scenes
            value = max(value, SHARE[0] * math.exp(NEVER_LESS * KNOWN))
            worth = 1.0 / (KNOWN**2 * min(value, 1.0 - value))  # draws that tell the lesser side so well
            believed[key] = {"beta": [*written(worth * value, worth * (1.0 - value)), *SHARE]}
        elif key in SHARES:
            believed[key] = {"beta": [*written(max(DRAWS * value, 0.5), max(DRAWS * (1.0 - value), 0.5)), *SHARE]}
        else:
            least = NOISE.known[key].lower * math.exp(NEVER_LESS * KNOWN)
            believed[key] = {"log-normal": [*written(max(value, least)), KNOWN]}
    drawn = dict(zip(fit.drawn, written(*fit.drawn.values()), strict=True))
    data = {
        "derender": FORMAT,
        "camera": {key: value for key, value in camera.to_dict().items() if key != "depth_scale"},
        "root": {"distance": {"uniform": [0.5, 1.0]}, "elevation": {"uniform": ["30 deg", "60 deg"]}},
        "objects": {"table": {"shape": "plane", "contact": {"type": "6dof"}}},
        "likelihood": {"type": "correlated", **believed, "drawn": drawn},
    }
    seen = f"{frames} frame{'s' if frames > 1 else ''} of a bare table: {fit.pixels} pixels"
    return f"# The noise of a depth camera, from {seen}.\n{to_yaml(data, {'objects': 1, 'likelihood': 1})}"
