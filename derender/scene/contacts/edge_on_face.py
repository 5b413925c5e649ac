"""A box that stands on one of its edges."""

import math

from derender.scene.contacts.base import contacts
from derender.scene.contacts.side_on_face import TILT, Line
from derender.scene.parameter import Parameter

LEAN = Parameter("lean", "rad", 0.0, math.pi / 2, math.pi / 4)


@contacts.register("edge-on-face")
class EdgeOnFace(Line):
    """A box's edge touches a flat face: theta, u, v (on a plane x, y) and lean.

    Of the two faces that meet in the edge, the one on the next axis after the edge's (cyclic) lies flush at lean 0,
    the other one at pi/2. Slack: gap, tilt (one end of the edge lifted).
    """

    compiled_code = 4
    child_features = "edge_names"

    def angles(self):
        return TILT, LEAN
