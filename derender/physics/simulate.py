"""What happens next: the trajectory of a scene's bodies under gravity and what is done to them.

`Rollout` simulates as a function that inference calls: the same bodies again and again with other numbers, without
files.

    run = Rollout(matter, timestep=0.001)
    poses = run(times, velocity={"red": (0.5, 0, 0)}, friction={"red": 0.3, "floor": 0.4}, mass={"red": 0.2})

Building one costs some milliseconds; a call costs only its steps: four boxes for a second at 1 ms some 20 ms.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from derender.physics.bodies import Matter
from derender.physics.intervention import Disturbance, Push
from derender.physics.mujoco_model import BOUNCING_TIMESTEP, MOVING_TIMESTEP, World
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
    disturbance: Disturbance | None = None,
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
    from derender.physics.mujoco_model import BOUNCING_TIMESTEP, MOVING_TIMESTEP, Diverged

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
    disturbance: Disturbance | None,
    timestep: float | None,
) -> Trajectory:
    from derender.physics.mujoco_model import World

    done = disturbance or Disturbance()
    world = World(matter, timestep=timestep, sleeping=disturbance is None, moving=True if disturbance else None)
    shown = [i for i, body in enumerate(matter.bodies) if body.kind != "plane"]
    place = np.array([k for k, i in enumerate(shown) if matter.bodies[i].moves], dtype=int)
    sizes = np.array([matter.bodies[i].size for i in shown], float).reshape(-1, 3)
    frames = max(1, round(duration * frames_per_second))
    steps_done = 0
    # what is pushed or thrown may go far and yet come to rest as it was
    left_alone = disturbance is None and not any(np.any(body.velocity) for body in matter.bodies)
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
            gone = left_alone and (np.all(moved > limits) or fate.sealed(times[frame], poses[frame, place]))
            if early and (resting or gone):
                last = frame
                break
    names = tuple(world.names[i] for i in shown)
    return Trajectory(names, sizes, times[: last + 1], poses[: last + 1], resting)


def advance(world: World, done: Disturbance, gravity: np.ndarray, first: int, last: int) -> None:
    """Step a world from step number `first` to `last` under what is done to it."""
    if done.shake is not None:
        for step in range(first, last):
            world.set_gravity(gravity - done.shake.acceleration((step + 0.5) * world.timestep))
            world.set_forces(done.forces(step * world.timestep))
            world.step()
        return
    edges = [round(time / world.timestep) for time in done.edges()]
    for start, end in zip([first, *[e for e in edges if first < e < last]],
                          [*[e for e in edges if first < e < last], last], strict=True):  # fmt: skip
        if edges:
            world.set_forces(done.forces((start + 0.5) * world.timestep))
        if end > start:
            world.step(end - start)


Vector = Sequence[float] | np.ndarray


class Rollout:
    """A scene compiled once, simulated with numbers that are given at each call.

    matter : the scene; what a call does not say is as it says.
    timestep : seconds; None: .003 sqrt(s / g), s the smallest extent (.3 ms for 10 cm), less where something is
        elastic. Restitution is calibrated for every step; longer steps lift a box that slides.
    keep_contacts : whether pairs that the scene's graph joins rest at the distance at which they start, gap or overlap
        (see `mujoco_model`). Switch it off for bodies in flight or where poses are exact.

    names : of the bodies that move, in the order of the poses returned.
    step : seconds.
    """

    def __init__(self, matter: Matter, timestep: float | None = None, keep_contacts: bool = True) -> None:
        self.matter = matter
        self._moving = [body for body in matter.bodies if body.moves]
        self.names = tuple(body.name for body in self._moving)
        share = None if timestep is None else timestep / matter.period
        bouncy = any(body.elasticity for body in matter.bodies)
        self._world = World(
            matter, keep_contacts, share or (BOUNCING_TIMESTEP if bouncy else MOVING_TIMESTEP), moving=True
        )
        self._mass = {body.name: body.weight_in_kg() for body in self._moving}
        self._friction = {body.name: body.friction for body in matter.bodies}
        self._elasticity = {body.name: body.elasticity for body in matter.bodies}
        self.step = self._world.timestep

    def __call__(
        self,
        times: Vector,
        *,
        poses: Mapping[str, np.ndarray] | None = None,
        velocity: Mapping[str, Vector] | None = None,
        angular_velocity: Mapping[str, Vector] | None = None,
        mass: Mapping[str, float] | None = None,
        friction: Mapping[str, float | None] | None = None,
        elasticity: Mapping[str, float] | None = None,
        gravity: Vector | None = None,
        pushes: Sequence[Push] = (),
    ) -> np.ndarray:
        """Return where the moving bodies are at `times`, (T, M, 4, 4) float64, body to the frame of the scene.

        times : (T,) seconds from the start, ascending, 0 or more; poses between steps are those of the nearest step.
        poses : (4, 4) by name, at the start.
        velocity, angular_velocity : (3,) by name, m / s of the centre of mass and rad / s, in the frame of the scene.
        mass : kg by name. friction : Coulomb coefficient by name (of a pair: the geometric mean; None: nothing is
        said). elasticity : restitution by name (of a pair: the greater). gravity : (3,) m / s^2.
        pushes : forces on centres of mass.

        Raises Diverged : where the numbers are beyond what the engine can follow.
        """
        world = self._world
        world.set_masses({**self._mass, **(mass or {})})
        world.set_materials({**self._friction, **(friction or {})}, {**self._elasticity, **(elasticity or {})})
        pull = self.matter.gravity if gravity is None else np.asarray(gravity, dtype=float)
        world.set_gravity(pull)
        start = np.array([(poses or {}).get(body.name, body.pose) for body in self._moving], dtype=float)
        straight = np.array([(velocity or {}).get(body.name, body.velocity) for body in self._moving], dtype=float)
        turning = np.array(
            [(angular_velocity or {}).get(body.name, body.angular_velocity) for body in self._moving], dtype=float
        )
        world.reset(start, straight, turning)
        done = Disturbance(tuple(pushes))
        found = np.empty((len(times), len(self._moving), 4, 4))
        steps = 0
        for k, time in enumerate(times):
            wanted = round(float(time) / world.timestep)
            if wanted > steps:
                advance(world, done, pull, steps, wanted)
            steps = max(steps, wanted)
            found[k] = world.moving_poses()
        return found
