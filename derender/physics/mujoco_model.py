"""A scene as a MuJoCo model in which nothing jumps: the contacts that the graph states are the engine's rest state.

Soft contacts push two bodies apart where they overlap and let them fall together where a gap is left. An inferred scene
has both, by millimetres: the slack of its contacts. Here every pair that the graph joins, and every pair that overlaps
at the start, gets a contact of its own whose rest distance (MuJoCo's `margin`, which may be negative) is the distance
they start with. All other pairs collide as usual.

Sizes and times scale: the unit of length is the smallest extent s among the bodies, that of time sqrt(s / g), so that a
tower of 4 cm blocks gets the verdict of the same tower of 40 cm blocks.
"""

from itertools import combinations
from typing import Any

import mujoco
import numpy as np

from derender.physics.bodies import STANDARD_GRAVITY, Body, Matter
from derender.scene.pose import inverse, quaternion, rotation_x

# In units of sqrt(s / g). Towers of ten blocks creep and fall over at three times this step (196 of 200 right) and not
# at this one (200 of 200); half of it changes no verdict.
TIMESTEP = 0.01
# Contacts are overdamped no faster than the integrator resolves: 2 steps is MuJoCo's limit, 5 leaves room.
CONTACT_STEPS = 5
# Nearly rigid: at rest a body sinks by (1 - d) / d of g times the contact's time squared, some 1e-5 of its size.
IMPEDANCE = (0.99, 0.999)
# Depth over which contacts harden, in units of s.
IMPEDANCE_WIDTH = 0.0025
# Contacts of the graph start engaged by this much (in units of s), about what the weight of two or three bodies presses
# them in, so that they bear from the first step.
ENGAGED = 2e-5
# A contact of the graph is open by no more than this (in units of s, or metres); beyond it the graph is wrong, and
# things fall.
WIDEST_GAP, WIDEST_GAP_METRES = 0.2, 0.01
# Sliding is the body's own; resistance to spinning and rolling in units of s: enough that a ball on a table stays.
SPINNING, ROLLING = 0.05, 0.01
# MuJoCo now and then reports a cylinder that stands exactly flat on a plane as sunk in by its radius (the direction
# to its deepest point is then a difference of equal numbers), and throw it into the air. Upright ones are prisms.
PRISM_SIDES = 32
# MuJoCo takes the mean of two bodies' springs, weighted; here the elastic one's counts.
ELASTIC_WEIGHT = 1e6
# Without bodies there is nothing to scale by.
DEFAULT_LENGTH = 0.1


def prism(size: np.ndarray) -> np.ndarray:
    """Return the corners (2 * PRISM_SIDES, 3) of the prism that stands for an upright cylinder."""
    angle = 2 * np.pi * np.arange(PRISM_SIDES) / PRISM_SIDES
    ring = np.column_stack([0.5 * np.cos(angle), 0.5 * np.sin(angle)])
    return np.vstack([np.column_stack([ring, np.full(PRISM_SIDES, z)]) for z in (-0.5, 0.5)]) * size


