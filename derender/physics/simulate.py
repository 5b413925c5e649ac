"""What happens next: trajectories of a scene's bodies under gravity, and whether it stands."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from derender.physics.bodies import Matter

DURATION = 2.0
FRAMES_PER_SECOND = 50

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
    speed : float, of the fastest body at the end, m / s.
    """

    names: tuple[str, ...]
    sizes: np.ndarray
    times: np.ndarray
    poses: np.ndarray
    speed: float

    def displacement(self) -> dict[str, float]:
        """Return how far each body's centre ended from where it began, metres."""
        moved = np.linalg.norm(self.poses[-1, :, :3, 3] - self.poses[0, :, :3, 3], axis=1)
        return {name: float(value) for name, value in zip(self.names, moved, strict=True)}

    def rotation(self) -> dict[str, float]:
        """Return by what angle each body has turned at the end, radians."""
        relative = np.swapaxes(self.poses[0, :, :3, :3], 1, 2) @ self.poses[-1, :, :3, :3]
        sine = np.linalg.norm(relative - np.swapaxes(relative, 1, 2), axis=(1, 2)) / np.sqrt(8)
        cosine = 0.5 * (np.trace(relative, axis1=1, axis2=2) - 1)
        return {name: float(value) for name, value in zip(self.names, np.arctan2(sine, cosine), strict=True)}

    def fallen(self) -> list[str]:
        """Return the names of the bodies that have moved or turned by more than the tolerances."""
        moved, turned = self.displacement(), self.rotation()
        found = []
        for name, size in zip(self.names, self.sizes, strict=True):
            extent = float(np.cbrt(np.prod(size)))
            if moved[name] > DISPLACEMENT_TOLERANCE * extent or turned[name] > ROTATION_TOLERANCE:
                found.append(name)
        return found


class Verdict(NamedTuple):
    """Whether a scene stands.

    Attributes
    ----------
    stable : whether every body stayed where it was.
    fallen : names of those that did not.
    displacement : metres by name.
    rotation : radians by name.
    """

    stable: bool
    fallen: tuple[str, ...]
    displacement: dict[str, float]
    rotation: dict[str, float]


def simulate(
    matter: Matter, duration: float = DURATION, frames_per_second: float = FRAMES_PER_SECOND, early: bool = False
) -> Trajectory:
    """Let a scene go and return its trajectory.

    Parameters
    ----------
    duration : seconds.
    frames_per_second : poses that are kept.
    early : stop as soon as every body's fate is known: all have fallen by five times the tolerance, or all have been at
        rest (in speed and in acceleration) for half a second.
    """
    from derender.physics.mujoco_model import World

    world = World(matter)
    moving = [i for i, body in enumerate(matter.bodies) if body.kind != "plane"]
    names = tuple(world.names[i] for i in moving)
    sizes = np.array([matter.bodies[i].size for i in moving], float).reshape(-1, 3)
    frames = max(1, round(duration * frames_per_second))
    steps_done, calm = 0, 0.0
    times, poses = [0.0], [world.poses()[moving]]
    gravity = float(np.linalg.norm(matter.gravity))
    limits = 5 * DISPLACEMENT_TOLERANCE * np.cbrt(np.prod(sizes, axis=1))
    for frame in range(1, frames + 1):
        wanted = round(frame * duration / frames / world.timestep)
        elapsed = (wanted - steps_done) * world.timestep
        world.step(wanted - steps_done)
        steps_done = wanted
        times.append(steps_done * world.timestep)
        poses.append(world.poses()[moving])
        if early:
            # At rest: a thousandth of the speed of a fall by one's own size, and of gravity.
            resting = world.speed() < 1e-3 * np.sqrt(gravity * world.length) and world.acceleration() < 1e-3 * gravity
            calm = calm + elapsed if resting else 0.0
            moved = np.linalg.norm(poses[-1][:, :3, 3] - poses[0][:, :3, 3], axis=1)
            if calm >= 0.5 or np.all(moved > limits):
                break
    return Trajectory(names, sizes, np.array(times), np.array(poses), world.speed())


def judge(trajectory: Trajectory) -> Verdict:
    """Return whether the bodies stayed where they were, and how far each moved and turned."""
    fallen = tuple(trajectory.fallen())
    return Verdict(not fallen, fallen, trajectory.displacement(), trajectory.rotation())


def verdicts(matters: Iterable[Matter], duration: float = DURATION, jobs: int = 1) -> Iterator[Verdict]:
    """Yield the verdict on each scene, such as the draws of a posterior; each run stops when its verdict is known.

    Parameters
    ----------
    jobs : threads; MuJoCo leaves Python's lock while it steps. The result does not depend on it.
    """
    from concurrent.futures import ThreadPoolExecutor

    def run(matter: Matter) -> Verdict:
        return judge(simulate(matter, duration, early=True))

    if jobs == 1:
        yield from map(run, matters)
        return
    with ThreadPoolExecutor(jobs) as pool:
        yield from pool.map(run, matters)


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
