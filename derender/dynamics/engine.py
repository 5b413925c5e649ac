"""The physics engine as a function, from states and materials to the states one frame later; and how wrong it is.

Between two frames the engine errs by a share of the impulse that contacts give. An impact's impulse is the change of
velocity beyond what gravity and a contact that rests or slides on the floor explain: more along the floor's normal, or
beyond friction's cone about it, where Coulomb's law leaves nothing but another body. Its error is independent from one
impact to the next, so that after each one the film, not the engine, says where a body goes. What follows an impact is
chaotic (Zhou, Pinto, Gupta 2018: "More than a million ways to be pushed"); here that needs no special case.
"""

from typing import NamedTuple

import numpy as np

from derender.dynamics.states import STATE, to_poses, unturned
from derender.physics.bodies import Matter
from derender.physics.mujoco_model import Diverged, World

# Steps are at most this long, seconds: boxes that slide rock from corner to corner, and where they come to rest jumps
# with friction by .6 mm at 1 ms and .3 mm here, which hides the way to the best friction from derivatives.
LONGEST_STEP = 0.00025
# Steps of an interval with an impact, seconds. An interval has one where contacts change a velocity by so many times
# what gravity does: resting ones by 1, sliding ones by 1.2 at a friction of .6.
IMPACT_STEP, IMPACT = 0.0001, 1.25
# An impact may be under way where an interval begins or ends. It has two intervals then, which need the same steps:
# contacts of long ones cannot be as short, and a bounce that began at one stiffness and ended at another would gain or
# lose up to .2 of restitution. The force there, for as long as a contact lasts, tells what change is to come.
# Corners hold a box against spinning and rolling; without that friction of its own a step costs half. A ball resists
# spinning alone: resistance to rolling shares the friction cone with that to sliding, and would spoil its impacts.
WITHOUT_SPINNING, WITHOUT_ROLLING = 3, 4
# So many times faster than in `simulate` do contacts stop slip. Boxes of 5 to 12 cm are then slowed by .994 of friction
# times their weight (.98 before; the scatter is 1 % and was 2.6 %), and lifted by some .2 mm.
FIRMER = 3.0
# A restitution at which contacts are critically damped, so that what slides stays on what it slides on: at 0 they are
# overdamped, and its corners hop and lose friction.
SLIDING_RESTITUTION = 0.135

FAR = 1e3  # a margin, in units of lengths of the engine, at which two bodies never touch
# An error that is always there: of the engine's steps, between two frames, m / s.
LEAST_SPEED = 5e-4
# An impact in the engine depends on when within a step it begins, by some hundredths of its speed from one end of the
# step to the other: the standard error, as a share of the change of velocity. And what follows is early or late by a
# share of the contact's time, as its force rises and falls in another way: seconds.
LEAST_IMPACT, LATE = 0.01, 0.001
# Boxes that slide to rest from nearly the same state end .2 mm and half a degree apart, by how their corners rock: so
# much, as a share of gravity's change of velocity, explains that. Without it a film that happens to fit is believed.
LEAST_STEADY = 0.004
# The engine slides as if friction were another by this share: boxes that rock as they slide go up to 3 % too far. It
# bounces as if restitution were off by so much: half of the worst that drops leave (scripts/evaluate.py physics).
# Neither averages out.
ENGINE_FRICTION, ENGINE_RESTITUTION = 0.02, 0.015
# Errors of steady contacts are learnt as if each interval had another one. Where something unseen pushes or holds they
# last, and friction, the share of gravity that slows a slide, may be off by so many times what is learnt beyond what
# was believed: by 3.0, 2.5 and 1.2 times where a hand pushed, a hand stopped and a wall stopped a box.
LASTING = 3.0
# A resting or sliding contact changes the velocity by at most so many times gravity's share: friction up to 1.1, or a
# box that rocks as it slides.
STEADY = 1.5
# What slides from frame to frame is slowed by all that friction can give, but for where it rocks; what sticks where it
# lands by less. A slide changes a velocity by more than this share of what gravity does: less is a ball that rolls.
SLIDES, LEAST_SLIDE = 0.8, 0.02
# An impulse at half a cube's side from its centre turns it by 3 / side; the mean over a face is 2 / side.
LEVER = 2.0


