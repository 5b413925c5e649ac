"""What will happen: films of the engine from drawn states and materials, with the engine's errors at each impact.

`predict` goes on with the film that told the materials and the errors. `pool` puts together what several films of the
same bodies tell, and `predict_another` predicts another one of which only the first states are known.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np

from derender.dynamics.engine import LEVER, Engine, Material, Scales, velocity_errors
from derender.dynamics.inference import Identified
from derender.dynamics.motion import Motion
from derender.dynamics.parameters import Parameters
from derender.dynamics.shooting import RESTS, Shooting
from derender.physics.mujoco_model import Diverged

# A body rests where it is slower than RESTS (turning: by its size) in so many intervals on end.
CALM = 3
# A variance than which no film tells a number better.
LEAST_VARIANCE = 1e-8

Normal = Callable[[int | tuple[int, ...]], np.ndarray]


def come_to_rest(
    engine: Engine,
    sizes: np.ndarray,
    states: np.ndarray,
    material: Material,
    most: int,
    scales: Scales | None = None,
    normal: Normal | None = None,
) -> np.ndarray:
    """Return the states (N, 13) when all bodies rest, or after `most` intervals, from `states` (N, 13).

    With `scales` and `normal`, velocities are off after each interval by a normal error of what contacts gave.

    sizes : (N,) mean side of each body, metres. normal : draws standard normal numbers of a shape.
    """
    engine.tell(material)
    now, calm = np.asarray(states, float), 0
    for _ in range(most):
        after = engine.advance(now)
        speed = np.hypot(np.linalg.norm(after[:, 7:10], axis=1), np.linalg.norm(after[:, 10:], axis=1) * sizes)
        calm = calm + 1 if speed.max() < RESTS else 0
        if scales is not None and normal is not None:
            error = velocity_errors(engine.impulses(now, after, material.friction), scales)
            error = np.where(speed > RESTS, error, 0.0)
            after[:, 7:10] += error[:, None] * normal((len(after), 3))
            after[:, 10:] += (LEVER * error / sizes)[:, None] * normal((len(after), 3))
        now = after
        if calm == CALM:
            break
    return now


def predict(found: Identified, motion: Motion, rng: np.random.Generator, count: int, most: int) -> np.ndarray:
    """Return draws (K, N, 13) of the states in which bodies come to rest, K at most `count`.

    A draw's unknown states are normal about the mode given its material; the engine then goes on from the last frame
    of `motion`, from which `found` was identified. Of each two draws the second has the first one's errors with the
    other sign (antithetic variates), so that a few tell well where the middle is. Draws that diverge are left out.

    most : intervals after the last frame.
    """
    engine = Engine(motion.matter, motion.names, motion.step)
    shooting, mode = Shooting(motion, found.parameters, engine), found.modes[0]
    size, whole = shooting.size, mode.covariance
    gain = whole[:size, size:] @ np.linalg.inv(whole[size:, size:])
    given = whole[:size, :size] - gain @ whole[size:, :size]
    lower = np.linalg.cholesky(given + 1e-12 * np.eye(size))
    draws = []
    pairs = zip(*found.draws.resampled(rng, -(-count // 2)), rng.integers(2**63, size=-(-count // 2)), strict=True)
    for (coordinates, logarithms, seed), sign in product(pairs, (1.0, -1.0)):
        normal = partial(_signed_normal, np.random.default_rng(seed), sign)
        off = coordinates - mode.path.coordinates
        change = np.concatenate([gain @ off + lower @ normal(size), off])
        try:
            path = shooting.stepped(mode.path, change)
            material, scales = found.parameters.material(path.coordinates), Scales(*np.exp(logarithms))
            draws.append(come_to_rest(engine, shooting.sizes, path.states[-1], material, most, scales, normal))
        except Diverged:
            continue
    return np.array(draws[:count])


def _signed_normal(rng: np.random.Generator, sign: float, shape: int | tuple[int, ...]) -> np.ndarray:
    return sign * rng.standard_normal(shape)


def in_region(draws: np.ndarray, truth: np.ndarray, share: float = 0.9) -> bool:
    """Return whether `truth` (D,) lies in the ellipsoid about draws (K, D) that holds a share of them."""
    centre = np.median(draws, axis=0)
    inverse = np.linalg.inv(np.cov(draws.T) + 1e-8 * np.eye(draws.shape[1]))
    off = np.vstack([truth, draws]) - centre
    far = np.einsum("ki,ij,kj->k", off, inverse, off)
    return bool(far[0] <= np.quantile(far[1:], share))


class Lesson(NamedTuple):
    """What a film tells: mean, variance (P,) of the coordinates of `Parameters` and the scales' logarithms."""

    mean: np.ndarray
    variance: np.ndarray


class Pooled(NamedTuple):
    """What films tell of another one: numbers (P,) as a lesson's, each of a t distribution."""

    mean: np.ndarray  # (P,)
    variance: np.ndarray  # (P,), the squares of their scales
    freedom: int  # its degrees of freedom


def lesson(found: Identified) -> Lesson:
    """Return what a film was found to tell."""
    points, weights = np.hstack([found.draws.coordinates, found.draws.logarithms]), np.exp(found.draws.log_weights)
    mean = weights @ points
    return Lesson(mean, weights @ (points - mean) ** 2 + LEAST_VARIANCE)


def pool(lessons: Sequence[Lesson]) -> Pooled:
    """Return what at least two films tell of another one, whose numbers differ as theirs do.

    Source: random effects of DerSimonian and Laird 1986, each number on its own. How much a few films differ is poorly
    known: as Higgins, Thompson and Spiegelhalter 2009, the prediction is a t distribution. Its degrees of freedom, L -
    1 of L films, are exact where each film tells its number well.
    """
    means, variances = (np.array(part) for part in zip(*lessons, strict=True))
    weights = 1 / variances
    centre = np.sum(weights * means, axis=0) / np.sum(weights, axis=0)
    scatter = np.sum(weights * (means - centre) ** 2, axis=0)
    freedom = np.sum(weights, axis=0) - np.sum(weights**2, axis=0) / np.sum(weights, axis=0)
    spread = np.maximum((scatter - (len(means) - 1)) / freedom, 0.0)
    weights = 1 / (variances + spread)
    mean = np.sum(weights * means, axis=0) / np.sum(weights, axis=0)
    return Pooled(mean, 1 / np.sum(weights, axis=0) + spread, len(means) - 1)


def predict_another(
    told: Pooled,
    parameters: Parameters,
    engine: Engine,
    sizes: np.ndarray,
    states: np.ndarray,
    rng: np.random.Generator,
    count: int,
    most: int,
) -> np.ndarray:
    """Return draws (K, N, 13) of the states in which bodies come to rest from `states` (N, 13), K at most `count`.

    Each draw has a material and scales of its own, and the engine's errors of those scales after each interval: what
    an edge does at its first impact decides where the next one is, so that the spread grows with every impact. It is
    not learnt from ends that were seen: one of many films from drawn materials meets them by luck, and the scatter
    about it is too small (so, 90 % regions held .44 of real tosses).

    told : by other films (`pool`).
    sizes : (N,) mean side of each body, metres.
    most : intervals after `states`.
    """
    draws, size = [], parameters.size
    for _ in range(count):
        numbers = told.mean + np.sqrt(told.variance) * rng.standard_t(told.freedom, len(told.mean))
        material, scales = parameters.material(numbers[:size]), Scales(*np.exp(numbers[size:]))
        try:
            draws.append(come_to_rest(engine, sizes, states, material, most, scales, rng.standard_normal))
        except Diverged:
            continue
    return np.array(draws)
