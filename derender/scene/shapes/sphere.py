"""The sphere."""

import numpy as np

from derender.scene import solids
from derender.scene.parameter import Parameter
from derender.scene.shapes.base import POINT, Face, Shape, Symmetry, shapes


@shapes.register("sphere")
class Sphere(Shape):
    """A sphere, by its radius. It touches a face in a point, by whichever of its own points is there."""

    parameters = (Parameter("radius", "m", 0.0, np.inf),)
    solid_kind = solids.SPHERE
    point_names = ("surface",)

    def size(self, psi, options={}):  # noqa: B006 - never changed
        return np.full(3, 2.0 * float(psi[0]))

    def psi_from_size(self, size, options={}):  # noqa: B006
        return np.array([0.5 * float(np.mean(size))])

    def face(self, name, psi, options={}):  # noqa: B006
        if name not in self.point_names:
            raise self.no_such_face(name)
        return Face(np.eye(4), POINT, float(psi[0]))

    def face_order(self, name):
        return np.inf

    def mesh(self, psi, options={}):  # noqa: B006
        import trimesh

        return trimesh.creation.icosphere(subdivisions=4, radius=float(psi[0]))

    def symmetry(self, psi=(), options={}):  # noqa: B006
        return Symmetry(np.eye(3)[None], "all")
