"""What will happen: films of the engine from drawn states and materials, with the engine's errors at each impact."""

from collections.abc import Callable
from functools import partial
from itertools import product

import numpy as np

from derender.dynamics.engine import LEVER, Engine, Material, Scales, velocity_errors
from derender.dynamics.inference import Identified
from derender.dynamics.motion import Motion
from derender.dynamics.shooting import RESTS, Shooting
from derender.physics.mujoco_model import Diverged

# A body rests where it is slower than RESTS (turning: by its size) in so many intervals on end.
CALM = 3

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
    engine, seen = (Engine(motion.matter, motion.names, motion.step) for _ in range(2))
    shooting, mode = Shooting(motion, found.parameters, seen), found.modes[0]
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
