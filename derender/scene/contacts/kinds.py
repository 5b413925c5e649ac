"""What a contact offers, choices, parameters, the pose they give and the way back; and the types of contact.

There is a free pose under a frame (the paper's `6dof`). On a flat face another face is flush with it, a sphere's point,
a cylinder's side, a box's edge or corner touches it.
"""

import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np

from derender.compilation.cache import interpreted
from derender.errors import DerenderError
from derender.registry import Parameter, Registry, suggest
from derender.scene import polygon
from derender.scene.contacts import compiled
from derender.scene.contacts.compiled import FEATURE_CODES
from derender.scene.polygon import sides
from derender.scene.pose import from_axes, from_quaternion, inverse, quaternion, rotation_angle, translation
from derender.scene.shapes import Body, Shape

contacts: Registry["ContactType"] = Registry("contact", "derender.contacts")

# Turns a frame by pi about x: the child's outward normal meets the parent's head on.
FLIP = from_axes(((1, 0, 0), (0, -1, 0), (0, 0, -1)))
offset_from_uv, uv_from_offset = interpreted(polygon.offset_from_uv), interpreted(polygon.uv_from_offset)
rotation_by, chart_of = interpreted(compiled.rotation_by), interpreted(compiled.chart_of)


# The types by which something rests on a flat face, flatter ones first.
ON_A_FACE = ("face-to-face", "side-on-face", "point-on-face", "edge-on-face", "corner-on-face")


class Inverse(NamedTuple):
    """The contact nearest to a pose.

    slack : the slack parameters by name (gap, tilts, the angle of what is round) that reproduce the pose.
    angle : radians by which the rotation cannot be reproduced; 0 where the contact can take this rotation. With
        `outside` and `angle` 0 the pose is reproduced exactly by {**phi, **slack}.
    """

    phi: dict[str, float]  # the free parameters by name, within their ranges; theta in [0, 2 pi), see `fold`
    slack: dict[str, float]
    outside: float  # metres by which the two outlines miss each other; 0 where they touch
    angle: float

    @property
    def values(self) -> dict[str, float]:
        """All parameters, free ones and slack, by name."""
        return {**self.phi, **self.slack}

    @property
    def gap(self) -> float:
        """Metres between the two along the parent's normal; negative where they interpenetrate."""
        return self.slack.get("gap", 0.0)

    @property
    def tilt(self) -> float:
        """Radians by which the two are tilted against each other, as far as slack says it."""
        return math.hypot(*(value for name, value in self.slack.items() if name.startswith("tilt")))


class ContactType:
    """One contact type. Subclasses are registered as `@contacts.register("face-to-face")`; one instance serves all.

    `parent_face` and `child_face` are names of features; both are None for a contact without faces (`6dof`).
    `values` maps parameter names to numbers; what is missing has its default.
    """

    name: str = ""
    compiled_code: ClassVar[int | None] = None  # its number in contacts.compiled; None: only the readable form exists

    def choices(self, parent: Shape, child: Shape) -> list[tuple[str | None, str | None]]:
        """Return the finite set C_{s,t} of Eqs. 2-3: the pairs of features that can meet; empty if none can."""
        raise NotImplementedError

    def parameters(
        self, parent: Shape, child: Shape, parent_face: str | None, child_face: str | None
    ) -> tuple[Parameter, ...]:
        """Return the parameters Phi_c in the order of the compiled form, slack included."""
        raise NotImplementedError

    def relative_pose(
        self, values: Mapping[str, float], parent: Body, child: Body, parent_face: str | None, child_face: str | None
    ) -> np.ndarray:
        """Return the (4, 4) pose of the child in the parent's object axes: f_c of Eq. 1 without z_parent."""
        raise NotImplementedError

    def invert(
        self, relative: np.ndarray, parent: Body, child: Body, parent_face: str | None, child_face: str | None
    ) -> Inverse:
        """Return the contact of these two features that is nearest to the (4, 4) pose of child in parent."""
        raise NotImplementedError

    def default_choice(self, parent: Shape, child: Shape, where: object = None) -> tuple[str | None, str | None]:
        """Return the pair of features meant where a file names none: on top of the parent, bottom of the child."""
        choices = self.choices(parent, child)
        if not choices:
            raise DerenderError(
                f"a {child.name} cannot be in {self.name} contact with a {parent.name}",
                where,
                suggest(None, [other for other in contacts if contacts[other].choices(parent, child)] or ["6dof"]),
            )
        # sorted() is stable and True sorts last: the parent's +z first, then what has -z in its name.
        return min(choices, key=lambda pair: (pair[0] != "+z", "-z" not in str(pair[1])))


