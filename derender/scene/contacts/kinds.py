"""The contact types: a free pose under a frame (the paper's `6dof`), and those on a flat face.

On a face another face is flush with it, a sphere's point, a cylinder's side, a box's edge or corner touches it.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.registry import Parameter
from derender.scene.contacts.base import ContactType, Inverse, SurfaceContact, contacts
from derender.scene.pose import (
    from_quaternion,
    from_rotation_vector,
    quaternion,
    rotation_vector,
    rotation_x,
    rotation_y,
    rotation_z,
)
from derender.scene.shapes.box import signs_of

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

    def choices(self, parent: Any, child: Any) -> list[tuple[str | None, str | None]]:
        return [(None, None)] if "frame" in (parent.name, child.name) else []

    def parameters(
        self, parent: Any = None, child: Any = None, parent_face: str | None = None, child_face: str | None = None
    ) -> tuple[Parameter, ...]:
        return POSITION + ROTATION

    def relative_pose(
        self,
        values: Mapping[str, float],
        parent: Any = None,
        child: Any = None,
        parent_face: str | None = None,
        child_face: str | None = None,
    ) -> np.ndarray:
        position = [values.get(p.name, p.default) for p in POSITION]
        return from_quaternion([values.get(p.name, p.default) for p in ROTATION], position)

    def invert(
        self,
        relative: np.ndarray,
        parent: Any = None,
        child: Any = None,
        parent_face: str | None = None,
        child_face: str | None = None,
    ) -> Inverse:
        numbers = np.concatenate([relative[:3, 3], quaternion(relative)])
        return Inverse({p.name: float(n) for p, n in zip(POSITION + ROTATION, numbers, strict=True)}, {}, 0.0, 0.0)

    def check(
        self,
        values: Any,
        parent: Any,
        child: Any,
        parent_face: str | None = None,
        child_face: str | None = None,
        where: Any = None,
    ) -> None:
        super().check(values, parent, child, parent_face, child_face, where)
        if not math.hypot(*(values.get(p.name, p.default) for p in ROTATION)) > 0.0:
            raise DerenderError("the quaternion of the 6dof contact is zero", where, "give it a length above zero")


TILTS = tuple(Parameter(name, "rad", -math.pi, math.pi, 0.0, slack=True) for name in ("tilt_x", "tilt_y"))


class Tilted(SurfaceContact):
    """A contact whose slack is a tilt: a rotation vector (tilt_x, tilt_y, 0) in the parent's face.

    Rz(theta) . R(tilt_x, tilt_y) is the swing-twist form of a rotation: every one has it, but for half turns it is
    unique. So a pose is always reproduced, and to a pose that is nearly flush belongs the theta that one would measure.
    """

    def angles(self) -> Any:
        return TILTS

    def turn(self, first: Any, second: Any, child_face: Any) -> np.ndarray:
        return from_rotation_vector((first, second, 0.0))

    def untwist(self, rotation: np.ndarray, child_face: Any) -> tuple[float, float, float]:
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


@contacts.register("point-on-face")
class PointOnFace(Tilted):
    """A sphere touches a flat face in one point: u, v (on a plane x, y). Its rotation shows nothing and is slack."""

    compiled_code = 2
    child_features = "point_names"


TILT = Parameter("tilt", "rad", -math.pi / 2, math.pi / 2, 0.0, slack=True)
ROLL = Parameter("roll", "rad", -math.pi, math.pi, 0.0, slack=True)


class Line(SurfaceContact):
    """A contact along the child feature's x axis: it lifts off by `tilt`, and turns about itself by a second angle.

    Rz(theta) . Ry(tilt) . Rx(-second) are the Euler angles of a rotation, unique but where the line stands upright.
    """

    def turn(self, first: Any, second: Any, child_face: Any) -> np.ndarray:
        return rotation_y(first) @ rotation_x(-second)

    def untwist(self, rotation: np.ndarray, child_face: Any) -> tuple[float, float, float]:
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

    def angles(self) -> tuple[Parameter, Parameter]:
        return TILT, ROLL


LEAN = Parameter("lean", "rad", 0.0, math.pi / 2, math.pi / 4)


@contacts.register("edge-on-face")
class EdgeOnFace(Line):
    """A box's edge touches a flat face: theta, u, v (on a plane x, y) and lean.

    Of the two faces that meet in the edge, the one on the next axis after the edge's (cyclic) lies flush at lean 0,
    the other one at pi/2. Slack: gap, tilt (one end of the edge lifted).
    """

    compiled_code = 4
    child_features = "edge_names"

    def angles(self) -> tuple[Parameter, Parameter]:
        return TILT, LEAN


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

    def angles(self) -> tuple[Parameter, Parameter]:
        return AZIMUTH, ELEVATION

    def turn(self, first: Any, second: Any, child_face: Any) -> np.ndarray:
        x, y, z = signs_of(child_face)
        return rotation_y(math.pi / 2 - z * second) @ rotation_z(math.atan2(y * math.sin(first), x * math.cos(first)))

    def untwist(self, rotation: np.ndarray, child_face: Any) -> tuple[float, float, float]:
        x, y, z = signs_of(child_face)
        beta = math.atan2(math.hypot(rotation[0, 2], rotation[1, 2]), rotation[2, 2])
        alpha = math.atan2(rotation[2, 1], -rotation[2, 0])
        azimuth = math.atan2(y * math.sin(alpha), x * math.cos(alpha))
        theta = math.atan2(rotation[1, 2], rotation[0, 2])
        clipped = np.clip((azimuth, z * (math.pi / 2 - beta)), 0.0, math.pi / 2)
        return theta, float(clipped[0]), float(clipped[1])
