"""The solids of a scene as rigid bodies: all that the physics engine needs to know, of pairs that touch too."""

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from derender.scene.friction import OF_BODIES
from derender.scene.graph import STANDARD_GRAVITY, SceneGraph
from derender.scene.separation import separation_of
from derender.scene.solids import KINDS

SLAB = 0.02  # metres of the slab that bears for a plane that ends: thicker than what engines let sink in
KIND_NAMES = {code: name for name, code in KINDS.items()}

DENSITY = 500.0
"""kg / m^3, between a carton of groceries and a block of wood. Equal densities make verdicts independent of it."""
SHARE_OF_BOX = {"box": 1.0, "sphere": np.pi / 6, "cylinder": np.pi / 4, "plane": 0.0}  # of the volume
UPRIGHT = 0.9962
"""The level: within this cosine (5 degrees) a body stands upright."""


class Body(NamedTuple):
    """A rigid body."""

    name: str  # unique
    kind: str  # plane, box, sphere, cylinder or mesh (the convex hull of `vertices`, or of each of its `parts`)
    size: np.ndarray  # (3,) float64, full extents in metres (plane: zeros)
    pose: np.ndarray  # (4, 4) float64, body to the frame of the scene
    vertices: np.ndarray | None = None  # (V, 3) float64 in the body's axes, metres, of a mesh
    density: float = DENSITY  # kg / m^3, used where `mass` is None
    mass: float | None = None  # kg
    friction: float | None = None  # Coulomb coefficient, or None where nothing is said of it; see `pair_frictions`
    elasticity: float = 0.0  # speed after a bounce over that before it, 0 to .99: of two that meet the greater counts
    fixed: bool = False  # whether it stays where it is; planes always do
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m / s of its centre at the start, in the scene's frame
    angular_velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)  # rad / s at the start, in the scene's frame
    parts: tuple[np.ndarray, ...] = ()  # corners (C, 3) of each convex solid of a mesh; () where it counts as convex

    @property
    def moves(self) -> bool:
        """Whether forces can move it: planes and what is fixed stay."""
        return not self.fixed and self.kind != "plane"

    def pieces(self) -> tuple["Body", ...]:
        """Return the convex bodies that it is made of: itself, or one for each of its parts, their masses by volume."""
        if not self.parts:
            return (self,)
        whole = [self._replace(vertices=corners, parts=()) for corners in self.parts]
        volumes = np.array([each.volume() for each in whole])
        masses = self.weight_in_kg() * volumes / volumes.sum()
        return tuple(each._replace(mass=float(mass)) for each, mass in zip(whole, masses, strict=True))

    def volume(self) -> float:
        """Return its volume in cubic metres (a mesh: of its convex parts); 0 for a plane."""
        if self.kind == "mesh":
            return sum(_hull(corners)[0] for corners in self.parts or (self.vertices,))
        length, width, height = self.size.tolist()
        return SHARE_OF_BOX[self.kind] * float(length * width * height)

    def reach(self) -> float:
        """Return the radius in metres of a ball around its origin that holds it."""
        if self.kind == "mesh" and self.vertices is not None:
            return float(np.linalg.norm(self.vertices, axis=1).max())
        return 0.5 * float(np.linalg.norm(self.size))

    def weight_in_kg(self) -> float:
        """Return its mass: as given, or volume times density."""
        return float(self.mass) if self.mass is not None else self.density * self.volume()

    def gap(self, other: "Body") -> float:
        """Return how far two bodies are apart, metres; negative: how deep they overlap. A mesh counts as its box."""
        first, second = (
            (KINDS[body.kind], *(np.ascontiguousarray(each, float) for each in (body.pose, body.size)))
            for body in (self, other)
        )
        return float(separation_of(*first, *second))

    def centre_of_mass(self) -> np.ndarray:
        """Return (3,) where its mass is centred, in the frame of the scene: it is homogeneous."""
        if self.kind != "mesh":
            return self.pose[:3, 3]
        volumes, centres = zip(*(_hull(corners) for corners in self.parts or (self.vertices,)), strict=True)
        return self.pose[:3, :3] @ np.average(centres, axis=0, weights=volumes) + self.pose[:3, 3]


