"""Whether what an object rests on could carry it alone, were there no friction."""

import numpy as np

from derender.scene.graph import SceneGraph


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
