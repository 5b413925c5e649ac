"""A cylinder that lies on a flat face."""

import math

import numpy as np

from derender.scene.contacts.base import SurfaceContact, contacts
from derender.scene.parameter import Parameter
from derender.scene.pose import rotation_x, rotation_y

TILT = Parameter("tilt", "rad", -math.pi / 2, math.pi / 2, 0.0, slack=True)
ROLL = Parameter("roll", "rad", -math.pi, math.pi, 0.0, slack=True)


class Line(SurfaceContact):
    """A contact along the child feature's x axis: it lifts off by `tilt`, and turns about itself by a second angle.

    Rz(theta) . Ry(tilt) . Rx(-second) are the Euler angles of a rotation, unique but where the line stands upright.
    """

    def turn(self, first, second, child_face):
        return rotation_y(first) @ rotation_x(-second)

    def untwist(self, rotation, child_face):
        theta = math.atan2(rotation[1, 0], rotation[0, 0])
        tilt = math.atan2(-rotation[2, 0], math.hypot(rotation[0, 0], rotation[1, 0]))
        second = -math.atan2(rotation[2, 1], rotation[2, 2])
        own = self.angles()[1]
        return theta, tilt, float(np.clip(second, own.lower, own.upper))


@contacts.register("side-on-face")
class SideOnFace(Line):
    """A cylinder's side touches a flat face in a line: theta of its axis, and u, v (on a plane x, y).

    Slack: gap, tilt (its end lifted), roll about its own axis.
    """

    compiled_code = 3
    child_features = "side_names"

    def angles(self):
        return TILT, ROLL
