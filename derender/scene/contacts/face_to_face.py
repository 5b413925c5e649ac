"""Two flat faces flush with each other: Figure 2 for every pair of outlines."""

import math

from derender.scene.contacts.base import SurfaceContact, contacts
from derender.scene.parameter import Parameter
from derender.scene.pose import from_rotation_vector, quaternion, rotation_vector, rotation_z

TILTS = tuple(Parameter(name, "rad", -math.pi, math.pi, 0.0, slack=True) for name in ("tilt_x", "tilt_y"))


class Tilted(SurfaceContact):
    """A contact whose slack is a tilt: a rotation vector (tilt_x, tilt_y, 0) in the parent's face.

    Rz(theta) . R(tilt_x, tilt_y) is the swing-twist form of a rotation: every one has it, but for half turns it is
    unique. So a pose is always reproduced, and to a pose that is nearly flush belongs the theta that one would measure.
    """

    def angles(self):
        return TILTS

    def turn(self, first, second, child_face):
        return from_rotation_vector((first, second, 0.0))

    def untwist(self, rotation, child_face):
        w, _, _, z = quaternion(rotation)
        theta = 2.0 * math.atan2(z, w)
        tilt = rotation_vector(rotation_z(-theta)[:3, :3] @ rotation)
        return theta, float(tilt[0]), float(tilt[1])


@contacts.register("face-to-face")
class FaceToFace(Tilted):
    """The exterior sides of two flat faces touch and are flush: theta, and u, v (on a plane x, y).

    Slack: gap (metres between the faces), tilt_x and tilt_y (radians about the parent face's x and y).
    """

    compiled_code = 1
    child_features = "face_names"
