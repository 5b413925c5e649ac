"""How an object rests: whether one support carries it alone, and how far it is from resting on a second one."""

import math
from typing import NamedTuple

import numpy as np

from derender.scene.graph import SceneGraph
from derender.scene.pose import inverse
from derender.scene.vertex import nearest_contact


def balances(graph: SceneGraph, name: str, parent: str) -> bool:
    """Whether the solid's centre lies over the part of its parent's face that carries it.

    The centre of the face that rests is inside both outlines if and only if their pieces in common hold it, as both are
    convex and the centre is in the middle of its own.
    """
    poses = graph.poses()
    parent_face, size = graph.vertex(name).contact.parent_face, graph.body(parent).size()
    assert parent_face is not None and size is not None, "it rests on a face of a solid"
    face = graph.body(parent).face(parent_face)
    frame = poses[parent] @ face.frame
    down = graph.down()
    centre = poses[name][:3, 3]
    # along gravity onto the plane of the parent's face
    steps = (frame[:3, 3] - centre) @ frame[:3, 2] / max(float(-down @ frame[:3, 2]), 1e-6)
    local = np.linalg.inv(frame) @ np.append(centre - steps * down, 1.0)
    axis = "xyz".index(parent_face[1])
    half = 0.5 * np.array([size[(axis + 1) % 3], size[(axis + 2) % 3]])
    if graph.vertex(parent).shape == "cylinder":
        return bool(np.hypot(local[0], local[1]) < half[0])
    return bool(abs(local[0]) < half[0] and abs(local[1]) < half[1])


class SupportResidual(NamedTuple):
    """How far an object is from resting on a second support.

    Attributes
    ----------
    parent_face, child_face : the faces that would touch.
    gap : metres between them along the support's normal; negative where they interpenetrate.
    tilt : radians between them.
    outside : metres by which their outlines miss each other.
    """

    parent_face: str | None
    child_face: str | None
    gap: float
    tilt: float
    outside: float

    def distance(self, radius: float) -> float:
        """Return one length: gap, miss and the tilt's arc at `radius` metres, as a root of the sum of squares."""
        return float(np.sqrt(self.gap**2 + self.outside**2 + (radius * self.tilt) ** 2))


def support_residual(graph: SceneGraph, name: str, support: str) -> SupportResidual:
    """Return how far the vertex `name` is from resting on `support` with the feature that rests on its parent.

    The support's face is the one that looks most squarely at it. A vertex that floats takes its best pair of faces.
    """
    vertex = graph.vertex(name)
    poses = graph.poses()
    kind = vertex.contact.type if vertex.contact.type != "6dof" else "face-to-face"
    relative = inverse(poses[support]) @ poses[name]
    body, child = graph.body(support), vertex.body
    face = vertex.contact.child_face
    upright = None
    if face is not None and body.shape.face_names:
        down = relative[:3, :3] @ child.face(face).frame[:3, 2]
        upright = min(body.shape.face_names, key=lambda other: body.face(other).frame[:3, 2] @ down)
    contact, left = nearest_contact(relative, body, child, kind, upright, face)
    tilts = [value for key, value in left.slack.items() if key.startswith("tilt")]
    tilt = math.hypot(*tilts) + left.angle
    return SupportResidual(contact.parent_face, contact.child_face, left.slack.get("gap", 0.0), tilt, left.outside)
