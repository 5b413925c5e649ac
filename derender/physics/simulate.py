"""What happens next: the trajectory of a scene's bodies under gravity and what is done to them.

The same bodies again and again with other numbers, as inference asks, are `derender.dynamics.engine`'s.
"""

from itertools import pairwise

import numpy as np

from derender.physics.bodies import Matter
from derender.physics.intervention import Intervention
from derender.physics.mujoco_model import BOUNCING_TIMESTEP, MOVING_TIMESTEP, Diverged, World
from derender.physics.verdict import DISPLACEMENT_TOLERANCE, Fate, Trajectory, Verdict, judge, save_trajectory

__all__ = ["DURATION", "Trajectory", "Verdict", "judge", "save_trajectory", "simulate"]

DURATION = 2.0
FRAMES_PER_SECOND = 50
# One whose fate is known has moved by so many times the tolerance.
GONE = 5.0


def simulate(
    matter: Matter,
    duration: float = DURATION,
    frames_per_second: float = FRAMES_PER_SECOND,
    early: bool = False,
    disturbance: Intervention | None = None,
    timestep: float | None = None,
) -> Trajectory:
    """Let a scene go and return its trajectory.

    duration : seconds.
    frames_per_second : poses that are kept.
    early : stop as soon as the verdict is known: all are at rest, or all have moved by five times the tolerance, or
        some body has lost what bore it and all that this brings down has had time to fall (see `Fate`).
    disturbance : what is done to the scene meanwhile.
    timestep : in units of sqrt(s / g), s the smallest extent; None: as `World` chooses.

    Raises Diverged : where speeds or forces are beyond what the engine can follow, at a quarter of the step too.
    """
    if disturbance is not None and timestep is None and not any(body.elasticity for body in matter.bodies):
        timestep = MOVING_TIMESTEP
    try:
        return _run(matter, duration, frames_per_second, early, disturbance, timestep)
    except Diverged:
        return _run(matter, duration, frames_per_second, early, disturbance, 0.25 * (timestep or BOUNCING_TIMESTEP))


def _run(
    matter: Matter,
    duration: float,
    frames_per_second: float,
    early: bool,
    disturbance: Intervention | None,
    timestep: float | None,
) -> Trajectory:
    done = disturbance or Intervention()
    world = World(matter, timestep=timestep, sleeping=disturbance is None, moving=True if disturbance else None,
                  gripping=True)  # fmt: skip
    shown = [i for i, body in enumerate(matter.bodies) if body.kind != "plane"]
    place = np.array([k for k, i in enumerate(shown) if matter.bodies[i].moves], dtype=int)
    sizes = np.array([matter.bodies[i].size for i in shown], float).reshape(-1, 3)
    frames = max(1, round(duration * frames_per_second))
    steps_done = 0
    # what is pushed or thrown may go far and yet come to rest as it was
    left_alone = disturbance is None and not matter.thrown
    poses = np.tile(np.array([matter.bodies[i].pose for i in shown], float).reshape(-1, 4, 4), (frames + 1, 1, 1, 1))
    times = np.zeros(frames + 1)
    limits = GONE * DISPLACEMENT_TOLERANCE * np.cbrt(np.prod(sizes[place], axis=1))
    fate = Fate(matter, world.length)
    last, resting = frames, False
    for frame in range(1, frames + 1):
        wanted = round(frame * duration / frames / world.timestep)
        advance(world, done, matter.gravity, steps_done, wanted)
        steps_done = wanted
        times[frame] = steps_done * world.timestep
        poses[frame, place] = world.moving_poses()
        if world.asleep:
            # nothing moves any more: the rest of the trajectory is known
            poses[frame + 1 :], times[frame + 1 :] = poses[frame], np.arange(frame + 1, frames + 1) * duration / frames
            last, resting = frame if early else frames, True
            break
        if frame == frames or (early and times[frame] > done.ends):
            resting = fate.at_rest(times[: frame + 1], poses[: frame + 1, place])
            moved = np.linalg.norm(poses[frame, place, :3, 3] - poses[0, place, :3, 3], axis=1)
            lost = not matter.thrown and fate.sealed(times[frame], poses[frame, place])
            gone = lost or (left_alone and np.all(moved > limits))
            if early and (resting or gone):
                last = frame
                break
    names = tuple(world.names[i] for i in shown)
    return Trajectory(names, sizes, times[: last + 1], poses[: last + 1], resting)


def advance(world: World, done: Intervention, gravity: np.ndarray, first: int, last: int) -> None:
    """Step a world from step number `first` to `last` under what is done to it, which changes between those steps only
    where a push begins or ends; while the floor shakes, at each of them."""
    ends = {round(time / world.timestep) for push in done.pushes for time in (push.start, push.start + push.duration)}
    edges = range(first, last) if done.shake else [first, *sorted(e for e in ends if first < e < last)]
    for start, end in pairwise([*edges, last]):
        if done.shake:
            world.set_gravity(gravity - done.shake.acceleration(start * world.timestep, end * world.timestep))
        if done.pushes:
            world.set_forces(done.forces((start + 0.5) * world.timestep))
        world.step(end - start)