def _hull(vertices: np.ndarray | None) -> tuple[float, np.ndarray]:
    """Return the volume and the centroid (3,) of the convex hull of points (V, 3)."""
    from scipy.spatial import ConvexHull

    assert vertices is not None
    hull = ConvexHull(vertices)
    inside = vertices.mean(axis=0)
    corners = vertices[hull.simplices] - inside
    volumes = np.abs(np.linalg.det(corners)) / 6
    return float(volumes.sum()), inside + (volumes[:, None] * corners.sum(axis=1) / 4).sum(axis=0) / volumes.sum()


class Matter(NamedTuple):
    """What physics knows of a scene."""

    bodies: tuple[Body, ...]  # with extent, and planes, in the order of the scene's vertices
    gravity: np.ndarray  # (3,) float64, m / s^2 in the frame of the scene
    supports: tuple[tuple[str, str], ...]  # pairs (child, parent) of the bodies that the graph says are in contact

    @property
    def up(self) -> np.ndarray:
        """(3,) unit vector against gravity; zeros where there is none."""
        return -self.gravity / (math.hypot(*self.gravity) or 1.0)

    @property
    def strength(self) -> float:
        """Of gravity, m / s^2, the standard one where there is none: forces and times are judged by it."""
        return math.hypot(*self.gravity) or STANDARD_GRAVITY

    @property
    def unit(self) -> float:
        """The smallest extent among the bodies, metres: contacts are near or far in terms of it."""
        return min((min(body.size.tolist()) for body in self.bodies if body.kind != "plane"), default=0.1)

    @property
    def thrown(self) -> bool:
        """Whether a body has a speed at the start."""
        return any(np.any(body.velocity) or np.any(body.angular_velocity) for body in self.bodies if body.moves)

    @property
    def period(self) -> float:
        """Seconds of the order in which a body of that extent falls by it."""
        return float(np.sqrt(self.unit / self.strength))


def leans(matter: Matter) -> bool:
    """Return whether a floor or a body's faces are off the level, so that friction decides whether it stays."""
    if not np.any(matter.gravity):
        return False
    for body in matter.bodies:
        upright = np.abs(matter.up @ body.pose[:3, :3])
        if body.kind != "sphere" and (upright[2] if body.kind == "plane" else upright.max()) < UPRIGHT:
            return True
    return False


def matter_of_graph(graph: SceneGraph, rng: np.random.Generator | None = None) -> Matter:
    """Return the bodies of a scene graph, in the camera's frame.

    A vertex's options `mass`, `density`, `friction`, `elasticity`, `fixed`, `velocity` and `angular_velocity` (both in
    the root's axes) are taken over.

    rng : draws what is a distribution; without it the means are taken.
    """
    from derender.scene.priors.reading import PHYSICAL, drawn

    solids = graph.solids()
    bodies = []
    for index, name in enumerate(graph.solid_names):
        options = drawn(graph.vertex(name).options, rng)
        for key in ("velocity", "angular_velocity"):
            if key in options:
                options[key] = tuple(float(x) for x in np.asarray(graph.root_pose)[:3, :3] @ options[key])
        kind = KIND_NAMES.get(int(solids.kind[index]), "mesh")
        vertices = None
        if kind == "mesh":
            points = solids.meshes[int(solids.mesh[index])][0]
            vertices = points * (solids.size[index] / np.ptp(points, axis=0))
        given = {key: options[key] for key in PHYSICAL if key in options}
        size, pose, own = np.array(solids.size[index]), np.array(solids.pose[index]), graph.body(name)
        parts = own.shape.convex_parts(own.psi, own.options)
        if kind == "box" and not own.shape.bounded:  # a plane that ends bears as a slab under it would
            size[2] = SLAB
            pose[:3, 3] -= 0.5 * SLAB * pose[:3, 2]
            given["fixed"] = True
        bodies.append(Body(name, kind, size, pose, vertices, **given, parts=parts))
    names = {body.name for body in bodies}
    supports = [
        (vertex.name, parent)
        for vertex in graph.vertices
        for parent in (vertex.parent, *vertex.supports)
        if vertex.name in names and parent in names and vertex.contact.type != "6dof"
    ]
    return Matter(tuple(bodies), graph.pull(), tuple(supports))