class SurfaceContact(ContactType):
    """A contact between the parent's flat face and a feature of the child: all but `6dof`.

    z_child = z_parent . F_parent . T(x, y, gap + lift) . Rz(theta) . turn . diag(1, -1, -1) . F_child^-1

    (x, y) is (u, v) of Figure 2 between bounded outlines. `turn` is what each type adds: a tilt, a lean; its charts are
    in `compiled`. Slots of every surface contact: theta, u or x, v or y, gap, and two angles of the type's own.
    """

    child_features: ClassVar[str] = "face_names"
    angles: ClassVar[tuple[Parameter, Parameter]]  # the type's own two

    def choices(self, parent: Shape, child: Shape) -> list[tuple[str | None, str | None]]:
        if not parent.bounded and not child.bounded:
            return []
        return [(a, b) for a in parent.face_names for b in getattr(child, self.child_features)]

    def rotation(self, theta: float, first: float, second: float, child_face: str) -> np.ndarray:
        """Return the (4, 4) rotation Rz(theta) . turn."""
        numbers = rotation_by(self.compiled_code, FEATURE_CODES[child_face], theta, first, second)
        return from_axes(np.reshape(numbers, (3, 3)).T)

    def parameters(self, parent: Any, child: Any, parent_face: Any, child_face: Any) -> tuple[Parameter, ...]:
        # A plane under a cube is as symmetric as the cube: the bounded one of the two decides (Eq. 3).
        order = child.face_order(child_face) if child.bounded else parent.face_order(parent_face)
        free = math.isfinite(order)
        period = math.tau / order if free else math.tau
        theta = Parameter("theta", "rad", 0.0, period, 0.0, period, slack=not free)
        if parent.bounded and child.bounded:
            offsets = (Parameter("u", "", 0.0, 1.0, 0.5), Parameter("v", "", 0.0, 1.0, 0.5))
        else:
            offsets = (Parameter("x", "m", default=0.0), Parameter("y", "m", default=0.0))
        return (theta, *offsets, Parameter("gap", "m", default=0.0, slack=True), *self.angles)

    def relative_pose(self, values, parent, child, parent_face, child_face):
        on, by = parent.face(parent_face), child.face(child_face)
        theta = values.get("theta", 0.0)
        if on.outline.bounded and by.outline.bounded:
            u, v = values.get("u", 0.5), values.get("v", 0.5)
            x, y = offset_from_uv(u, v, theta, *sides(on.outline, by.outline))
        else:
            x, y = values.get("x", 0.0), values.get("y", 0.0)
        first, second = (values.get(angle.name, angle.default) for angle in self.angles)
        return (
            on.frame
            @ translation(x, y, values.get("gap", 0.0) + by.lift)
            @ self.rotation(theta, first, second, child_face)
            @ FLIP
            @ inverse(by.frame)
        )

    def invert(self, relative: np.ndarray, parent: Any, child: Any, parent_face: Any, child_face: Any) -> Inverse:
        on, by = parent.face(parent_face), child.face(child_face)
        meeting = inverse(on.frame) @ relative @ by.frame @ FLIP
        theta, first, second = map(float, chart_of(self.compiled_code, FEATURE_CODES[child_face], meeting[:3, :3]))
        angle = rotation_angle(meeting, self.rotation(theta, first, second, child_face))
        x, y, height = (float(part) for part in meeting[:3, 3])
        outside = 0.0
        if on.outline.bounded and by.outline.bounded:
            x, y, outside = uv_from_offset(x, y, theta, *sides(on.outline, by.outline))
        parameters = self.parameters(parent.shape, child.shape, parent_face, child_face)
        phi, slack = {}, {}
        for parameter, value in zip(parameters, (theta, x, y, height - by.lift, first, second), strict=True):
            (slack if parameter.slack else phi)[parameter.name] = value
        return Inverse(phi, slack, outside, angle if angle > 1e-12 else 0.0)


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

    def parameters(self, *pair: Any, **features: Any) -> tuple[Parameter, ...]:
        return POSITION + ROTATION

    def relative_pose(self, values: Mapping[str, float], *pair: Any, **features: Any) -> np.ndarray:
        position = [values.get(p.name, p.default) for p in POSITION]
        return from_quaternion([values.get(p.name, p.default) for p in ROTATION], position)

    def invert(self, relative: np.ndarray, *pair: Any, **features: Any) -> Inverse:
        numbers = np.concatenate([relative[:3, 3], quaternion(relative)])
        return Inverse({p.name: float(n) for p, n in zip(POSITION + ROTATION, numbers, strict=True)}, {}, 0.0, 0.0)


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
