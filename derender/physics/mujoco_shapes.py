"""The shapes of bodies as MuJoCo has them."""

from typing import Any

import mujoco
import numpy as np

from derender.physics.bodies import Body

# MuJoCo now and then reports a cylinder that stands exactly flat on a plane as sunk in by its radius (the direction
# to its deepest point is then a difference of equal numbers), and throws it into the air. Upright ones are prisms.
PRISM_SIDES = 32


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
