"""The cube, the paper's solid."""

from itertools import permutations, product

import numpy as np

from derender.scene import solids
from derender.scene.parameter import Parameter
from derender.scene.shapes.base import FACE_NAMES, Shape, Symmetry, shapes
from derender.scene.shapes.box import CORNER_NAMES, EDGE_NAMES, box_feature


def _rotations() -> np.ndarray:
    """Return the (24, 3, 3) rotations of the cube: the signed permutation matrices of determinant one."""
    found = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0:
                found.append(matrix)
    return np.stack(found)


ROTATIONS = _rotations()


@shapes.register("cube")
class Cube(Shape):
    """A cube, by its side; a quarter turn of any face leaves it as it is."""

    parameters = (Parameter("side", "m", 0.0, np.inf),)
    solid_kind = solids.BOX
    face_names = FACE_NAMES
    edge_names = EDGE_NAMES
    corner_names = CORNER_NAMES

    def size(self, psi, options={}):  # noqa: B006 - never changed
        return np.full(3, float(psi[0]))

    def psi_from_size(self, size, options={}):  # noqa: B006
        return np.array([float(np.mean(size))])

    def face(self, name, psi, options={}):  # noqa: B006
        if name not in self.feature_names():
            raise self.no_such_face(name)
        return box_feature(name, self.size(psi))

    def face_order(self, name):
        return 4

    def mesh(self, psi, options={}):  # noqa: B006
        import trimesh

        return trimesh.creation.box(extents=self.size(psi, options))

    def symmetry(self, psi=(), options={}):  # noqa: B006
        return Symmetry(ROTATIONS)
