"""The solids of a scene as rigid bodies: all that the physics engine needs to know."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from derender.scene import solids as kinds

if TYPE_CHECKING:
    from derender.scene.graph import SceneGraph

KIND_NAMES = {kinds.PLANE: "plane", kinds.BOX: "box", kinds.SPHERE: "sphere", kinds.CYLINDER: "cylinder"}

DENSITY = 500.0
"""kg / m^3, between a carton of groceries and a block of wood. Equal densities make verdicts independent of it."""
FRICTION = 0.8
"""Coulomb coefficient between two bodies: wood on wood and cardboard on wood lie at 0.4-0.8."""
STANDARD_GRAVITY = 9.81
MATERIAL = ("density", "mass", "friction", "elasticity", "fixed")


class Body(NamedTuple):
    """A rigid body.

    Attributes
    ----------
    name : unique.
    kind : plane, box, sphere, cylinder or mesh (the convex hull of `vertices`).
    size : (3,) float64, full extents in metres (plane: zeros).
    pose : (4, 4) float64, body to the frame of the scene.
    vertices : (V, 3) float64 in the body's axes, metres, for a mesh; else None.
    density : kg / m^3, used where `mass` is None.
    mass : kg, or None.
    friction : Coulomb coefficient; of two bodies that touch the greater counts (MuJoCo's rule).
    elasticity : coefficient of restitution, 0 to 0.99: speed after a bounce over that before it; of two bodies that
        meet the greater counts.
    fixed : whether it stays where it is. Planes always do.
    """

    name: str
    kind: str
    size: np.ndarray
    pose: np.ndarray
    vertices: np.ndarray | None = None
    density: float = DENSITY
    mass: float | None = None
    friction: float = FRICTION
    elasticity: float = 0.0
    fixed: bool = False


class Matter(NamedTuple):
    """What physics knows of a scene.

    Attributes
    ----------
    bodies : with extent, and planes, in the order of the scene's vertices.
    gravity : (3,) float64, m / s^2 in the frame of the scene.
    supports : pairs (child, parent) of the bodies that the graph says are in contact.
    """

    bodies: tuple[Body, ...]
    gravity: np.ndarray
    supports: tuple[tuple[str, str], ...]


def matter_of_graph(graph: "SceneGraph") -> Matter:
    """Return the bodies of a scene graph, in the camera's frame.

    A vertex's options `mass`, `density`, `friction`, `elasticity` and `fixed` are taken over.
    """
    solids = graph.solids()
    bodies = []
    for index, name in enumerate(graph.solid_names):
        options = graph.vertex(name).options
        kind = KIND_NAMES.get(int(solids.kind[index]), "mesh")
        vertices = None
        if kind == "mesh":
            points = solids.meshes[int(solids.mesh[index])][0]
            vertices = points * (solids.size[index] / np.ptp(points, axis=0))
        given = {key: options[key] for key in MATERIAL if key in options}
        bodies.append(Body(name, kind, np.array(solids.size[index]), np.array(solids.pose[index]), vertices, **given))
    names = {body.name for body in bodies}
    supports = [
        (vertex.name, parent)
        for vertex in graph.vertices
        for parent in (vertex.parent, *vertex.supports)
        if vertex.name in names and parent in names and vertex.contact.type != "6dof"
    ]
    return Matter(tuple(bodies), STANDARD_GRAVITY * graph.down(), tuple(supports))


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
