"""Scenes of solids on a floor, as many tests want them."""

import numpy as np

from derender.scene.graph import Contact, SceneGraph, Vertex
from derender.scene.pose import rotation_x, translation


def face(**values):
    """Return the contact of a solid that stands on a top, where and turned as the numbers say."""
    return Contact("face-to-face", "+z", "-z", {"x": 0.0, "y": 0.0, "theta": 0.0, **values})


def cube(name="red", x=0.0, y=0.0, side=0.1, theta=0.0):
    """Return a cube on the floor."""
    return Vertex(name, "cube", {"side": side}, "floor", face(x=x, y=y, theta=theta))


def on_floor(*solids, elevation=90.0, distance=1.0, lower=0.0):
    """Return the scene of a floor, looked at from so many degrees above at so many metres, with solids on it.

    lower : metres by which its origin lies under the image's middle.
    """
    pose = translation(0.0, lower, distance) @ rotation_x(np.deg2rad(90.0 + elevation))
    return SceneGraph(pose, (Vertex("floor", "plane"), *solids))
