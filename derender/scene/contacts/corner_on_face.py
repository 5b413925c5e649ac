"""A box that stands on one of its corners."""

import math

import numpy as np

from derender.scene.contacts.base import SurfaceContact, contacts
from derender.scene.parameter import Parameter
from derender.scene.pose import rotation_y, rotation_z
from derender.scene.shapes.box import signs_of

AZIMUTH = Parameter("azimuth", "rad", 0.0, math.pi / 2, math.pi / 4)
ELEVATION = Parameter("elevation", "rad", 0.0, math.pi / 2, math.asin(math.sqrt(1 / 3)))


@contacts.register("corner-on-face")
class CornerOnFace(SurfaceContact):
    """A box's corner touches a flat face: theta, u, v (on a plane x, y), azimuth and elevation.

    The direction into the parent, in the child's axes, is (s_x cos e cos a, s_y cos e sin a, s_z sin e) with the
    corner's signs s: the whole octant, so the box always stays on its side of the face. The body's default diagonal
    points straight down for a cube. Slack: gap. Rz(theta) . Ry . Rz are Euler angles, not unique at e = pi/2.
    """

    compiled_code = 5
    child_features = "corner_names"

    def angles(self):
        return AZIMUTH, ELEVATION

    def turn(self, first, second, child_face):
        x, y, z = signs_of(child_face)
        return rotation_y(math.pi / 2 - z * second) @ rotation_z(math.atan2(y * math.sin(first), x * math.cos(first)))

    def untwist(self, rotation, child_face):
        x, y, z = signs_of(child_face)
        beta = math.atan2(math.hypot(rotation[0, 2], rotation[1, 2]), rotation[2, 2])
        alpha = math.atan2(rotation[2, 1], -rotation[2, 0])
        azimuth = math.atan2(y * math.sin(alpha), x * math.cos(alpha))
        theta = math.atan2(rotation[1, 2], rotation[0, 2])
        clipped = np.clip((azimuth, z * (math.pi / 2 - beta)), 0.0, math.pi / 2)
        return theta, float(clipped[0]), float(clipped[1])
