"""What will happen: films of the engine from drawn states and materials, with the engine's errors at each impact.

`predict` goes on with the film that told the materials. `pool` puts together what several films of one body tell, and
`Pooled.ends` predicts others of which only the first state is known: there the engine's own errors at impacts are not
enough, as bodies and grounds differ from throw to throw, so materials are weighed by how far the engine misses the ends
of the films that taught them, and that scatter is added.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from derender.dynamics.engine import Engine, Material
from derender.dynamics.errors import LEVER, Scales, impulses, velocity_errors
from derender.dynamics.inference import Identified
from derender.dynamics.motion import Motion
from derender.dynamics.parameters import CONTACT_TIMES
from derender.dynamics.shooting import Shooting
from derender.physics.mujoco_model import Diverged

# A body rests where it is slower than this, m / s (turning: by its size), in so many intervals on end.
RESTS, CALM = 0.02, 3
# Materials that are weighed where films are pooled, and a variance that no film can tell a number better than.
CANDIDATES, LEAST_VARIANCE = 120, 1e-8


def come_to_rest(
    engine: Engine,
    sizes: np.ndarray,
    states: np.ndarray,
    material: Material,
    most: int,
    scales: Scales | None = None,
    rng: np.random.Generator | None = None,
) -> np.ndarray:
    """Return the states (N, 13) when all bodies rest, or after `most` intervals, from `states` (N, 13).

    With `scales` and `rng`, velocities are off after each interval by a normal error of what contacts gave.

    Parameters
    ----------
    sizes : (N,) mean side of each body, metres.
    """
    engine.tell(material)
    now, calm = np.asarray(states, float), 0
    for _ in range(most):
        after = engine.advance(now)
        speed = np.hypot(np.linalg.norm(after[:, 7:10], axis=1), np.linalg.norm(after[:, 10:], axis=1) * sizes)
        calm = calm + 1 if speed.max() < RESTS else 0
        if scales is not None and rng is not None:
            error = velocity_errors(impulses(now, after, engine.gravity, engine.interval), scales)
            error = np.where(speed > RESTS, error, 0.0)
            after[:, 7:10] += error[:, None] * rng.standard_normal((len(after), 3))
            after[:, 10:] += (LEVER * error / sizes)[:, None] * rng.standard_normal((len(after), 3))
        now = after
        if calm == CALM:
            break
    return now


def predict(found: Identified, motion: Motion, rng: np.random.Generator, count: int, most: int) -> np.ndarray:
    """Return draws (K, N, 13) of the states in which bodies come to rest, K at most `count`.

    A draw's unknown states are normal about the mode given its material; the engine then goes on from the last frame
    of `motion`, from which `found` was identified. Draws that diverge are left out.

    Parameters
    ----------
    most : intervals after the last frame.
    """
    engine = Engine(motion.matter, motion.names, motion.step)
    shooting, mode = Shooting(motion, found.parameters, engine), found.modes[0]
    size, whole = shooting.size, mode.covariance
    gain = whole[:size, size:] @ np.linalg.inv(whole[size:, size:])
    given = whole[:size, :size] - gain @ whole[size:, :size]
    lower = np.linalg.cholesky(given + 1e-12 * np.eye(size))
    draws = []
    for coordinates, logarithms in zip(*found.draws.resampled(rng, count), strict=True):
        off = coordinates - mode.path.coordinates
        change = np.concatenate([gain @ off + lower @ rng.standard_normal(size), off])
        try:
            path = shooting.stepped(mode.path, change)
            material, scales = found.parameters.material(path.coordinates), Scales(*np.exp(logarithms))
            draws.append(come_to_rest(engine, shooting.sizes, path.states[-1], material, most, scales, rng))
        except Diverged:
            continue
    return np.array(draws)


def in_region(draws: np.ndarray, truth: np.ndarray, share: float = 0.9) -> bool:
    """Return whether `truth` (D,) lies in the ellipsoid about draws (K, D) that holds a share of them."""
    centre = np.median(draws, axis=0)
    inverse = np.linalg.inv(np.cov(draws.T) + 1e-8 * np.eye(draws.shape[1]))
    off = np.vstack([truth, draws]) - centre
    far = np.einsum("ki,ij,kj->k", off, inverse, off)
    return bool(far[0] <= np.quantile(far[1:], share))


class Lesson(NamedTuple):
    """What one film of a body tells.

    Attributes
    ----------
    mean, variance : (P,) of log friction, restitution, log contact time and the scales' logarithms.
    states : (T, 1, 13), an engine's interval apart.
    """

    mean: np.ndarray
    variance: np.ndarray
    states: np.ndarray


def lesson(found: Identified, states: np.ndarray) -> Lesson:
    """Return what a film with these states (T, 1, 13) was found to tell."""
    points, weights = np.hstack([found.draws.coordinates, found.draws.logarithms]), np.exp(found.draws.log_weights)
    mean = weights @ points
    return Lesson(mean, weights @ (points - mean) ** 2 + LEAST_VARIANCE, states)


def random_effects(means: np.ndarray, variances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (P,) of numbers that differ from film to film, and the variance of another film's.

    means, variances : (L, P), of at least two films. Source: DerSimonian and Laird 1986.
    """
    weights = 1 / variances
    centre = np.sum(weights * means, axis=0) / np.sum(weights, axis=0)
    scatter = np.sum(weights * (means - centre) ** 2, axis=0)
    freedom = np.sum(weights, axis=0) - np.sum(weights**2, axis=0) / np.sum(weights, axis=0)
    spread = np.maximum((scatter - (len(means) - 1)) / freedom, 0.0)
    weights = 1 / (variances + spread)
    return np.sum(weights * means, axis=0) / np.sum(weights, axis=0), 1 / np.sum(weights, axis=0) + spread


