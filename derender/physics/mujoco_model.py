"""A scene as a MuJoCo model in which nothing jumps: the contacts that the graph states are the engine's rest state.

Soft contacts push two bodies apart where they overlap and let them fall together where a gap is left. An inferred scene
has both, by millimetres: the slack of its contacts. Here every pair that the graph joins, and every pair that overlaps
at the start, gets a contact whose rest distance (MuJoCo's `margin`, which may be negative) is the distance they start
with. All other pairs collide as usual.

The engine works in the scene's own units: the unit of length is the smallest extent s among the bodies, that of time
sqrt(s / g), that of mass the heaviest body's. A tower of 0.1 mm blocks gets the verdict of the same tower of 40 cm.
"""

from collections.abc import Mapping
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from derender.compilation.threads import each_one_of_many
from derender.errors import DerenderError
from derender.physics.bodies import Body, Matter, bounce_damping, clamped_masses, leans, pair_frictions
from derender.physics.statics import ROLLING, plane_is_below, widest_gap
from derender.scene.friction import OF_BODIES
from derender.scene.pose import quaternion, rotation_x

with each_one_of_many():  # the GLFW in it starts a process
    import mujoco

# In units of sqrt(s / g). Towers of ten blocks creep and fall over at three times this step (196 of 200 right) and not
# at this one (200 of 200); half of it changes no verdict.
TIMESTEP = 0.01
# Where something moves from the start: contacts then lift a sliding box by .003 of its side at most.
MOVING_TIMESTEP = 0.003
# Where something bounces: the speed after a fall from half the smallest extent or more is then right to .03.
BOUNCING_TIMESTEP = 0.0025
# A contact is a spring whose frequency times the step is this. One that bounces is softer: a bounce then takes 20
# steps, and the speed after it depends on when within a step it began by .015 of the speed before, not by .02.
STIFFNESS, BOUNCING_STIFFNESS = 0.2, 0.15
# How much of the demanded acceleration a contact enforces, and how many times more so across than along its normal.
# Where things rest on the level, contacts are nearly rigid: a tower of 30 blocks then sleeps after 120 steps, and at
# .9985 not after 400; at .9995 blocks that settle chatter and cost twice as much. Where they move or lean, softer ones
# let a box slide at .98 to 1.02 of friction times weight (friction .3 to .8); with a ratio of 1, or at .99, some slide
# at .98.
RESTING = 0.999, 1.0
MOVING = 0.98, 10.0
# A contact of a light body that bears a heavy one would give way in proportion to what it bears over what it weighs:
# beyond this ratio it enforces more, as far as MuJoCo goes.
MOST_BORNE, LEAST_SOFTNESS = 10.0, 1e-4
# What slides without bouncing is held by softer contacts (how much they enforce, and so many times more across, as of
# MOVING; stiffness; damping ratio): hard ones let go of a box corner by corner, and friction then acts along how those
# jump, not along the way. Boxes that slid at an angle to their faces were slowed by .86 to .99 of friction times
# weight, and what was pushed by 2 % more than that went up to six times too far.
SLIDING, SLIDING_ACROSS, SLIDING_STIFFNESS, SLIDING_DAMPING = 0.2, 100.0, 0.08, 2.0
# The solver stops where a step gains less than this (MuJoCo's default) beside the mean of all inertias: among heavy
# bodies a light one would be left with forces that throw it about, a box of .5 kg on one of 10 t off it.
TOLERANCE = 1e-8
# Contacts that are harder than this throw bodies about where they are ten times harder still across their normal.
SOFT_ENOUGH = 0.005
# Rate at which a contact stops sliding where friction could hold it, in units of sqrt(g / s). MuJoCo lifts what slides
# (by friction times rate times speed over the stiffness), out of touch where speed times rate is much above friction
# times gravity; below it friction gives less than it could. So the rate goes with the speed: it stops by GRIPPED times
# friction times gravity, up to MOST_GRIP, renewed every REGRIP steps. Elastic contacts have one rate.
GRIP, GRIPPED, MOST_GRIP, REGRIP = 15.0, 1.5, 100.0, 16
# Contacts of the graph start engaged by this much (in units of s), about what the weight of two or three bodies presses
# them in, so that they bear from the first step; softer ones by the second times how soft they are.
ENGAGED, ENGAGED_SLIDING = 2e-5, 1e-4
# What the graph does not join touches at the start where it is no further apart than this (in units of s).
TOUCHING = 1e-5
# Resistance to spinning in units of s; that to rolling is ROLLING: enough that a ball on a table stays.
SPINNING = 0.05
# Up to so many bodies every pair has a contact of its own; beyond, those within reach at the start do, and all others
# meet by MuJoCo's own rules, which are the same where all are made of the same.
MOST_PAIRED = 16
# A pair is within reach if its distance is below so many units of s.
WITHIN_REACH = 1.0
# A body sleeps when it is slower than this (in units of sqrt(s g)) for ten steps together with all that it touches: a
# body that nothing holds is faster after the first of them, one that leans over by .001 g after the tenth.
SLEEPING = 2e-5
# The smallest extent is taken for the unit unless the greatest is more than this many times greater.
MOST_EXTENT = 1000.0
# MuJoCo now and then reports a cylinder that stands exactly flat on a plane as sunk in by its radius (the direction
# to its deepest point is then a difference of equal numbers), and throws it into the air. Upright ones are prisms.
PRISM_SIDES = 32

