"""Where bodies are over time."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

# A body has moved when its centre is displaced by more than a tenth of its mean extent (the side of the cube of its
# volume), or it has turned by more than 10 degrees. Among 200 towers of ten blocks the greatest creep of one that
# stands is .02 of a mean extent and the least movement of one that does not is 1.0.
DISPLACEMENT_TOLERANCE = 0.1
ROTATION_TOLERANCE = np.deg2rad(10.0)


class Trajectory(NamedTuple):
    """Poses of bodies over time.

    Attributes
    ----------
    names : of the bodies.
    sizes : (N, 3) float64, full extents in metres.
    times : (T,) float64, seconds, from 0.
    poses : (T, N, 4, 4) float64, body to the frame of the scene.
    resting : whether everything was at rest at the end.
    """

    names: tuple[str, ...]
    sizes: np.ndarray
    times: np.ndarray
    poses: np.ndarray
    resting: bool = False

    def displacement(self) -> dict[str, float]:
        """Return how far each body's centre ended from where it began, metres."""
        return self._by_name(self._moved()[-1])

    def rotation(self) -> dict[str, float]:
        """Return by what angle each body has turned at the end, radians."""
        return self._by_name(self._turned()[-1])

    def greatest_displacement(self) -> dict[str, float]:
        """Return how far from where it began each body's centre came at any time, metres."""
        return self._by_name(self._moved().max(axis=0))

    def greatest_rotation(self) -> dict[str, float]:
        """Return by what angle each body was turned at any time, radians."""
        return self._by_name(self._turned().max(axis=0))

    def first_moved(self) -> dict[str, float]:
        """Return when each body that left where it was had moved or turned by the tolerances, seconds, in order."""
        limits = DISPLACEMENT_TOLERANCE * np.cbrt(np.prod(self.sizes, axis=1))
        gone = (self._moved() > limits) | (self._turned() > ROTATION_TOLERANCE)
        when = {k: float(self.times[np.argmax(gone[:, k])]) for k in np.flatnonzero(gone.any(axis=0))}
        return {self.names[k]: when[k] for k in sorted(when, key=lambda k: when[k])}

    def _moved(self) -> np.ndarray:
        return np.linalg.norm(self.poses[:, :, :3, 3] - self.poses[0, :, :3, 3], axis=2)

    def _turned(self) -> np.ndarray:
        relative = np.swapaxes(self.poses[0, :, :3, :3], 1, 2) @ self.poses[:, :, :3, :3]
        sine = np.linalg.norm(relative - np.swapaxes(relative, 2, 3), axis=(2, 3)) / np.sqrt(8)
        return np.arctan2(sine, 0.5 * (np.trace(relative, axis1=2, axis2=3) - 1))

    def _by_name(self, values: np.ndarray) -> dict[str, float]:
        return {name: float(value) for name, value in zip(self.names, values, strict=True)}


def save_trajectory(path: str | Path, trajectory: Trajectory, **meta: object) -> None:
    """Write a trajectory as .npz: names, sizes, times, poses, and what else is given (seed, version, command)."""
    from derender.atomic import atomic_path

    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(
            file,
            allow_pickle=False,
            names=np.array(trajectory.names, dtype=str),
            sizes=trajectory.sizes,
            times=trajectory.times,
            poses=trajectory.poses,
            **{key: np.array(value) for key, value in meta.items()},
        )
