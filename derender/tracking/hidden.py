"""Where a thing is that nothing shows: motions drawn from its last posterior, weighed by what each frame does not show.

Most of them are films of the physics engine, in which it falls, strikes and slides on; one is carried on by a hand at
its last velocity, and one is held where it was last seen.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from derender.dynamics.states import difference, from_poses, moved, to_poses

if TYPE_CHECKING:
    from derender.tracking.thing import Thing
    from derender.tracking.tracker import Tracker

HANDS, FILMS = 2, 14  # motions of a hand: none, and straight on; and of the engine
CARRIED = 0.2  # probability of a hand: most of what is in the air falls
FRICTION = (0.35, 0.6)  # median, and spread of the logarithm, of what is drawn: of dry things on table tops
TIMESTEP = 0.02  # of the engine, in units of sqrt(s / g): one to two milliseconds for boxes on a table


class Hidden(NamedTuple):
    """What may have become of one thing since it was seen last.

    Attributes
    ----------
    states : (K, 13), see dynamics.states, in the world's axes; the first two are a hand's. frictions : (K,).
    costs : (K,) nats so far. seen : (6, 6) covariance of its pose when it was seen last, world axes.
    """

    states: np.ndarray
    frictions: np.ndarray
    costs: np.ndarray
    seen: np.ndarray

    @property
    def weights(self) -> np.ndarray:
        """(K,) probabilities."""
        weights = np.exp(self.costs.min() - self.costs)
        return weights / weights.sum()

    @property
    def middle(self) -> np.ndarray:
        """(13,), that of the states whose centre is nearest to all others' on average."""
        centres = self.states[:, :3]
        return self.states[int(np.argmin(np.linalg.norm(centres[:, None] - centres, axis=-1) @ self.weights))]

    @property
    def pose(self) -> np.ndarray:
        """(4, 4), to the world, of the middle one."""
        return to_poses(self.middle)

    @property
    def motion(self) -> tuple[np.ndarray, np.ndarray]:
        """Velocity (3,) and spin (3,) of the middle one, world axes."""
        return self.middle[7:10], self.pose[:3, :3] @ self.middle[10:]

    def covariance(self) -> np.ndarray:
        """Return (6, 6) of the centre and the turn about the middle one, world axes."""
        off = difference(self.middle, self.states)[:, :6]
        off[:, 3:] = off[:, 3:] @ self.pose[:3, :3].T
        return self.seen + (self.weights * off.T) @ off


def last_seen(thing: "Thing", step: float, rng: np.random.Generator) -> Hidden:
    """Return what may be of a thing that was seen one frame, `step` seconds, ago."""
    state, turn = from_poses(thing.pose), thing.pose[:3, :3]
    state[7:10], state[10:] = thing.velocity, turn.T @ thing.spin
    spread = thing.covariance[:6, :6].copy()
    spread[3:, 3:] = turn.T @ spread[3:, 3:] @ turn
    spread[:3, 3:] = spread[3:, :3] = 0.0
    changes = np.zeros((HANDS + FILMS, 12))
    for part, share in ((slice(0, 6), 1.0), (slice(6, 12), 2.0 / step**2)):  # a speed is the difference of two poses
        changes[HANDS + 1 :, part] = rng.multivariate_normal(np.zeros(6), share * spread, FILMS - 1)
    states = moved(np.tile(state, (HANDS + FILMS, 1)), changes)
    states[0, 7:] = 0.0
    frictions = FRICTION[0] * np.exp(FRICTION[1] * rng.standard_normal(len(states)))
    costs = np.repeat([-np.log(CARRIED / HANDS), -np.log((1 - CARRIED) / FILMS)], [HANDS, FILMS])
    return Hidden(states, frictions, costs, thing.covariance[:6, :6].copy())


def one_frame_later(hidden: Hidden, tracker: "Tracker", k: int) -> Hidden:
    """Return what may be of thing k in the tracker's present frame, and draw the middle one."""
    change = np.zeros((len(hidden.states), 12))
    change[:, :6] = tracker.step * hidden.states[:, 7:]
    states, costs = moved(hidden.states, change), hidden.costs.copy()
    _fall(hidden, states, costs, tracker, k)
    costs += [tracker.draw(k, pose) / tracker.start.temper for pose in to_poses(states)]
    later = hidden._replace(states=states, costs=costs)
    tracker.draw(k, later.pose)
    return later


def _fall(hidden: Hidden, states: np.ndarray, costs: np.ndarray, tracker: "Tracker", k: int) -> None:
    """Run the engine for one frame from all states but the hand's, all other things held; write where it arrives."""
    from derender.physics.bodies import Body, Matter
    from derender.physics.mujoco_model import Diverged, World

    bodies = [] if tracker.floor is None else [Body("floor", "plane", np.zeros(3), tracker.floor)]
    for n, thing in enumerate(tracker.things):
        if thing.here or n == k:
            kind = "box" if thing.type == "cube" else thing.type
            bodies.append(Body(thing.name, kind, thing.size, thing.pose, fixed=n != k))
    world = World(Matter(tuple(bodies), tracker.gravity, ()), True, TIMESTEP, moving=True)
    count = max(round(tracker.step / world.timestep), 1)
    for n in range(HANDS, len(states)):
        pose, before = to_poses(hidden.states[n]), hidden.states[n]
        world.set_materials(dict.fromkeys(world.names, float(hidden.frictions[n])), {})
        world.reset(pose[None], before[None, 7:10], (pose[:3, :3] @ before[10:])[None])
        try:
            world.step(count)
        except Diverged:
            costs[n] = np.inf
            continue
        speed = world.data.qvel
        states[n, :7] = from_poses(world.moving_poses()[0])[:7]
        states[n, 7:10] = speed[:3] * (world.units.length / world.units.time)
        states[n, 10:] = speed[3:6] / world.units.time
