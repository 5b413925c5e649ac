"""Shapes without extent: the coordinate frame, such as the root, and the plane, such as a floor, a table or a wall."""

from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.scene.pose import rotation_z
from derender.scene.shapes.base import NONE, UNBOUNDED, Face, Options, Psi, Shape, Symmetry, box_face, shapes
from derender.scene.solids import BOX, PLANE


@shapes.register("frame")
class Frame(Shape):
    """A coordinate frame: no surface, no parameters; others float in it by `6dof`."""

    solid_kind = None
    bounded = False

    def size(self, psi: Psi = (), options: Options = NONE) -> None:
        return None

    def mesh(self, psi: Psi = (), options: Options = NONE) -> Any:
        import trimesh

        return trimesh.Trimesh()


DRAWN_SIDE = 20.0  # metres; of the square that stands for the plane in exports and previews
THICKNESS = 1e-5  # metres of the sheet as which a bounded plane is drawn: nothing that a depth image shows


@shapes.register("plane")
class Plane(Shape):
    """The plane z = 0 of its own axes, with the faces +z and -z (the paper's 1 and 0).

    Options: `patch` [x, y, length, width, turn], metres and radians: the rectangle of it that is there, by its middle
    and the turn of its length from x. Contacts take it as unbounded all the same; it is drawn, and bears, as far as it
    is there.
    """

    solid_kind = PLANE
    bounded = False
    face_names = ("+z", "-z")
    options = ("patch",)
    order = np.inf
    symmetry = Symmetry(np.stack([np.eye(3), np.diag([1.0, -1.0, -1.0])]), "z")

    def drawn(self, psi: Psi, options: Options = NONE) -> tuple[int | None, np.ndarray, np.ndarray | None]:
        if not options.get("patch"):
            return super().drawn(psi, options)
        x, y, length, width, turn = options["patch"]
        pose = rotation_z(turn)
        pose[:2, 3] = x, y
        return BOX, np.array([length, width, THICKNESS]), pose

    def check(self, psi: Psi, options: Options = NONE, where: object = None) -> None:
        patch = options.get("patch")
        if patch is None:
            return
        numbers = isinstance(patch, list | tuple) and all(isinstance(number, int | float) for number in patch)
        if not numbers or len(patch) != 5 or not np.isfinite(patch).all() or min(patch[2:4]) <= 0.0:
            remedy = "write [x, y, length, width, turn] in metres and radians, length and width above 0"
            raise DerenderError("the patch of the plane is none", where, remedy)

    def size(self, psi: Psi = (), options: Options = NONE) -> None:
        return None

    def face(self, name: str, psi: Psi = (), options: Options = NONE) -> Face:
        if name not in self.face_names:
            raise self.no_such_face(name)
        return Face(box_face(name, (0.0, 0.0, 0.0)).frame, UNBOUNDED)

    def mesh(self, psi: Psi = (), options: Options = NONE) -> Any:
        import trimesh

        half = DRAWN_SIDE / 2
        corners = [[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]]
        return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
