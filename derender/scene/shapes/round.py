"""The round solids: the cylinder, with two flat caps and a side that rolls, the frustum, and the sphere."""

from typing import Any

import numpy as np

from derender.registry import Parameter
from derender.scene.pose import from_axes
from derender.scene.shapes.base import NONE, POINT, Face, Options, Outline, Psi, Shape, Symmetry, shapes
from derender.scene.solids import CYLINDER, SPHERE

SECTIONS = 128  # of the mesh: its sagitta is 0.03 % of the radius
RADIUS, HEIGHT = (Parameter(name, "m", 0.0, np.inf) for name in ("radius", "height"))


@shapes.register("cylinder")
class Cylinder(Shape):
    """A cylinder about its z axis, by radius and height; it stands on +z or -z, or lies on its side."""

    parameters = (RADIUS, HEIGHT)
    solid_kind = CYLINDER
    face_names = ("+z", "-z")
    side_names = ("side",)
    symmetry = Symmetry(np.stack([np.eye(3), np.diag([1.0, -1.0, -1.0])]), "z")

    def size(self, psi: Psi, options: Options = NONE) -> np.ndarray:
        radius, height = psi
        return np.array([2.0 * radius, 2.0 * radius, height], dtype=float)

    def psi_from_size(self, size: np.ndarray, options: Options = NONE) -> np.ndarray:
        return np.array([0.25 * (size[0] + size[1]), size[2]], dtype=float)

    def face(self, name: str, psi: Psi, options: Options = NONE) -> Face:
        radius, height = float(psi[0]), float(psi[1])
        if name == "side":  # x along the axis, z towards the line that touches where `roll` is 0
            return Face(from_axes((0, 0, 1), (0, -1, 0), (1, 0, 0)), Outline(height, 0.0, 0.0), radius)
        return Face(super().face(name, psi).frame, Outline(0.0, 0.0, radius))

    def face_order(self, name: str) -> float:
        return 2 if name == "side" else np.inf

    def mesh(self, psi: Psi, options: Options = NONE) -> Any:
        import trimesh

        return trimesh.creation.cylinder(radius=float(psi[0]), height=float(psi[1]), sections=SECTIONS)


@shapes.register("sphere")
class Sphere(Shape):
    """A sphere, by its radius. It touches a face in a point, by whichever of its own points is there."""

    parameters = (RADIUS,)
    solid_kind = SPHERE
    point_names = ("surface",)
    order = np.inf
    symmetry = Symmetry(np.eye(3)[None], "all")

    def size(self, psi: Psi, options: Options = NONE) -> np.ndarray:
        return np.full(3, 2.0 * float(psi[0]))

    def psi_from_size(self, size: np.ndarray, options: Options = NONE) -> np.ndarray:
        return np.array([0.5 * float(np.mean(size))])

    def face(self, name: str, psi: Psi, options: Options = NONE) -> Face:
        if name not in self.point_names:
            raise self.no_such_face(name)
        return Face(np.eye(4), POINT, float(psi[0]))

    def mesh(self, psi: Psi, options: Options = NONE) -> Any:
        import trimesh

        return trimesh.creation.icosphere(subdivisions=4, radius=float(psi[0]))


@shapes.register("frustum")
class Frustum(Shape):
    """A round solid about its z axis, by the radius of its wide end -z, its height, and the radius of +z over that.

    A `taper` of 0.01 is a cone and 0.99 nearly a cylinder; a cup, which widens upwards, stands on its +z.
    """

    parameters = (RADIUS, HEIGHT, Parameter("taper", "", 0.0, 1.0, 0.5))
    form_parameters = ("taper",)
    face_names = ("+z", "-z")
    order = np.inf
    symmetry = Symmetry(np.eye(3)[None], "z")

    def size(self, psi: Psi, options: Options = NONE) -> np.ndarray:
        return np.array([2.0 * psi[0], 2.0 * psi[0], psi[1]], dtype=float)

    def psi_from_size(self, size: np.ndarray, options: Options = NONE) -> np.ndarray:
        return np.array([0.25 * (size[0] + size[1]), size[2], self.parameters[2].default], dtype=float)

    def face(self, name: str, psi: Psi, options: Options = NONE) -> Face:
        radius = float(psi[0]) * (1.0 if name == "-z" else float(psi[2]))
        return Face(super().face(name, psi).frame, Outline(0.0, 0.0, radius))

    def mesh(self, psi: Psi, options: Options = NONE) -> Any:
        import trimesh

        radius, height, taper = psi
        profile = [(0.0, -0.5 * height), (radius, -0.5 * height), (taper * radius, 0.5 * height), (0.0, 0.5 * height)]
        return trimesh.creation.revolve(profile, sections=SECTIONS)