BROKEN = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)

# Its warnings would go to a file in the working folder; they are read from `data.warning`.
mujoco.set_mju_user_warning(lambda message: None)


class Units(NamedTuple):
    """What one of the engine's units is worth: metres, seconds, kilograms."""

    length: float
    time: float
    mass: float


class Diverged(DerenderError):
    """The engine's numbers have become infinite: its steps are too long for what happens."""

    def __init__(self) -> None:
        super().__init__("the simulation diverged", None, "masses or sizes too far apart, or speeds too high")


class World:
    """A compiled model of a scene and its state.

    matter : the scene.
    keep_contacts : whether the distances at the start are the rest distances (see the module).
    timestep : in units of sqrt(s / g); None: TIMESTEP, MOVING_TIMESTEP where a body moves at the start, or
        BOUNCING_TIMESTEP where one is elastic.
    sleeping : whether bodies at rest are left out of the computation until something touches them.
    moving : whether contacts are those of bodies that slide and not those of bodies at rest; None: where a body moves
        at the start, is elastic or leans.
    units : of the engine; None: the scene's own.
    gripping : whether what slides is held by softer contacts, whose grip goes with its speed from step to step.

    names : of the bodies, in the order of all arrays.
    moving : indices of those that can move.
    model, data : MuJoCo's, in the engine's units.
    length : the smallest extent, metres.
    """

    def __init__(
        self,
        matter: Matter,
        keep_contacts: bool = True,
        timestep: float | None = None,
        sleeping: bool = False,
        moving: bool | None = None,
        units: Units | None = None,
        gripping: bool = False,
    ) -> None:
        self.matter = matter
        self.names = [body.name for body in matter.bodies]
        self.moving = [index for index, body in enumerate(matter.bodies) if body.moves]
        extents = [float(np.max(body.size)) for body in matter.bodies if body.kind != "plane"]
        self.length = max(matter.unit, max(extents, default=0.0) / MOST_EXTENT)
        period = float(np.sqrt(self.length / matter.strength))
        masses = clamped_masses(matter.bodies)
        self.units = units or Units(self.length, period, float(masses.max(initial=0.0)) or 1.0)
        # the scene's own scales in the engine's units
        self._long, self._slow = self.length / self.units.length, period / self.units.time
        bouncy = any(body.elasticity > 0 for body in matter.bodies)
        usual = BOUNCING_TIMESTEP if bouncy else MOVING_TIMESTEP if matter.thrown else TIMESTEP
        self._step = (timestep or usual) * self._slow
        self._slides = moving if moving is not None else matter.thrown or bouncy or leans(matter)
        self._soft = gripping and bool(moving or matter.thrown)
        self._hardness, self._across = MOVING if self._slides else RESTING
        self._rough = [body.friction for body in matter.bodies]
        self._bouncy = [body.elasticity for body in matter.bodies]
        self._bouncing = BOUNCING_STIFFNESS
        self._gripping = 0  # steps until the grips are renewed
        self._geom_names: list[list[str]] = []  # of each body: of its convex pieces
        self.spec = self._spec(masses, sleeping)
        self.model = self.spec.compile()
        owner = {name: index for index, names in enumerate(self._geom_names) for name in names}
        self._index_of_geom = np.array([owner[geom.name] for geom in self.spec.geoms], dtype=int)
        self._geoms_of = [np.flatnonzero(self._index_of_geom == index) for index in range(len(self.names))]
        self._moving_ids = np.array([self._number_of(self.names[index]) for index in self.moving], dtype=int)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, self.data)
        self._pair_of = np.full((self.model.ngeom, self.model.ngeom), -1)  # numbers of pairs, by their geoms
        self._pair_of[self.model.pair_geom1, self.model.pair_geom2] = np.arange(self.model.npair)
        self._pair_of = np.maximum(self._pair_of, self._pair_of.T)
        self._set_materials()
        self._set_impedance()
        if keep_contacts:
            self._rest_as_they_are()
        self._start()

    # ---- state ----------------------------------------------------------------------------------------------------

    @property
    def timestep(self) -> float:
        """Seconds of one step."""
        return float(self.model.opt.timestep) * self.units.time

    @property
    def asleep(self) -> bool:
        """Whether every body that can move is at rest and left out of the computation."""
        return bool(self.data.ntree_awake == 0)

    def moving_poses(self) -> np.ndarray:
        """Return where the bodies that can move are now, (M, 4, 4) float64."""
        poses = np.zeros((len(self.moving), 4, 4))
        poses[:, :3, :3] = self.data.xmat[self._moving_ids].reshape(-1, 3, 3)
        poses[:, :3, 3] = self.data.xpos[self._moving_ids] * self.units.length
        poses[:, 3, 3] = 1.0
        return poses

    def step(self, count: int = 1) -> None:
        """Advance by `count` steps, and bring the poses up to date; Diverged where numbers become infinite."""
        while count > 0:
            if self._yields.any() and self._gripping == 0:
                self._regrip()
                self._gripping = REGRIP
            steps = min(count, self._gripping) if self._yields.any() else count
            mujoco.mj_step(self.model, self.data, steps)
            self._gripping, count = max(self._gripping - steps, 0), count - steps
        mujoco.mj_kinematics(self.model, self.data)
        if any(self.data.warning[kind].number for kind in BROKEN) or not np.isfinite(self.data.qpos).all():
            raise Diverged

    def set_gravity(self, gravity: np.ndarray) -> None:
        """Set gravity (3,), m / s^2 in the frame of the scene."""
        self.model.opt.gravity[:] = np.asarray(gravity) * (self.units.time**2 / self.units.length)

    def set_forces(self, forces: Mapping[str, np.ndarray]) -> None:
        """Set the forces (3,), newtons, that act on the centres of mass of some bodies; none on the others."""
        self.data.xfrc_applied[:] = 0.0
        newton = self.units.time**2 / (self.units.mass * self.units.length)
        for name, force in forces.items():
            self.data.xfrc_applied[self._number_of(name), :3] = np.asarray(force) * newton

    def reset(self) -> None:
        """Begin anew, as the scene says."""
        mujoco.mj_resetData(self.model, self.data)
        self._start()

    def set_masses(self, masses: Mapping[str, float]) -> None:
        """Set the masses of some bodies, kg, their inertias in proportion; call `reset` afterwards."""
        for name, mass in masses.items():
            number, mass = self._number_of(name), mass / self.units.mass
            self.model.body_inertia[number] *= mass / self.model.body_mass[number]
            self.model.body_mass[number] = mass
        mujoco.mj_setConst(self.model, self.data)
        self._set_impedance()

    def set_materials(self, friction: float, elasticity: float, contact_time: float) -> None:
        """Set the friction and elasticity of all bodies, and the seconds that bounces take."""
        self._bouncing = min(np.pi * self.timestep / contact_time, STIFFNESS)
        self._rough, self._bouncy = [friction] * len(self.names), [elasticity] * len(self.names)
        self._set_materials()

    def to_xml(self, name: str) -> str:
        """Return the model as MJCF text."""
        self.spec.modelname = name
        return self.spec.to_xml()

    def _number_of(self, name: str) -> int:
        """Return MuJoCo's number of the body called `name`."""
        return int(self.model.geom_bodyid[self._geoms_of[self.names.index(name)][0]])

    # ---- the model ------------------------------------------------------------------------------------------------

    def _spec(self, masses: np.ndarray, sleeping: bool) -> Any:
        spec = mujoco.MjSpec()
        spec.option.timestep = self._step
        spec.option.gravity = self.matter.gravity * (self.units.time**2 / self.units.length)
        # Elliptic cones: friction does not depend on the axes that the engine happens to choose.
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.iterations = 50
        # A divergence must be seen, and not be started again from the beginning in silence.
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        if sleeping:
            spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
            spec.option.sleep_tolerance = SLEEPING
        for body, mass in zip(self.matter.bodies, masses, strict=True):
            pose = body.pose
            if body.kind == "plane" and not plane_is_below(self.matter, body):
                pose = body.pose @ rotation_x(np.pi)
            place: dict[str, Any] = {"pos": pose[:3, 3] / self.units.length, "quat": quaternion(pose)}
            holder = spec.worldbody
            if body.moves:
                holder = holder.add_body(name=f"{body.name}_body" if body.name == "world" else body.name, **place)
                holder.add_freejoint()
                place = {}
            pieces = body._replace(mass=mass).pieces()
            self._geom_names.append([body.name, *(f"{body.name}/{k}" for k in range(1, len(pieces)))])
            for name, piece in zip(self._geom_names[-1], pieces, strict=True):
                self._add_geom(spec, holder, piece._replace(name=name), place)
        self._add_pairs(spec)
        return spec

    def _add_geom(self, spec: Any, holder: Any, body: Body, place: dict[str, Any]) -> None:
        shape = shape_of(spec, body, self.units.length, self._stands(body))
        geom = holder.add_geom(name=body.name, **shape, **place)
        geom.friction = self._friction(OF_BODIES if body.friction is None else body.friction)[[0, 2, 3]]
        geom.condim = 6 if self._rolls(body) else 3
        geom.solref = self._spring(body.elasticity)
        geom.solimp = [self._hardness, self._hardness, self._long, 0.5, 2]
        if body.moves:
            geom.mass = body.weight_in_kg() / self.units.mass

    def _friction(self, sliding: float) -> np.ndarray:
        """Return MuJoCo's five coefficients: sliding twice, spinning, rolling twice."""
        rolling = ROLLING * self._long
        return np.array([sliding, sliding, SPINNING * self._long, rolling, rolling])

    def _spring(self, elasticity: float) -> list[float]:
        """Return MuJoCo's direct contact parameters, minus stiffness and minus damping, for a restitution."""
        if self._soft and elasticity == 0:
            frequency, damping = SLIDING_STIFFNESS / self._step, SLIDING_DAMPING
        else:
            share = self._bouncing if elasticity > 0 else STIFFNESS
            frequency, step = share / self._step, self._step / self._slow
            damping = bounce_damping(elasticity, share / step, step)
        return [-(frequency**2), -2.0 * damping * frequency]

    def _rolls(self, body: Body) -> bool:
        return body.kind == "sphere" or (body.kind == "cylinder" and not self._stands(body))

    def _stands(self, cylinder: Body) -> bool:
        """Return whether a cylinder is upright rather than lying on its side."""
        return abs(float(cylinder.pose[:3, 2] @ self.matter.up)) > 0.7

    def _add_pairs(self, spec: Any) -> None:
        """Give pairs of bodies contacts of their own: all of them, or those that are within reach of each other."""
        bodies = self.matter.bodies
        alike = len({body.friction for body in bodies}) == 1 and not any(body.elasticity for body in bodies)
        flat = np.array([body.kind == "plane" for body in bodies], dtype=bool)
        moves = np.array([body.moves for body in bodies], dtype=bool)
        first, second = np.triu_indices(len(bodies), 1)
        wanted = moves[first] | moves[second]
        if len(bodies) > MOST_PAIRED and alike:
            reach = np.array([body.reach() for body in bodies])
            centre = np.array([body.pose[:3, 3] for body in bodies])
            apart = np.linalg.norm(centre[first] - centre[second], axis=1) - reach[first] - reach[second]
            joined = {tuple(sorted(map(self.names.index, pair))) for pair in self.matter.supports}
            known = np.array([pair in joined for pair in zip(first.tolist(), second.tolist(), strict=True)], dtype=bool)
            wanted &= (apart <= WITHIN_REACH * self.length) | known | flat[first] | flat[second]
        rolls = [self._rolls(body) for body in bodies]
        for i, j in zip(first[wanted], second[wanted], strict=True):
            for one, other in product(self._geom_names[i], self._geom_names[j]):
                pair = spec.add_pair(geomname1=one, geomname2=other)
                # resistance to rolling shares the friction cone with that to sliding: what does not roll is without it
                pair.condim = 6 if rolls[i] or rolls[j] else 3
                if self._slides:
                    pair.solreffriction = [-1.0, -GRIP / self._slow]

    def _set_materials(self) -> None:
        """Write friction and elasticity of the bodies into the contacts of all pairs."""
        first, second = (self._index_of_geom[geoms] for geoms in (self.model.pair_geom1, self.model.pair_geom2))
        rough = np.array([np.nan if value is None else value for value in self._rough], dtype=float)
        self.model.pair_friction[:] = self._friction(0.0)
        self.model.pair_friction[:, :2] = pair_frictions(rough[first], rough[second])[:, None]
        springs = {value: self._spring(value) for value in set(self._bouncy)}
        for k, (i, j) in enumerate(zip(first, second, strict=True)):
            self.model.pair_solref[k] = springs[max(self._bouncy[i], self._bouncy[j])]
        bouncy = np.array(self._bouncy) > 0
        self._yields = self._soft & ~bouncy[first] & ~bouncy[second]  # (pairs,) that slide and do not bounce

    def _set_impedance(self) -> None:
        """Make contacts of light bodies among heavy ones as much harder as they may have to bear."""
        owner = self.model.geom_bodyid
        mass = np.where(owner == 0, np.inf, self.model.body_mass[owner])
        lighter = np.minimum(mass[self.model.pair_geom1], mass[self.model.pair_geom2])
        heaviest = float(self.model.body_mass.max())
        soft = np.where(self._yields, 1 - SLIDING, 1 - self._hardness)
        softness = np.clip(soft * MOST_BORNE * lighter / heaviest, LEAST_SOFTNESS, soft)
        across = SLIDING_ACROSS if self._yields.any() else self._across
        self.model.opt.impratio = across if softness.min(initial=1.0) > SOFT_ENOUGH else 1.0
        self.model.pair_solimp[:] = [0.0, 0.0, self._long, 0.5, 2]
        self.model.pair_solimp[:, :2] = 1 - softness[:, None]
        self.model.opt.tolerance = TOLERANCE * float(mass.min(initial=heaviest)) / (heaviest or 1.0)

    def _regrip(self) -> None:
        """Set the rate at which each pair stops sliding by how fast it slides; see GRIP."""
        model, data = self.model, self.data
        centre, speed, spin = data.xpos, np.zeros((model.nbody, 3)), np.zeros((model.nbody, 3))
        free = self._moving_ids
        velocity = data.qvel.reshape(-1, 6)
        speed[free] = velocity[:, :3]
        spin[free] = np.einsum("nij,nj->ni", data.xmat[free].reshape(-1, 3, 3), velocity[:, 3:])
        owner = model.geom_bodyid
        first, second = owner[model.pair_geom1], owner[model.pair_geom2]
        slip = np.linalg.norm(speed[second] - speed[first], axis=1)
        count = data.ncon
        if count:
            geoms, place = data.contact.geom[:count], data.contact.pos[:count]
            normal = data.contact.frame[:count, :3]
            at = [speed[b] + np.cross(spin[b], place - centre[b]) for b in (owner[geoms[:, 0]], owner[geoms[:, 1]])]
            along = at[1] - at[0]
            along -= np.sum(along * normal, axis=1, keepdims=True) * normal
            pair = self._pair_of[geoms[:, 0], geoms[:, 1]]
            shown = pair >= 0
            times = np.bincount(pair[shown], minlength=len(slip))
            total = np.bincount(pair[shown], np.linalg.norm(along[shown], axis=1), minlength=len(slip))
            slip = np.where(times > 0, total / np.maximum(times, 1), slip)
        held = GRIPPED * model.pair_friction[:, 0] * np.linalg.norm(model.opt.gravity)
        rate = np.minimum(held / np.maximum(slip, 1e-9), MOST_GRIP / self._slow)
        model.pair_solreffriction[self._yields, 1] = -rate[self._yields]

    def _rest_as_they_are(self) -> None:
        """Let each pair that touches by the graph, or overlaps, rest at its present distance."""
        joined = {frozenset(pair) for pair in self.matter.supports}
        widest = widest_gap(self.length) / self.units.length
        self.model.pair_margin[:] = 0.0
        centre, reach = self.data.geom_xpos, self.model.geom_rbound
        flat = self.model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)
        for k, (a, b) in enumerate(zip(self.model.pair_geom1, self.model.pair_geom2, strict=True)):
            if not (flat[a] or flat[b]):
                apart = centre[a] - centre[b]
                if apart @ apart > (reach[a] + reach[b] + widest) ** 2:
                    continue
            names = frozenset(self.names[self._index_of_geom[geom]] for geom in (a, b))
            gap = mujoco.mj_geomDistance(self.model, self.data, int(a), int(b), 2 * widest, None)
            if gap <= (widest if names in joined else TOUCHING * self._long):
                softness = self._yields[k] * (1 / float(self.model.pair_solimp[k, 0]) - 1)
                self.model.pair_margin[k] = gap + max(ENGAGED_SLIDING * softness, ENGAGED) * self._long

    def _start(self) -> None:
        """Set the speeds at the start and compute forces."""
        self._gripping = 0
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        for k, number in enumerate(self._moving_ids):
            body = self.matter.bodies[self.moving[k]]
            straight = np.array(body.velocity) * (self.units.time / self.units.length)
            turn = np.asarray(body.angular_velocity, float) * self.units.time
            # MuJoCo's speed is that of the body's origin, which for a mesh is not its centre of mass
            arm = self.data.xpos[number] - self.data.xipos[number]
            self.data.qvel[6 * k : 6 * k + 3] = straight + np.cross(turn, arm)
            self.data.qvel[6 * k + 3 : 6 * k + 6] = self.data.xmat[number].reshape(3, 3).T @ turn
        mujoco.mj_forward(self.model, self.data)


