"""What will happen: films of the engine from drawn states and materials, with the engine's errors at each impact."""

import numpy as np

from derender.dynamics.engine import Engine, Material
from derender.dynamics.errors import LEVER, Scales, impulses, velocity_errors

# A body rests where it is slower than this, m / s (turning: by its size), in so many intervals on end.
RESTS, CALM = 0.02, 3


def come_to_rest(
    engine: Engine, sizes: np.ndarray, states: np.ndarray, material: Material, scales: Scales, rng, most: int
) -> np.ndarray:
    """Return the states (F, N, 13), F at most `most` + 1, from `states` (N, 13) until all bodies rest.

    After each interval the velocities are off by a normal error of what contacts gave, as `errors` says.

    Parameters
    ----------
    sizes : (N,) mean side of each body, metres.
    """
    engine.tell(material)
    film, calm = [np.asarray(states, float)], 0
    while len(film) <= most and calm < CALM:
        after = engine.advance(film[-1])
        speed = np.hypot(np.linalg.norm(after[:, 7:10], axis=1), np.linalg.norm(after[:, 10:], axis=1) * sizes)
        calm = calm + 1 if speed.max() < RESTS else 0
        error = velocity_errors(impulses(film[-1], after, engine.gravity, engine.interval), scales)
        error = np.where(speed > RESTS, error, 0.0)
        after[:, 7:10] += error[:, None] * rng.standard_normal((len(after), 3))
        after[:, 10:] += (LEVER * error / sizes)[:, None] * rng.standard_normal((len(after), 3))
        film.append(after)
    return np.array(film)


def in_region(draws: np.ndarray, truth: np.ndarray, share: float = 0.9) -> bool:
    """Return whether `truth` (D,) lies in the ellipse about draws (K, D) that holds a share of them."""
    centre = np.median(draws, axis=0)
    inverse = np.linalg.inv(np.cov(draws.T) + 1e-8 * np.eye(draws.shape[1]))
    far = np.einsum("ki,ij,kj->k", draws - centre, inverse, draws - centre)
    return bool((truth - centre) @ inverse @ (truth - centre) <= np.quantile(far, share))
