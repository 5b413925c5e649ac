"""The free pose under a frame: the paper's `6dof`."""

import math

import numpy as np

from derender.errors import DerenderError
from derender.scene.contacts.base import ContactType, Inverse, contacts
from derender.scene.parameter import Parameter
from derender.scene.pose import from_quaternion, quaternion

POSITION = tuple(Parameter(name, "m", default=0.0) for name in "xyz")
ROTATION = tuple(Parameter(name, "", default=float(name == "qw")) for name in ("qw", "qx", "qy", "qz"))


@contacts.register("6dof")
class SixDof(ContactType):
    """Any pose relative to a frame: position x, y, z in metres and a quaternion qw, qx, qy, qz.

    The quaternion is normalised, so of its four numbers three are degrees of freedom; the stock measure is Lebesgue's
    on the position times Haar's on the rotation.
    """

    compiled_code = 0
    degrees_of_freedom = 6

    def choices(self, parent, child):
        return [(None, None)] if "frame" in (parent.name, child.name) else []

    def parameters(self, parent=None, child=None, parent_face=None, child_face=None):
        return POSITION + ROTATION

    def relative_pose(self, values, parent=None, child=None, parent_face=None, child_face=None):
        position = [values.get(p.name, p.default) for p in POSITION]
        return from_quaternion([values.get(p.name, p.default) for p in ROTATION], position)

    def invert(self, relative, parent=None, child=None, parent_face=None, child_face=None):
        numbers = np.concatenate([relative[:3, 3], quaternion(relative)])
        return Inverse({p.name: float(n) for p, n in zip(POSITION + ROTATION, numbers, strict=True)}, {}, 0.0, 0.0)

    def check(self, values, parent, child, parent_face=None, child_face=None, where=None):
        super().check(values, parent, child, parent_face, child_face, where)
        if not math.hypot(*(values.get(p.name, p.default) for p in ROTATION)) > 0.0:
            raise DerenderError("the quaternion of the 6dof contact is zero", where, "give it a length above zero")
