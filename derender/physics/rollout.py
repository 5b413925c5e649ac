"""Simulation as a function that inference calls: the same bodies again and again with other numbers, without files.

    run = Rollout(matter, timestep=0.001)
    poses = run(times, velocity={"red": (0.5, 0, 0)}, friction={"red": 0.3, "floor": 0.4}, mass={"red": 0.2})

Building one costs some milliseconds; a call costs only its steps: four boxes for a second at 1 ms some 20 ms.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from derender.physics.bodies import Matter
from derender.physics.intervention import Disturbance, Push
from derender.physics.mujoco_model import BOUNCING_TIMESTEP, MOVING_TIMESTEP, World
from derender.physics.simulate import advance
from derender.scene.graph import STANDARD_GRAVITY

Vector = Sequence[float] | np.ndarray


class Rollout:
    """A scene compiled once, simulated with numbers that are given at each call.

    Parameters
    ----------
    matter : the scene; what a call does not say is as it says.
    timestep : seconds; None: .003 sqrt(s / g), s the smallest extent (.3 ms for 10 cm), less where something is
        elastic. Restitution is calibrated for every step; longer steps lift a box that slides.
    keep_contacts : whether pairs that the scene's graph joins rest at the distance at which they start, gap or overlap
        (see `mujoco_model`). Switch it off for bodies in flight or where poses are exact.

    Attributes
    ----------
    names : of the bodies that move, in the order of the poses returned.
    step : seconds.
    """

    def __init__(self, matter: Matter, timestep: float | None = None, keep_contacts: bool = True) -> None:
        self.matter = matter
        self._moving = [body for body in matter.bodies if body.moves]
        self.names = tuple(body.name for body in self._moving)
        share = None
        if timestep is not None:
            extents = [float(np.min(body.size)) for body in matter.bodies if body.kind != "plane"]
            strength = float(np.linalg.norm(matter.gravity)) or STANDARD_GRAVITY
            share = timestep / float(np.sqrt(min(extents, default=0.1) / strength))
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

        Parameters
        ----------
        times : (T,) seconds from the start, ascending, 0 or more; poses between steps are those of the nearest step.
        poses : (4, 4) by name, at the start.
        velocity, angular_velocity : (3,) by name, m / s of the centre of mass and rad / s, in the frame of the scene.
        mass : kg by name. friction : Coulomb coefficient by name (of a pair: the geometric mean; None: nothing is
        said). elasticity : restitution by name (of a pair: the greater). gravity : (3,) m / s^2.
        pushes : forces on centres of mass.

        Raises
        ------
        Diverged : where the numbers are beyond what the engine can follow.
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