def prism(size: np.ndarray) -> np.ndarray:
    """Return the corners (2 * PRISM_SIDES, 3) of the prism that stands for an upright cylinder."""
    angle = 2 * np.pi * np.arange(PRISM_SIDES) / PRISM_SIDES
    ring = np.column_stack([0.5 * np.cos(angle), 0.5 * np.sin(angle)])
    return np.vstack([np.column_stack([ring, np.full(PRISM_SIDES, z)]) for z in (-0.5, 0.5)]) * size


def shape_of(spec: Any, body: Body, unit: float, upright: bool) -> dict[str, Any]:
    """Return the arguments of `add_geom` for a body's shape; a mesh is added to the model first.

    unit : the engine's length in metres. upright : whether a cylinder stands on its end.
    """
    half = 0.5 * np.asarray(body.size) / unit
    if body.kind == "plane":
        return {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [0, 0, 0.01]}
    if body.kind == "sphere":
        return {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [half[0], 0, 0]}
    if body.kind == "cylinder" and not upright:
        return {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "size": [half[0], half[2], 0]}
    if body.kind in ("cylinder", "mesh"):
        mesh = spec.add_mesh(name=f"{body.name}_mesh")
        vertices = body.vertices if body.kind == "mesh" else prism(body.size)
        mesh.uservert = (np.asarray(vertices, float) / unit).ravel().tolist()
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        return {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": mesh.name}
    return {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": half}
