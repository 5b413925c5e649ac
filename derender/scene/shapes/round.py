"""The round solids: the cylinder, with two flat caps and a side that rolls, the frustum, and the sphere."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from derender.scene import solids
from derender.scene.parameter import Parameter
from derender.scene.pose import from_axes
from derender.scene.shapes.base import POINT, Face, Outline, Shape, Symmetry, box_face, shapes

SECTIONS = 128  # of the mesh: its sagitta is 0.03 % of the radius


@shapes.register("cylinder")
class Cylinder(Shape):
    """A cylinder about its z axis, by radius and height; it stands on +z or -z, or lies on its side."""

    parameters = (Parameter("radius", "m", 0.0, np.inf), Parameter("height", "m", 0.0, np.inf))
    solid_kind = solids.CYLINDER
    face_names = ("+z", "-z")
    side_names = ("side",)

    def size(self, psi: tuple[float, ...] | np.ndarray, options: Mapping[str, Any] = {}) -> np.ndarray | None:  # noqa: B006 - never changed
        radius, height = psi
        return np.array([2.0 * radius, 2.0 * radius, height], dtype=float)

    def psi_from_size(self, size: np.ndarray, options: Mapping[str, Any] = {}) -> np.ndarray:  # noqa: B006
        return np.array([0.25 * (size[0] + size[1]), size[2]], dtype=float)

    def face(self, name: Any, psi: tuple[float, ...] | np.ndarray, options: Mapping[str, Any] = {}) -> Face:  # noqa: B006
        radius, height = float(psi[0]), float(psi[1])
        if name in self.face_names:
            return Face(box_face(name, (0.0, 0.0, height)).frame, Outline(0.0, 0.0, radius))
        if name == "side":  # x along the axis, z towards the line that touches where `roll` is 0
            return Face(from_axes((0, 0, 1), (0, -1, 0), (1, 0, 0)), Outline(height, 0.0, 0.0), radius)
        raise self.no_such_face(name)

    def face_order(self, name: Any) -> float:
        return 2 if name == "side" else np.inf

    def mesh(self, psi: tuple[float, ...] | np.ndarray, options: Mapping[str, Any] = {}) -> Any:  # noqa: B006
        import trimesh

        return trimesh.creation.cylinder(radius=float(psi[0]), height=float(psi[1]), sections=SECTIONS)

    def symmetry(self, psi: Any = (), options: Mapping[str, Any] = {}) -> Symmetry:  # noqa: B006
        return Symmetry(np.stack([np.eye(3), np.diag([1.0, -1.0, -1.0])]), "z")


@shapes.register("sphere")
class Sphere(Shape):
    """A sphere, by its radius. It touches a face in a point, by whichever of its own points is there."""

    parameters = (Parameter("radius", "m", 0.0, np.inf),)
    solid_kind = solids.SPHERE
    point_names = ("surface",)

    def size(self, psi: tuple[float, ...] | np.ndarray, options: Mapping[str, Any] = {}) -> np.ndarray | None:  # noqa: B006 - never changed
        return np.full(3, 2.0 * float(psi[0]))

    def psi_from_size(self, size: np.ndarray, options: Mapping[str, Any] = {}) -> np.ndarray:  # noqa: B006
        return np.array([0.5 * float(np.mean(size))])

    def face(self, name: Any, psi: tuple[float, ...] | np.ndarray, options: Mapping[str, Any] = {}) -> Face:  # noqa: B006
        if name not in self.point_names:
            raise self.no_such_face(name)
        return Face(np.eye(4), POINT, float(psi[0]))

    def face_order(self, name: Any) -> float:
        return np.inf

    def mesh(self, psi: tuple[float, ...] | np.ndarray, options: Mapping[str, Any] = {}) -> Any:  # noqa: B006
        import trimesh

        return trimesh.creation.icosphere(subdivisions=4, radius=float(psi[0]))

    def symmetry(self, psi: Any = (), options: Mapping[str, Any] = {}) -> Symmetry:  # noqa: B006
        return Symmetry(np.eye(3)[None], "all")


@shapes.register("frustum")
class Frustum(Shape):
    """A round solid about its z axis, by the radius of its wide end -z, its height, and the radius of +z over that.

    A `taper` of 0.01 is a cone and 0.99 nearly a cylinder; a cup, which widens upwards, stands on its +z.
    """

    parameters = (
        Parameter("radius", "m", 0.0, np.inf),
        Parameter("height", "m", 0.0, np.inf),
        Parameter("taper", "", 0.0, 1.0, 0.5),
    )
    form_parameters = ("taper",)
    face_names = ("+z", "-z")

    def size(self, psi: tuple[float, ...] | np.ndarray, options: Mapping[str, Any] = {}) -> np.ndarray | None:  # noqa: B006 - never changed
        return np.array([2.0 * psi[0], 2.0 * psi[0], psi[1]], dtype=float)

    def psi_from_size(self, size: np.ndarray, options: Mapping[str, Any] = {}) -> np.ndarray:  # noqa: B006
        return np.array([0.25 * (size[0] + size[1]), size[2], self.parameters[2].default], dtype=float)

    def face(self, name: Any, psi: tuple[float, ...] | np.ndarray, options: Mapping[str, Any] = {}) -> Face:  # noqa: B006
        if name not in self.face_names:
            raise self.no_such_face(name)
        radius, height, taper = (float(value) for value in psi)
        return Face(
            box_face(name, (0.0, 0.0, height)).frame, Outline(0.0, 0.0, radius if name == "-z" else taper * radius)
        )

    def face_order(self, name: Any) -> float:
        return np.inf

    def mesh(self, psi: tuple[float, ...] | np.ndarray, options: Mapping[str, Any] = {}) -> Any:  # noqa: B006
        import trimesh

        radius, height, taper = psi
        profile = [(0.0, -0.5 * height), (radius, -0.5 * height), (taper * radius, 0.5 * height), (0.0, 0.5 * height)]
        return trimesh.creation.revolve(profile, sections=SECTIONS)

    def symmetry(self, psi: Any = (), options: Mapping[str, Any] = {}) -> Symmetry:  # noqa: B006
        return Symmetry(np.eye(3)[None], "z")
