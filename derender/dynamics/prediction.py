"""What will happen: films of the engine from drawn states and materials, with the engine's errors at each impact."""

import numpy as np

from derender.dynamics.engine import Engine, Material
from derender.dynamics.errors import LEVER, Scales, impulses, velocity_errors
from derender.dynamics.inference import Identified
from derender.dynamics.motion import Motion
from derender.dynamics.shooting import Shooting
from derender.physics.mujoco_model import Diverged

# A body rests where it is slower than this, m / s (turning: by its size), in so many intervals on end.
RESTS, CALM = 0.02, 3


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
