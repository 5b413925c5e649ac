"""The evidence of a fixed structure, the integral of prior times likelihood over its unknowns, about places walks met;
and whether one of its scenes explains the image as well as the likelihood lets expect.

Places are counted as tangents from a typical one (`space.py`). Lengths and angles have the plain measure there,
rotations Haar's of total mass one, whose density at a rotation vector of length t is (1 - cos t) / (4 pi^2 t^2), up to
t = pi.
"""

import math
from functools import partial

import numpy as np

from derender.posterior.compiled.backend import Backend
from derender.posterior.compiled.prior import moved
from derender.posterior.kernels.base import centre_of
from derender.posterior.space import Space
from derender.posterior.target import SceneTarget
from derender.render.likelihoods import likelihoods
from derender.render.raycast.depth import render_depth
from derender.render.raycast.evaluator import DepthEvaluator
from derender.sampling.evidence import Evidence, evidence

# Independent draws that an integral's points are to be worth: .07 nats of each, .1 of the odds of two structures.
ENOUGH, ROUNDS = 200.0, 12  # in at most so many rounds: of 9 unknowns 6 rounds left errors of .2 to .8 nats
DRAWN_IMAGES = 10  # of a scene, from which the spread of their log density is known to a quarter
SMALL_ANGLE = 1e-4  # radians: of less the measure is that of none, to 1e-9


def evidence_about(rng: np.random.Generator, space: Space, backend: Backend, places: np.ndarray) -> Evidence:
    """Return the Evidence of a structure whose posterior lies about places (n, P) that walks on it met."""
    centre = centre_of(space, places)
    draws = mode_by_mode(space.differences(places, centre), space.scales)
    return evidence(rng, partial(log_densities, space, backend, centre), draws, ENOUGH, ROUNDS)


def mode_by_mode(tangents: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return tangents (n, D) in order along the direction in which they lie farthest apart, in units of scales (D,).

    So those of one mode follow each other, as the pieces of a chain do about which an integral begins.
    """
    apart = tangents / scales
    apart = apart - apart.mean(axis=0)
    return tangents[np.argsort(apart @ np.linalg.svd(apart, full_matrices=False)[2][0], kind="stable")]


def log_densities(space: Space, backend: Backend, centre: np.ndarray, tangents: np.ndarray) -> np.ndarray:
    """Return the log densities (m,) of tangents (m, D): log prior, log likelihood and log measure; each place once."""
    found = np.full(len(tangents), -np.inf)
    for k, tangent in enumerate(tangents):
        measure = log_measure(space, tangent)
        if measure > -math.inf:
            found[k] = measure + sum(backend.evaluate(moved(space, centre, space.everything, tangent)))
    return found


def log_measure(space: Space, tangent: np.ndarray) -> float:
    """Return the log of the measure's density at a tangent (D,), -inf beyond half a turn: that place is met already."""
    total = 0.0
    for i, unknown in enumerate(space.unknowns):
        step = tangent[space.directions[i] : space.directions[i + 1]]
        if unknown.ways == 3:
            length = float(np.linalg.norm(step))
            if length > math.pi:
                return -math.inf
            bend = (1.0 - math.cos(length)) / length**2 if length > SMALL_ANGLE else 0.5
            total += math.log(bend / (4.0 * math.pi**2))
        elif unknown.period is not None and not -0.5 * unknown.period <= step[0] < 0.5 * unknown.period:
            return -math.inf
    return total


def short_of_noise(rng: np.random.Generator, target: SceneTarget, values: np.ndarray) -> float:
    """Return by how many standard deviations the image is less likely under values (P,) than images drawn of them.
    Where either has no return neither counts: how much of an image returned says nothing of the scene."""
    kind, camera = likelihoods[target.images.type], target.images.camera
    numbers = kind.complete({**target.images.values, **target.of_likelihood(values)})
    clean, _ = render_depth(target.graph(values).solids(), camera, background=numbers["background"])

    def densities(image: np.ndarray) -> np.ndarray:
        """Return the log density (H, W) of each pixel, NaN without a return."""
        evaluator = DepthEvaluator.of_depth(image, clean, kind.name, numbers)
        evaluator.set_values({})
        return np.where(np.isfinite(image) & (image > 0.0), evaluator.per_pixel(), np.nan)

    own = densities(target.images.observed)
    short = [np.nansum(densities(kind.sample(rng, clean, numbers)) - own) for _ in range(DRAWN_IMAGES)]
    spread = np.std(short, ddof=1)
    return float(np.mean(short) / spread) if spread > 0.0 else 0.0  # none: no pixel has a return
