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


TILTS = (
    Parameter("tilt_x", "rad", -math.pi, math.pi, 0.0, slack=True),
    Parameter("tilt_y", "rad", -math.pi, math.pi, 0.0, slack=True),
)
TILT = Parameter("tilt", "rad", -math.pi / 2, math.pi / 2, 0.0, slack=True)
ROLL = Parameter("roll", "rad", -math.pi, math.pi, 0.0, slack=True)
LEAN = Parameter("lean", "rad", 0.0, math.pi / 2, math.pi / 4)
AZIMUTH = Parameter("azimuth", "rad", 0.0, math.pi / 2, math.pi / 4)
ELEVATION = Parameter("elevation", "rad", 0.0, math.pi / 2, math.asin(math.sqrt(1 / 3)))


@contacts.register("face-to-face")
class FaceToFace(SurfaceContact):
    """The exterior sides of two flat faces touch and are flush: theta, and u, v (on a plane x, y).

    Slack: gap (metres between the faces), tilt_x and tilt_y (radians about the parent face's x and y).
    """

    compiled_code = 1
    child_features = "face_names"
    angles = TILTS


@contacts.register("point-on-face")
class PointOnFace(SurfaceContact):
    """A sphere touches a flat face in one point: u, v (on a plane x, y). Its rotation shows nothing and is slack."""

    compiled_code = 2
    child_features = "point_names"
    angles = TILTS


@contacts.register("side-on-face")
class SideOnFace(SurfaceContact):
    """A cylinder's side touches a flat face in a line: theta of its axis, and u, v (on a plane x, y).

    Slack: gap, tilt (its end lifted), roll about its own axis.
    """

    compiled_code = 3
    child_features = "side_names"
    angles = (TILT, ROLL)


@contacts.register("edge-on-face")
class EdgeOnFace(SurfaceContact):
    """A box's edge touches a flat face: theta, u, v (on a plane x, y) and lean.

    Of the two faces that meet in the edge, the one on the next axis after the edge's (cyclic) lies flush at lean 0,
    the other one at pi/2. Slack: gap, tilt (one end of the edge lifted).
    """

    compiled_code = 4
    child_features = "edge_names"
    angles = (TILT, LEAN)


@contacts.register("corner-on-face")
class CornerOnFace(SurfaceContact):
    """A box's corner touches a flat face: theta, u, v (on a plane x, y), azimuth and elevation.

    The direction into the parent, in the child's axes, is (s_x cos e cos a, s_y cos e sin a, s_z sin e) with the
    corner's signs s: the whole octant, so the box always stays on its side of the face. The body's default diagonal
    points straight down for a cube. Slack: gap.
    """

    compiled_code = 5
    child_features = "corner_names"
    angles = (AZIMUTH, ELEVATION)