def matter_of_scene(scene: Mapping[str, Any]) -> Matter:
    """Return the bodies of a scene as `derender show --json` prints it."""
    bodies = []
    for item in scene["objects"]:
        if item["type"] == "frame":
            continue
        kind = {"cube": "box"}.get(item["type"], item["type"])
        vertices = item.get("vertices")
        if kind not in ("plane", "box", "sphere", "cylinder", "mesh") or (kind == "mesh" and vertices is None):
            kind = "box"
        size = np.zeros(3) if item.get("size") is None else np.asarray(item["size"], float)
        points = None if vertices is None else np.asarray(vertices, float)
        bodies.append(Body(item["name"], kind, size, np.asarray(item["pose"], float), points))
    names = {body.name for body in bodies}
    supports = [
        (item["name"], parent)
        for item in scene["objects"]
        for parent in (item.get("parent"), *item.get("supports", ()))
        if item["name"] in names and parent in names
    ]
    down = np.asarray(scene["gravity"], float)
    return Matter(tuple(bodies), STANDARD_GRAVITY * down / np.linalg.norm(down), tuple(supports))


# Of the heaviest body's mass. A lighter one is taken for so heavy: it bears what stands on it all the same, and the
# engine's rounding does not throw it about.
LEAST_MASS = 1e-4
# The speed, in units of sqrt(s g), at which restitution is calibrated: of a fall from 4.5 times the smallest extent.
CALIBRATION_SPEED = 3.0
# Phases within a step at which a bounce may begin; the calibration is their mean.
PHASES = 8
# Of a bounce: one that has not left the surface after so many steps rests on it.
MOST_STEPS = 200
# Damping per step beyond which a contact would turn the speed round within one.
MOST_DAMPING_PER_STEP = 0.96

# Restitutions at which the damping of a contact is worked out.
BOUNCES = 64


def pair_frictions(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the Coulomb coefficients (P,) of pairs that touch: the geometric mean of what the two (P,) say.

    NaN is a body of which nothing is said: it takes the other's, so that a slippery block slips on a floor of which
    nothing is known; OF_BODIES where nothing is said of either.
    """
    mean = np.sqrt(first * second)
    mean = np.where(np.isnan(first), second, np.where(np.isnan(second), first, mean))
    return np.where(np.isnan(mean), OF_BODIES, mean)


def clamped_masses(bodies: Sequence[Body]) -> np.ndarray:
    """Return the masses (N,) of bodies in kg, none below LEAST_MASS of the heaviest; 0 for what does not move."""
    masses = np.array([body.weight_in_kg() if body.moves else 0.0 for body in bodies], dtype=float)
    moves = np.array([body.moves for body in bodies], dtype=bool)
    return np.where(moves, np.maximum(masses, LEAST_MASS * masses.max(initial=0.0)), 0.0)


def restitution_of(damping: np.ndarray | float, frequency: float, step: float) -> np.ndarray:
    """Return which shares (...) of its speed contacts with damping ratios (...) give back, as the engine steps them.

    The contact is a damped spring that cannot pull, under gravity, stepped by semi-implicit Euler; in units of the
    smallest extent s and sqrt(s / g). Mean over the phases within a step at which the bounce begins.
    """
    damping = np.asarray(damping, float)[..., None]
    speed = np.full((*damping.shape[:-1], PHASES), -CALIBRATION_SPEED)
    depth = speed * step * (np.arange(PHASES) + 0.5) / PHASES  # where the first step in contact begins
    for _ in range(MOST_STEPS):
        touching = depth < 0.0
        if not touching.any():
            break
        force = np.maximum(-frequency * (frequency * depth + 2.0 * damping * speed), 0.0)
        speed = np.where(touching, speed + step * (force - 1.0), speed)
        depth = np.where(touching, depth + step * speed, depth)
    return np.mean(np.where(depth >= 0.0, np.maximum(speed, 0.0), 0.0), axis=-1) / CALIBRATION_SPEED


@lru_cache(maxsize=64)
def bounce_table(frequency: float, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return restitutions, rising, and the damping ratios that give them, (BOUNCES,) each; see `restitution_of`.

    Inference asks for another restitution at each rollout: between these, interpolation errs by less than .001.
    """
    highest = 0.5 * MOST_DAMPING_PER_STEP / (frequency * step)
    damping = highest * np.linspace(1.0, 0.0, BOUNCES) ** 2
    restitution = np.maximum.accumulate(restitution_of(damping, frequency, step))
    return restitution, damping


def bounce_damping(elasticity: float, frequency: float, step: float) -> float:
    """Return the damping ratio of a contact that gives back `elasticity` of the speed; see `restitution_of`."""
    restitution, damping = bounce_table(frequency, step)
    if elasticity <= restitution[0]:
        return float(damping[0])
    return float(np.interp(elasticity, restitution, damping))