class World:
    """A compiled model of a scene and its state.

    Parameters
    ----------
    matter : bodies, gravity and who rests on whom.
    keep_contacts : whether the distances at the start are the rest distances (see the module); without it the bodies
        are as they are, for measuring gaps.

    Attributes
    ----------
    names : of the bodies, in the order of all arrays.
    model, data : MuJoCo's.
    length : the smallest extent, the unit of length, metres.
    """

    def __init__(self, matter: Matter, keep_contacts: bool = True) -> None:
        self.matter = matter
        self.names = [body.name for body in matter.bodies]
        extents = [float(np.min(body.size)) for body in matter.bodies if body.kind != "plane"]
        self.length = min(extents, default=DEFAULT_LENGTH)
        spec = self._spec()
        self.spec = spec
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, self.data)
        if keep_contacts:
            self._add_resting_pairs(spec)
            self.model = spec.compile()
            self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)

    @property
    def timestep(self) -> float:
        """Seconds of one step."""
        return float(self.model.opt.timestep)

    def gap(self, a: str, b: str, limit: float = 1.0) -> float:
        """Return the signed distance of two bodies in metres (negative: how deep they overlap), at most `limit`."""
        first, second = (mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_GEOM, name) for name in (a, b))
        if all(self.matter.bodies[self.names.index(name)].kind == "plane" for name in (a, b)):
            return limit
        return float(mujoco.mj_geomDistance(self.model, self.data, first, second, limit, None))

    def poses(self) -> np.ndarray:
        """Return where the bodies are now, (N, 4, 4) float64, body to the frame of the scene."""
        poses = np.tile(np.eye(4), (len(self.names), 1, 1))
        for index, body in enumerate(self.matter.bodies):
            if self._is_fixed(body):
                poses[index] = body.pose
            else:
                number = self._body_ids[index]
                poses[index, :3, :3] = self.data.xmat[number].reshape(3, 3)
                poses[index, :3, 3] = self.data.xpos[number]
        return poses

    def step(self, count: int = 1) -> None:
        """Advance by `count` steps, and bring the poses up to date."""
        mujoco.mj_step(self.model, self.data, count)
        mujoco.mj_kinematics(self.model, self.data)

    def speed(self) -> float:
        """Return the greatest speed of a body's centre, m / s."""
        moving = self.data.qvel.reshape(-1, 6)
        return float(np.linalg.norm(moving[:, :3], axis=1).max(initial=0.0))

    def acceleration(self) -> float:
        """Return the greatest acceleration of a body's centre, m / s^2."""
        moving = self.data.qacc.reshape(-1, 6)
        return float(np.linalg.norm(moving[:, :3], axis=1).max(initial=0.0))

    def to_xml(self, name: str) -> str:
        """Return the model as MJCF text, in the frame of the scene."""
        self.spec.modelname = name
        return self.spec.to_xml()

    def _is_fixed(self, body: Body) -> bool:
        return body.fixed or body.kind == "plane"

    def _spec(self) -> Any:
        spec = mujoco.MjSpec()
        gravity = float(np.linalg.norm(self.matter.gravity)) or STANDARD_GRAVITY
        spec.option.timestep = TIMESTEP * np.sqrt(self.length / gravity)
        spec.option.gravity = self.matter.gravity
        # Elliptic cones: friction does not depend on the axes that the engine happens to choose.
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.iterations = 50
        self._body_ids: dict[int, int] = {}
        number = 0
        for index, body in enumerate(self.matter.bodies):
            pose = self._upright(body) if body.kind == "plane" else body.pose
            if self._is_fixed(body):
                holder = spec.worldbody
                place: dict[str, Any] = {"pos": pose[:3, 3], "quat": quaternion(pose)}
            else:
                number += 1
                self._body_ids[index] = number
                holder = spec.worldbody.add_body(
                    name=f"{body.name}_body" if body.name == "world" else body.name,
                    pos=pose[:3, 3],
                    quat=quaternion(pose),
                )
                holder.add_freejoint()
                place = {}
            self._add_geom(spec, holder, body, place)
        return spec

    def _add_geom(self, spec: Any, holder: Any, body: Body, place: dict[str, Any]) -> None:
        half = 0.5 * np.asarray(body.size)
        if body.kind == "plane":
            shape = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [0, 0, 0.01]}
        elif body.kind == "sphere":
            shape = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [half[0], 0, 0]}
        elif body.kind == "cylinder" and not self._stands(body):
            shape = {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "size": [half[0], half[2], 0]}
        elif body.kind in ("cylinder", "mesh"):
            mesh = spec.add_mesh(name=f"{body.name}_mesh")
            vertices = body.vertices if body.kind == "mesh" else prism(body.size)
            mesh.uservert = np.asarray(vertices, float).ravel().tolist()
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            shape = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": mesh.name}
        else:
            shape = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": half}
        geom = holder.add_geom(name=body.name, **shape, **place)
        geom.friction = [body.friction, SPINNING * self.length, ROLLING * self.length]
        geom.condim = 6
        geom.solref = self._spring(spec, body.elasticity)
        if body.elasticity > 0:
            geom.solmix = ELASTIC_WEIGHT
        geom.solimp = [*IMPEDANCE, IMPEDANCE_WIDTH * self.length, 0.5, 2]
        if body.mass is not None:
            geom.mass = body.mass
        else:
            geom.density = body.density

    def _spring(self, spec: Any, elasticity: float) -> list[float]:
        """Return MuJoCo's time constant (seconds) and damping ratio of a contact.

        A spring with damping ratio z gives back exp(-pi z / sqrt(1 - z^2)) of the speed; since a contact cannot pull, a
        little more where that is little: 0.53 for 0.5, 0.36 for 0.3. One that bounces is as stiff as one that does
        not: its time constant is longer by 1 / z.
        """
        rest = CONTACT_STEPS * spec.option.timestep
        if elasticity <= 0:
            return [rest, 1.0]
        damping = float(-np.log(elasticity) / np.hypot(np.pi, np.log(elasticity)))
        return [rest / damping, damping]

    def _stands(self, cylinder: Body) -> bool:
        """Return whether a cylinder is upright rather than lying on its side."""
        return abs(float(cylinder.pose[:3, 2] @ self.matter.gravity)) > 0.7 * float(np.linalg.norm(self.matter.gravity))

    def _add_resting_pairs(self, spec: Any) -> None:
        """Give each pair that touches by the graph, or overlaps, a contact whose rest distance is the present one."""
        joined = {frozenset(pair) for pair in self.matter.supports}
        for a, b in combinations(self.matter.bodies, 2):
            if self._is_fixed(a) and self._is_fixed(b):
                continue
            by_graph = frozenset((a.name, b.name)) in joined
            gap = self.gap(a.name, b.name)
            if gap > (self._widest_gap() if by_graph else 0.0):
                continue
            pair = spec.add_pair(geomname1=a.name, geomname2=b.name)
            sliding, rolling = max(a.friction, b.friction), ROLLING * self.length
            pair.friction = [sliding, sliding, SPINNING * self.length, rolling, rolling]
            pair.condim = 6
            pair.solref = self._spring(spec, max(a.elasticity, b.elasticity))
            pair.solimp = [*IMPEDANCE, IMPEDANCE_WIDTH * self.length, 0.5, 2]
            pair.margin = gap + (ENGAGED * self.length if by_graph else 0.0)

    def _widest_gap(self) -> float:
        return max(WIDEST_GAP * self.length, WIDEST_GAP_METRES)

    def _upright(self, plane: Body) -> np.ndarray:
        """Return the plane's pose with its normal to the side of what rests on it (MuJoCo's planes have one side)."""
        others = [body for body in self.matter.bodies if body.kind != "plane"]
        children = {child for child, parent in self.matter.supports if parent == plane.name}
        seen = [body for body in others if body.name in children] or others
        heights = [float((inverse(plane.pose) @ body.pose)[2, 3]) for body in seen]
        return plane.pose @ rotation_x(np.pi) if heights and np.mean(heights) < 0 else plane.pose