class Material(NamedTuple):
    """What the engine is told of all bodies."""

    friction: float  # Coulomb coefficient of every pair
    restitution: float  # of every pair
    masses: np.ndarray  # (N,) float64, kg, of the moving bodies
    contact_time: float = 0.002  # seconds that a bounce takes: half a period of the contact's spring


class Engine:
    """A world whose state and material can be set.

    matter : bodies and gravity; those in `names` move, all others are fixed.
    names : N of the moving bodies.
    interval : seconds that `advance` advances by. coarser : times that its steps are as long as usual.
    """

    def __init__(self, matter: Matter, names: tuple[str, ...], interval: float, coarser: float = 1.0) -> None:
        order = {name: k for k, name in enumerate(names)}
        bodies = [body._replace(fixed=body.name not in order) for body in matter.bodies]
        bodies.sort(key=lambda body: order.get(body.name, len(order)))
        matter = matter._replace(bodies=tuple(bodies))
        self.gravity = np.asarray(matter.gravity, float)
        floor = next((body.pose[:3, 2] for body in bodies if body.kind == "plane"), -self.gravity)
        self._normal = floor / (float(np.linalg.norm(floor)) or 1.0)
        self.interval = interval
        self.masses = np.array([body.weight_in_kg() for body in bodies[: len(names)]])
        self._names, self._bodies, self._made_of, self._parted = (
            names,
            bodies,
            (matter, names, interval, coarser),
            False,
        )
        self._balls = np.array([body.kind == "sphere" for body in bodies[: len(names)]], bool)
        self._steps = [int(np.ceil(interval / step / coarser)) for step in (LONGEST_STEP, IMPACT_STEP)]
        self._worlds = [self._world(matter, interval / count) for count in self._steps]
        self._masses: tuple = ()
        self._rest: tuple = ()

    def _world(self, matter: Matter, step: float) -> World:
        world = World(matter, False, step / matter.period, moving=True)
        flat = all(body.kind in ("plane", "box") for body in matter.bodies)
        for dimensions in (world.model.geom_condim, world.model.pair_dim):
            np.minimum(dimensions, WITHOUT_SPINNING if flat else WITHOUT_ROLLING, out=dimensions)
        world.model.pair_solreffriction[:, 1] *= FIRMER
        return world

    def twin(self) -> "Engine":
        """Return another engine that does the same, for another thread."""
        other = Engine(*self._made_of)
        if self._parted:
            other.part()
        return other

    def part(self) -> None:
        """Let the moving bodies pass through each other."""
        self._parted = True
        for world in self._worlds:
            owner = world.model.geom_bodyid
            both = (owner[world.model.pair_geom1] > 0) & (owner[world.model.pair_geom2] > 0)
            world.model.pair_margin[both] = -FAR

    def tell(self, material: Material) -> None:
        """Set friction, restitution, masses and contact time."""
        masses, rest = tuple(material.masses), (material.friction, material.restitution, material.contact_time)
        for world in self._worlds:
            if masses != self._masses:
                world.set_masses(dict(zip(self._names, masses, strict=True)))
            if rest != self._rest:
                world.set_materials(*rest)
        self._masses, self._rest = masses, rest

    def advance(self, states: np.ndarray) -> np.ndarray:
        """Return the states (N, 13) one interval after `states` (N, 13); Diverged where it cannot.

        An interval with an impact, or with a part of one, is run again at shorter steps, of which a short contact lasts
        some twenty.
        """
        after, hardest = self._advance(0, states)
        change = np.linalg.norm(after[:, 7:10] - states[:, 7:10] - self.gravity * self.interval, axis=1)
        under_way = hardest * self._rest[2] * 2 / np.pi
        if max(change.max(), under_way) > IMPACT * float(np.linalg.norm(self.gravity)) * self.interval:
            after, _ = self._advance(1, states)
        return after

    def _advance(self, number: int, states: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the states after an interval, and by how much contacts accelerate a body at its ends, m / s^2."""
        world, count = self._worlds[number], len(states)
        length, time = world.units.length, world.units.time
        place = world.data.qpos.reshape(count, 7)
        speed = world.data.qvel.reshape(count, 6)
        place[:, :3] = states[:, :3] / length
        place[:, 3:] = states[:, 3:7]
        speed[:, :3] = states[:, 7:10] * (time / length)
        speed[:, 3:] = states[:, 10:] * time
        world.data.qacc_warmstart[:] = 0.0
        hardest = 0.0
        try:
            for steps in (1, self._steps[number] - 1):
                world.step(steps)
                pushed = world.data.qacc.reshape(count, 6)[:, :3] * (length / time**2) - self.gravity
                hardest = max(hardest, float(np.linalg.norm(pushed, axis=1).max(initial=0.0)))
        except Diverged:
            world.reset()  # its warnings would stay, and all later films be said to diverge
            raise
        result = np.empty((count, STATE))
        result[:, :3] = place[:, :3] * length
        result[:, 3:7] = place[:, 3:]
        result[:, 7:10] = speed[:, :3] * (length / time)
        result[:, 10:] = speed[:, 3:] / time
        if self._balls.any():
            result[self._balls] = unturned(result[self._balls])
        return result, hardest

    def impulses(self, before: np.ndarray, after: np.ndarray, friction: float) -> np.ndarray:
        """Return (..., N, 2): changes of velocity (m / s) by impacts, and by steady contacts, between (..., N, 13).

        friction : Coulomb coefficient: an interval's impulses of contacts with the floor sum to one within its cone,
            because the cone is convex.
        """
        most = STEADY * float(np.linalg.norm(self.gravity)) * self.interval
        change, lifted, across = self._pushed(before, after)
        hit = np.maximum(lifted - most, 0.0)
        struck = np.maximum(across - friction * np.clip(lifted, 0.0, most), 0.0)
        return np.stack([np.hypot(hit, struck), np.minimum(np.linalg.norm(change, axis=-1), most)], axis=-1)

    def slides(self, before: np.ndarray, after: np.ndarray, friction: float) -> tuple[np.ndarray, np.ndarray]:
        """Return (..., N) bool: whether friction gave a body nearly all that it can between (..., N, 13), and whether
        the body touched the floor and friction gave it hardly anything."""
        _, lifted, across = self._pushed(before, after)
        weight = float(np.linalg.norm(self.gravity)) * self.interval
        free = across <= LEAST_SLIDE * weight
        return (across > SLIDES * friction * lifted) & ~free, free & (lifted > SLIDES * weight)

    def _pushed(self, before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return by how much contacts changed velocities (..., N, 3), along the floor's normal and across it, m / s."""
        change = after[..., 7:10] - before[..., 7:10] - self.gravity * self.interval
        lifted = change @ self._normal
        return change, lifted, np.linalg.norm(change - lifted[..., None] * self._normal, axis=-1)

    def overlaps(self, states: np.ndarray) -> np.ndarray:
        """Return (N,) metres by which each body should be raised so that it enters nothing below it."""
        count, raised = len(states), np.zeros(len(states))
        moving = [body._replace(pose=pose) for body, pose in zip(self._bodies, to_poses(states), strict=False)]
        height = -states[:, :3] @ self.gravity
        for k, body in enumerate(moving):
            lower = [moving[j] for j in range(count) if height[j] < height[k]]
            raised[k] = max([0.0, *(-body.gap(other) for other in (*lower, *self._bodies[count:]))])
        return raised


class Scales(NamedTuple):
    """Their logarithms are what is learnt; `Prior` says what is believed of them before.

    steady : error of resting and sliding contacts between two frames, as a share of gravity's change of velocity.
    tracking, turning : by how much the stated errors of centres and of turns are to be multiplied.
    """

    impact: float  # error of an impact, as a share of its change of velocity
    steady: float
    tracking: float
    turning: float


def velocity_errors(impulse: np.ndarray, scales: Scales) -> np.ndarray:
    """Return the standard errors (..., N), m / s, of the changes of velocity that contacts give (`Engine.impulses`)."""
    impact = np.hypot(scales.impact, LEAST_IMPACT) * impulse[..., 0]
    steady = np.hypot(scales.steady, LEAST_STEADY) * impulse[..., 1]
    return np.hypot(np.hypot(impact, steady), LEAST_SPEED)
