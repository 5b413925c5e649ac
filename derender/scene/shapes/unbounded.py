"""Shapes without extent: the coordinate frame, such as the root, and the plane, such as a floor, a table or a wall."""

import numpy as np

from derender.scene import solids
from derender.scene.shapes.base import UNBOUNDED, Face, Shape, Symmetry, box_face, shapes


@shapes.register("frame")
class Frame(Shape):
    """A coordinate frame: no surface, no parameters; others float in it by `6dof`."""

    solid_kind = None
    bounded = False

    def size(self, psi=(), options={}):  # noqa: B006 - never changed
        return None

    def psi_from_size(self, size=None, options={}):  # noqa: B006
        return np.zeros(0)

    def mesh(self, psi=(), options={}):  # noqa: B006
        import trimesh

        return trimesh.Trimesh()


DRAWN_SIDE = 20.0  # metres; of the square that stands for the plane in exports and previews


@shapes.register("plane")
class Plane(Shape):
    """The plane z = 0 of its own axes, with the faces +z and -z (the paper's 1 and 0)."""

    solid_kind = solids.PLANE
    bounded = False
    face_names = ("+z", "-z")

    def size(self, psi=(), options={}):  # noqa: B006 - never changed
        return None

    def psi_from_size(self, size=None, options={}):  # noqa: B006
        return np.zeros(0)

    def face(self, name, psi=(), options={}):  # noqa: B006
        if name not in self.face_names:
            raise self.no_such_face(name)
        return Face(box_face(name, (0.0, 0.0, 0.0)).frame, UNBOUNDED)

    def face_order(self, name):
        return np.inf

    def mesh(self, psi=(), options={}):  # noqa: B006
        import trimesh

        half = DRAWN_SIDE / 2
        corners = [[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]]
        return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)

    def symmetry(self, psi=(), options={}):  # noqa: B006
        return Symmetry(np.stack([np.eye(3), np.diag([1.0, -1.0, -1.0])]), "z")
