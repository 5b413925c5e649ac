"""The shapes that formulas draw: box, cube, cylinder, sphere; frame and plane, without extent; open box, frustum."""

from itertools import permutations, product
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.registry import Parameter
from derender.scene.pose import from_axes, rotation_z
from derender.scene.shapes.base import (
    CORNER_NAMES,
    EDGE_NAMES,
    EXTENTS,
    FACE_NAMES,
    NONE,
    POINT,
    SIDES,
    UNBOUNDED,
    Face,
    Options,
    Outline,
    Psi,
    Shape,
    Symmetry,
    box_face,
    mesh_of,
    shapes,
)
from derender.scene.solids import BOX, CYLINDER, PLANE, SPHERE

CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))  # (8, 3), of the box with sides of one metre
CORNERS.flags.writeable = False
QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))  # counter-clockwise


def box_mesh(size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (8, 3) and triangles (12, 3) of a box about the origin, counter-clockwise from outside."""
    triangles = [(a, b, c) for a, b, c, _ in QUADS] + [(a, c, d) for a, _, c, d in QUADS]
    return CORNERS * size, np.array(triangles, dtype=np.int32)


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

    def mesh(self, psi: Psi, options: Options = NONE) -> Any:
        import trimesh

        return trimesh.creation.box(extents=self.size(psi))


@shapes.register("box")
class Box(Rectangular):
    """A box with the sides length, width and height along its x, y and z."""

    parameters = SIDES
    order = 2
    symmetry = Symmetry(HALF_TURNS)


def mean_extent(size: np.ndarray) -> float:
    """Return the mean of extents (3,), of equal ones each to the last bit."""
    return float(size[0] + np.mean(size - size[0]))


@shapes.register("cube")
class Cube(Rectangular):
    """A cube, by its side; a quarter turn of any face leaves it as it is."""

    parameters = (Parameter("side", "m", 0.0, np.inf),)
    order = 4
    symmetry = Symmetry(ROTATIONS)

    def size(self, psi: Psi, options: Options = NONE) -> np.ndarray:
        return np.full(3, float(psi[0]))

    def psi_from_size(self, size: np.ndarray, options: Options = NONE) -> np.ndarray:
        return np.array([mean_extent(size)])


WALL = 0.005  # metres, of a file that says none: totes and cartons have 3 to 8 mm


@shapes.register("open-box")
class OpenBox(Shape):
    """A box without lid, by its outer sides and the thickness of its walls and bottom.

    Its face +z is the bottom's inside, on which what it holds rests; the others are its outside.
    """

    parameters = (*SIDES, Parameter("wall", "m", 0.0, np.inf, WALL))
    form_parameters = (*EXTENTS, "wall")
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
        return mesh_of(vertices, np.array(triangles))

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


SECTIONS = 128  # of the mesh: its sagitta is 0.03 % of the radius
RADIUS, HEIGHT = (Parameter(name, "m", 0.0, np.inf) for name in ("radius", "height"))


class Round(Shape):
    """What cylinder and frustum share: extents by radius and height, two flat faces."""

    face_names = ("+z", "-z")

    def size(self, psi: Psi, options: Options = NONE) -> np.ndarray:
        return np.array([2.0 * psi[0], 2.0 * psi[0], psi[1]], dtype=float)

    def psi_from_size(self, size: np.ndarray, options: Options = NONE) -> np.ndarray:
        return np.array([0.25 * (size[0] + size[1]), size[2]], dtype=float)


@shapes.register("cylinder")
class Cylinder(Round):
    """A cylinder about its z axis, by radius and height; it stands on +z or -z, or lies on its side."""

    parameters = (RADIUS, HEIGHT)
    solid_kind = CYLINDER
    side_names = ("side",)
    symmetry = Symmetry(np.stack([np.eye(3), np.diag([1.0, -1.0, -1.0])]), "z")

    def face(self, name: str, psi: Psi, options: Options = NONE) -> Face:
        radius, height = float(psi[0]), float(psi[1])
        if name == "side":  # x along the axis, z towards the line that touches where `roll` is 0
            return Face(from_axes(((0, 0, 1), (0, -1, 0), (1, 0, 0))), Outline(height, 0.0, 0.0), radius)
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
        return np.array([0.5 * mean_extent(size)])

    def face(self, name: str, psi: Psi, options: Options = NONE) -> Face:
        return Face(np.eye(4), POINT, float(psi[0])) if name in self.point_names else super().face(name, psi)

    def mesh(self, psi: Psi, options: Options = NONE) -> Any:
        import trimesh

        return trimesh.creation.icosphere(subdivisions=4, radius=float(psi[0]))


TAPER = 0.5  # of a file that says none


@shapes.register("frustum")
class Frustum(Round):
    """A round solid about its z axis, by the radius of its wide end -z, its height, and the radius of +z over that.

    A `taper` of 0.01 is a cone and 0.99 nearly a cylinder; a cup, which widens upwards, stands on its +z.
    """

    parameters = (RADIUS, HEIGHT, Parameter("taper", "", 0.0, 1.0, TAPER))
    form_parameters = ("taper",)
    order = np.inf
    symmetry = Symmetry(np.eye(3)[None], "z")

    def psi_from_size(self, size: np.ndarray, options: Options = NONE) -> np.ndarray:
        return np.append(super().psi_from_size(size), TAPER)

    def face(self, name: str, psi: Psi, options: Options = NONE) -> Face:
        radius = float(psi[0]) * (1.0 if name == "-z" else float(psi[2]))
        return Face(super().face(name, psi).frame, Outline(0.0, 0.0, radius))

    def mesh(self, psi: Psi, options: Options = NONE) -> Any:
        import trimesh

        radius, height, taper = psi
        profile = [(0.0, -0.5 * height), (radius, -0.5 * height), (taper * radius, 0.5 * height), (0.0, 0.5 * height)]
        return trimesh.creation.revolve(profile, sections=SECTIONS)


@shapes.register("frame")
class Frame(Shape):
    """A coordinate frame: no surface, no parameters; others float in it by `6dof`."""

    solid_kind = None
    bounded = False

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

    def face(self, name: str, psi: Psi = (), options: Options = NONE) -> Face:
        return super().face(name, psi, options)._replace(outline=UNBOUNDED)

    def mesh(self, psi: Psi = (), options: Options = NONE) -> Any:
        half = DRAWN_SIDE / 2
        return mesh_of([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]], [[0, 1, 2], [0, 2, 3]])