class Pooled(NamedTuple):
    """What several films of one body tell together, in a frame whose z axis points up.

    Attributes
    ----------
    engine : of that body. size : its mean side, metres. films : how many taught.
    mean : (P,) as a lesson's, before the materials were weighed.
    materials : K of them, drawn about that mean. missed : (K,) m^2 by which the engine misses the films' ends, in sum.
    weights : (K,), normalised.
    """

    engine: Engine
    size: float
    films: int
    mean: np.ndarray
    materials: list[Material]
    missed: np.ndarray
    weights: np.ndarray

    def ends(self, state: np.ndarray, rng: np.random.Generator, count: int, most: int) -> np.ndarray:
        """Return draws (count, 2) of where the body comes to rest from a state (1, 13), within `most` intervals.

        Given a material, its scatter has the posterior of a normal error's in 2 L coordinates under a uniform prior on
        its logarithm.
        """
        draws = np.empty((count, 2))
        for row, chosen in enumerate(rng.choice(len(self.weights), count, p=self.weights)):
            scatter = np.sqrt(self.missed[chosen] / rng.chisquare(2 * self.films))
            end = come_to_rest(self.engine, np.array([self.size]), state, self.materials[chosen], most)
            draws[row] = end[0, :2] + scatter * rng.standard_normal(2)
        return draws


def pool(lessons: Sequence[Lesson], engine: Engine, size: float, rng: np.random.Generator) -> Pooled:
    """Return what films of one body tell together; at least two. See `Pooled`."""
    mean, variance = random_effects(*(np.array(part) for part in list(zip(*lessons, strict=True))[:2]))
    values = mean + np.sqrt(variance) * rng.standard_normal((CANDIDATES, len(mean)))
    times = np.clip(np.exp(values[:, 2]), *CONTACT_TIMES)
    materials = [
        Material(float(np.exp(v[0])), float(np.clip(v[1], 0.0, 0.95)), engine.masses, float(time))
        for v, time in zip(values, times, strict=True)
    ]
    missed = np.zeros(len(materials))
    for k, material in enumerate(materials):
        engine.tell(material)
        for _, _, states in lessons:
            missed[k] += np.sum((engine.roll(states[0], len(states))[-1, 0, :2] - states[-1, 0, :2]) ** 2)
    weights = (missed.min() / missed) ** len(lessons)  # the scatter integrated out
    return Pooled(engine, size, len(lessons), mean, materials, missed, weights / weights.sum())
