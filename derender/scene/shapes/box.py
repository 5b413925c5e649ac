"""The box and the cube, with their faces, edges and corners; and the open box: a tote, a bin, a carton without lid."""

from itertools import permutations, product
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.registry import Parameter
from derender.scene.shapes.base import (
    AXES,
    FACE_NAMES,
    NONE,
    POINT,
    SIDES,
    Face,
    Options,
    Outline,
    Psi,
    Shape,
    Symmetry,
    box_face,
    shapes,
)
from derender.scene.solids import BOX

# An edge is named by the two faces that meet in it, a corner by the three: "+x-z", "+x+y-z".
EDGE_NAMES = tuple(
    f"{first}{AXES[i]}{second}{AXES[j]}" for i, j in ((0, 1), (0, 2), (1, 2)) for first, second in product("+-", "+-")
)
CORNER_NAMES = tuple(f"{x}x{y}y{z}z" for x, y, z in product("+-", "+-", "+-"))
CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))  # (8, 3), of the box with sides of one metre
CORNERS.flags.writeable = False
QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))  # counter-clockwise


def box_mesh(size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (8, 3) and triangles (12, 3) of a box about the origin, counter-clockwise from outside."""
    triangles = [(a, b, c) for a, b, c, _ in QUADS] + [(a, c, d) for a, _, c, d in QUADS]
    return CORNERS * size, np.array(triangles, dtype=np.int32)


def signs_of(name: str) -> np.ndarray:
    """Return the (3,) signs that a face's, edge's or corner's name gives: "+x-z" is (1, 0, -1)."""
    signs = np.zeros(3)
    for sign, axis in zip(name[::2], name[1::2], strict=True):
        signs[AXES.index(axis)] = 1.0 if sign == "+" else -1.0
    return signs


def box_edge(name: str, size: np.ndarray) -> Face:
    """Return an edge of the box: x along it, z the normal of the second of its cyclic faces.

    With the edge along axis k and i = k + 1, j = k + 2 (cyclic): z = s_i e_i, x = s_i s_j e_k, so that turning the
    frame about x by `lean` in [0, pi/2] carries z from the face on axis i to the face on axis j.
    """
    signs = signs_of(name)
    k = int(np.flatnonzero(signs == 0.0)[0])
    i, j = (k + 1) % 3, (k + 2) % 3
    frame = np.zeros((4, 4))
    frame[k, 0] = signs[i] * signs[j]
    frame[j, 1] = -signs[j]
    frame[i, 2] = signs[i]
    frame[:3, 3] = 0.5 * signs * size
    frame[3, 3] = 1.0
    return Face(frame, Outline(float(size[k]), 0.0))


def box_corner(name: str, size: np.ndarray) -> Face:
    """Return a corner of the box: the origin of its frame is there, its axes are the object's."""
    frame = np.eye(4)
    frame[:3, 3] = 0.5 * signs_of(name) * size
    return Face(frame, POINT)


def box_feature(name: str, size: Any) -> Face:
    """Return the face, edge or corner called `name` of the box with extents `size` (3,)."""
    if name in FACE_NAMES:
        return box_face(name, size)
    return box_edge(name, size) if name in EDGE_NAMES else box_corner(name, size)


HALF_TURNS = np.stack([np.eye(3), np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1])])


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


class Rectangular(Shape):
    """What the box and the cube share: faces, edges and corners."""

    solid_kind = BOX
    face_names = FACE_NAMES
    edge_names = EDGE_NAMES
    corner_names = CORNER_NAMES

    def face(self, name: str, psi: Psi, options: Options = NONE) -> Face:
        if name not in self.feature_names():
            raise self.no_such_face(name)
        return box_feature(name, self.size(psi))

    def mesh(self, psi: Psi, options: Options = NONE) -> Any:
        import trimesh

        return trimesh.creation.box(extents=self.size(psi))


@shapes.register("box")
class Box(Rectangular):
    """A box with the sides length, width and height along its x, y and z."""

    parameters = SIDES
    order = 2
    symmetry = Symmetry(HALF_TURNS)


@shapes.register("cube")
class Cube(Rectangular):
    """A cube, by its side; a quarter turn of any face leaves it as it is."""

    parameters = (Parameter("side", "m", 0.0, np.inf),)
    order = 4
    symmetry = Symmetry(ROTATIONS)

    def size(self, psi: Psi, options: Options = NONE) -> np.ndarray:
        return np.full(3, float(psi[0]))

    def psi_from_size(self, size: np.ndarray, options: Options = NONE) -> np.ndarray:
        return np.array([float(np.mean(size))])


WALL = 0.005  # metres, of a file that says none: totes and cartons have 3 to 8 mm


@shapes.register("open-box")
class OpenBox(Shape):
    """A box without lid, by its outer sides and the thickness of its walls and bottom.

    Its face +z is the bottom's inside, on which what it holds rests; the others are its outside.
    """

    parameters = (*SIDES, Parameter("wall", "m", 0.0, np.inf, WALL))
    form_parameters = ("length", "width", "height", "wall")
    face_names = FACE_NAMES
    symmetry = Symmetry(np.stack([np.eye(3), np.diag([-1.0, -1.0, 1.0])]))

    def psi_from_size(self, size: np.ndarray, options: Options = NONE) -> np.ndarray:
        return np.array([*size, WALL], dtype=float)

    def face(self, name: str, psi: Psi, options: Options = NONE) -> Face:
        if name != "+z":
            return super().face(name, psi)
        length, width, height, wall = (float(value) for value in psi)
        inside = Outline(length - 2.0 * wall, width - 2.0 * wall)
        return Face(box_face(name, (length, width, 2.0 * wall - height)).frame, inside)

    def face_order(self, name: str) -> float:
        return 2 if name in ("+z", "-z") else 1

    def mesh(self, psi: Psi, options: Options = NONE) -> Any:
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

    def convex_parts(self, psi: Psi, options: Options = NONE) -> tuple[np.ndarray, ...]:
        length, width, height, wall = (float(value) for value in psi)
        half, middle = 0.5 * np.array([length, width, height]), 0.5 * (height - wall)
        parts = [((length, width, wall), (0.0, 0.0, -middle))]
        for sign in (-1.0, 1.0):
            parts.append(((wall, width, height - wall), (sign * (half[0] - 0.5 * wall), 0.0, 0.5 * wall)))
            parts.append(((length - 2 * wall, wall, height - wall), (0.0, sign * (half[1] - 0.5 * wall), 0.5 * wall)))
        return tuple(CORNERS * size + place for size, place in parts)

    def check(self, psi: Psi, options: Options = NONE, where: object = None) -> None:
        super().check(psi, options, where)
        length, width, height, wall = psi
        if not wall < min(0.5 * length, 0.5 * width, height):
            raise DerenderError(f"walls of {wall:g} m leave no room in it", where, "give a thinner wall")
