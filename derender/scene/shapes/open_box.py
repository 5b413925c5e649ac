"""The open box: a tote, a bin, a drawer, a carton without lid."""

import numpy as np

from derender.errors import DerenderError
from derender.scene.parameter import Parameter
from derender.scene.shapes.base import FACE_NAMES, Face, Outline, Shape, Symmetry, box_face, shapes
from derender.scene.shapes.box import CORNERS

WALL = 0.005  # metres, of a file that says none: totes and cartons have 3 to 8 mm


@shapes.register("open-box")
class OpenBox(Shape):
    """A box without lid, by its outer sides and the thickness of its walls and bottom.

    Its face +z is the bottom's inside, on which what it holds rests; the others are its outside.
    """

    parameters = (
        *(Parameter(name, "m", 0.0, np.inf) for name in ("length", "width", "height")),
        Parameter("wall", "m", 0.0, np.inf, WALL),
    )
    form_parameters = ("length", "width", "height", "wall")
    face_names = FACE_NAMES

    def size(self, psi, options={}):  # noqa: B006 - never changed
        return np.array(psi[:3], dtype=float)

    def psi_from_size(self, size, options={}):  # noqa: B006
        return np.array([*size, WALL], dtype=float)

    def face(self, name, psi, options={}):  # noqa: B006
        if name not in self.face_names:
            raise self.no_such_face(name)
        length, width, height, wall = (float(value) for value in psi)
        if name != "+z":
            return box_face(name, (length, width, height))
        inside = Outline(length - 2.0 * wall, width - 2.0 * wall)
        return Face(box_face(name, (length, width, 2.0 * wall - height)).frame, inside)

    def face_order(self, name):
        return 2 if name in ("+z", "-z") else 1

    def mesh(self, psi, options={}):  # noqa: B006
        import trimesh

        *size, wall = (float(value) for value in psi)
        outer, inner = 0.5 * np.array(size[:2]), 0.5 * np.array(size[:2]) - wall
        low, high = -0.5 * size[2], 0.5 * size[2]
        square = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
        rings = [(outer, low), (outer, high), (inner, high), (inner, low + wall)]
        vertices = np.concatenate([np.column_stack([square * half, np.full(4, z)]) for half, z in rings])
        triangles = [(0, 2, 1), (0, 3, 2), (12, 13, 14), (12, 14, 15)]  # the bottom from below and from inside
        for ring in (0, 4, 8):  # outer walls, rim, inner walls
            for k in range(4):
                a, b = ring + k, ring + (k + 1) % 4
                triangles += [(a, b, b + 4), (a, b + 4, a + 4)]
        return trimesh.Trimesh(vertices, np.array(triangles), process=False)

    def convex_parts(self, psi, options={}):  # noqa: B006
        length, width, height, wall = (float(value) for value in psi)
        half, middle = 0.5 * np.array([length, width, height]), 0.5 * (height - wall)
        parts = [((length, width, wall), (0.0, 0.0, -middle))]
        for sign in (-1.0, 1.0):
            parts.append(((wall, width, height - wall), (sign * (half[0] - 0.5 * wall), 0.0, 0.5 * wall)))
            parts.append(((length - 2 * wall, wall, height - wall), (0.0, sign * (half[1] - 0.5 * wall), 0.5 * wall)))
        return tuple(CORNERS * size + place for size, place in parts)

    def symmetry(self, psi=(), options={}):  # noqa: B006
        return Symmetry(np.stack([np.eye(3), np.diag([-1.0, -1.0, 1.0])]))

    def check(self, psi, options={}, where=None):  # noqa: B006
        super().check(psi, options, where)
        length, width, height, wall = psi
        if not wall < min(0.5 * length, 0.5 * width, height):
            raise DerenderError(f"walls of {wall:g} m leave no room in it", where, "give a thinner wall")
