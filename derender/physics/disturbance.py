"""What is done to a scene from outside: pushes, a shaking floor, a tilt."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from derender.physics.bodies import Matter
from derender.scene.pose import from_rotation_vector


class Push(NamedTuple):
    """A force on a body's centre of mass.

    Attributes
    ----------
    body : name. force : (3,) newtons in the frame of the scene. start, duration : seconds.
    """

    body: str
    force: np.ndarray
    start: float = 0.0
    duration: float = 0.1


class Shake(NamedTuple):
    """A floor that swings to and fro: its place is amplitude * (1 - cos(2 pi frequency t)) along a direction.

    Attributes
    ----------
    frequency : 1 / s. amplitude : metres, half of what the floor travels. direction : (3,) unit vector.
    """

    frequency: float
    amplitude: float
    direction: np.ndarray

    def acceleration(self, time: float) -> np.ndarray:
        """Return the floor's acceleration (3,) at a time: seen from it, all bodies have the opposite one."""
        turn = 2 * np.pi * self.frequency
        return self.amplitude * turn**2 * np.cos(turn * time) * np.asarray(self.direction)


class Disturbance(NamedTuple):
    """All that is done to a scene while it is simulated."""

    pushes: tuple[Push, ...] = ()
    shake: Shake | None = None

    @property
    def ends(self) -> float:
        """Seconds after which nothing is done any more; infinite while the floor shakes."""
        return np.inf if self.shake is not None else max((p.start + p.duration for p in self.pushes), default=0.0)

    def forces(self, time: float) -> Mapping[str, np.ndarray]:
        """Return the force (3,) on each body that is being pushed at a time."""
        found: dict[str, np.ndarray] = {}
        for push in self.pushes:
            if push.start <= time < push.start + push.duration:
                found[push.body] = found.get(push.body, np.zeros(3)) + push.force
        return found

    def edges(self) -> list[float]:
        """Return the times at which a push begins or ends."""
        return sorted({time for push in self.pushes for time in (push.start, push.start + push.duration)})


def tilted(matter: Matter, angle: float, direction: np.ndarray) -> Matter:
    """Return a scene on a floor that is lowered on one side: gravity leans over towards `direction` by radians."""
    down = matter.gravity / np.linalg.norm(matter.gravity)
    axis = np.cross(down, direction)
    turned = from_rotation_vector(angle * axis / np.linalg.norm(axis))[:3, :3] @ matter.gravity
    return matter._replace(gravity=turned)
