"""What every shape type offers: extents, faces, a mesh; and the features that contacts take hold of."""

import math
from collections.abc import Mapping, Sequence
from itertools import product
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import numpy as np

from derender.errors import DerenderError
from derender.registry import Parameter, Registry, suggest
from derender.scene.solids import MESH

shapes: Registry["Shape"] = Registry("shape", "derender.shapes")

AXES = "xyz"
FACE_NAMES = ("+x", "-x", "+y", "-y", "+z", "-z")
# An edge is named by the two faces that meet in it, a corner by the three: "+x-z", "+x+y-z".
EDGE_NAMES = tuple(
    f"{first}{AXES[i]}{second}{AXES[j]}" for i, j in ((0, 1), (0, 2), (1, 2)) for first, second in product("+-", "+-")
)
CORNER_NAMES = tuple(f"{x}x{y}y{z}z" for x, y, z in product("+-", "+-", "+-"))
EXTENTS = ("length", "width", "height")  # of a box along its x, y and z
SIDES = tuple(Parameter(name, "m", 0.0, math.inf) for name in EXTENTS)

Psi = Sequence[float] | np.ndarray
Options = Mapping[str, Any]
NONE: Options = MappingProxyType({})


class Outline(NamedTuple):
    """A flat outline about its centre: a rectangle of `length` by `width`, grown by `radius`; all in metres.

    rectangle (a, b, 0), disc (0, 0, r), segment (a, 0, 0), point (0, 0, 0), unbounded plane (inf, inf, 0).
    """

    length: float = 0.0
    width: float = 0.0
    radius: float = 0.0

    @property
    def bounded(self) -> bool:
        return self.length < math.inf


POINT = Outline()
UNBOUNDED = Outline(math.inf, math.inf, 0.0)


class Face(NamedTuple):
    """A feature of a solid by which it can touch: a flat face, a side, an edge, a corner, or a sphere's any point.

    lift : distance from the frame's origin to the touching place along z: 0 for faces, the radius for what rolls.
    """

    frame: np.ndarray  # (4, 4) float64 in object axes; z along the outward normal, x along the outline's length
    outline: Outline  # where it touches, in the frame's x-y plane
    lift: float = 0.0


class Symmetry(NamedTuple):
    """The rotations that leave a solid as it is."""

    rotations: np.ndarray  # (K, 3, 3) float64, a finite group in object axes, the identity first
    axis: str | None = None  # "z" where any rotation about z may follow, "all" where any rotation may, else None


class Shape:
    """One shape type. Subclasses are registered as `@shapes.register("box")`; one instance serves all objects.

    Object axes: origin at the centre of the solid, axes along its box, z along a cylinder's axis. `psi` is the (P,)
    array of the values of `parameters`, in their order; `options` is what else a file may say, such as a mesh's file.
    A subclass needs `parameters` and `mesh`; its extents are its first three numbers, and the faces, edges and corners
    that it names those of its box, where it says nothing else.
    """

    name: str = ""
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    options: ClassVar[tuple[str, ...]] = ()
    form_parameters: ClassVar[tuple[str, ...]] = ()  # those that change its mesh by more than its extents
    solid_kind: ClassVar[int | None] = MESH  # drawn through its mesh; None: not drawn
    face_names: ClassVar[tuple[str, ...]] = ()
    side_names: ClassVar[tuple[str, ...]] = ()
    point_names: ClassVar[tuple[str, ...]] = ()
    edge_names: ClassVar[tuple[str, ...]] = ()
    corner_names: ClassVar[tuple[str, ...]] = ()
    bounded: ClassVar[bool] = True
    order: ClassVar[float] = 1.0  # how many rotations about a face's normal leave it as it is; inf: any
    symmetry: ClassVar[Symmetry] = Symmetry(np.eye(3)[None])

    def size(self, psi: Psi, options: Options = NONE) -> np.ndarray | None:
        """Return the (3,) full extents in metres along the object axes, or None without extent."""
        return np.array(psi[:3], dtype=float) if self.bounded else None

    def psi_from_size(self, size: np.ndarray, options: Options = NONE) -> np.ndarray:
        """Return the (P,) parameters whose extents are nearest to the (3,) `size`."""
        return np.array(size, dtype=float)

    def face(self, name: str, psi: Psi, options: Options = NONE) -> Face:
        """Return the feature called `name`; DerenderError if the shape has none such."""
        if name not in self.feature_names():
            raise DerenderError(f"a {self.name} has no face {name!r}", remedy=suggest(name, self.feature_names()))
        size = self.size(psi, options)
        return box_feature(name, np.zeros(3) if size is None else size)

    def face_order(self, name: str) -> float:
        """Return how many rotations about the face's normal leave the solid as it is; inf for any angle."""
        return self.order

    def mesh(self, psi: Psi, options: Options = NONE) -> Any:
        """Return the solid as a trimesh.Trimesh in object axes."""
        raise NotImplementedError

    def convex_parts(self, psi: Psi, options: Options = NONE) -> tuple[np.ndarray, ...]:
        """Return the corners (V, 3) in object axes of the convex solids it is made of; () where it is convex itself."""
        return ()

    def drawn(self, psi: Psi, options: Options = NONE) -> tuple[int | None, np.ndarray, np.ndarray | None]:
        """Return (kind, full extents, pose) of what `Solids` have of it: one of its kinds, (3,) metres, and the (4, 4)
        pose in object axes, None where these are its own."""
        extents = self.size(psi, options)
        return self.solid_kind, np.zeros(3) if extents is None else extents, None

    def drawn_mesh(self, psi: Psi, options: Options = NONE) -> Any:
        """Return (key, (vertices (V, 3), triangles (T, 3) int32)) for `Solids`; equal keys mean the same mesh."""
        mesh = self.mesh(psi, options)
        vertices = np.ascontiguousarray(mesh.vertices, dtype=float)
        key = (self.name, tuple(float(value) for value in psi), tuple(sorted(map(str, options.items()))))
        return key, (vertices, np.ascontiguousarray(mesh.faces, dtype=np.int32))

    def feature_names(self) -> tuple[str, ...]:
        """Return the names of all features that a contact can use."""
        return self.face_names + self.side_names + self.point_names + self.edge_names + self.corner_names

    def check(self, psi: Psi, options: Options = NONE, where: object = None) -> None:
        """Raise DerenderError unless the parameters are finite and within their ranges."""
        for parameter, value in zip(self.parameters, psi, strict=True):
            if not (parameter.lower < value < parameter.upper):
                what = f"{parameter.name} is {value:g}"
                remedy = f"it must be above {parameter.lower:g} and below {parameter.upper:g}"
                raise DerenderError(what, where, remedy)


class Body(NamedTuple):
    """A shape with its numbers: what a contact needs to know of each of the two solids."""

    shape: Shape  # the registered shape
    psi: Any = ()  # (P,) float64, its parameters
    options: Options = NONE  # what else the file says

    def face(self, name: str) -> Face:
        """Return the feature called `name`."""
        return self.shape.face(name, self.psi, self.options)

    def size(self) -> np.ndarray | None:
        """Return the (3,) full extents in metres, or None."""
        return self.shape.size(self.psi, self.options)

    def drawn(self) -> tuple[int | None, Any, np.ndarray | None]:
        """Return (kind, extents, pose) of what `Solids` have of it, see `Shape.drawn`."""
        return self.shape.drawn(self.psi, self.options)


def opposite(face: str) -> str:
    """Return the face on the other side of a solid: "-z" of "+z"."""
    return ("-" if face[0] == "+" else "+") + face[1:]


def box_face(name: str, size: Any) -> Face:
    """Return a face of the box with extents `size` (3,): x and y of its frame along the next two axes, cyclic.

    On the faces -x, -y, -z the frame's y is flipped to stay right-handed (README, Conventions).
    """
    if name not in FACE_NAMES:
        raise KeyError(name)
    axis, sign = AXES.index(name[1]), 1.0 if name[0] == "+" else -1.0
    following, last = (axis + 1) % 3, (axis + 2) % 3
    frame = np.zeros((4, 4))
    frame[following, 0] = 1.0
    frame[last, 1] = sign
    frame[axis, 2] = sign
    frame[axis, 3] = 0.5 * sign * size[axis]
    frame[3, 3] = 1.0
    return Face(frame, Outline(float(size[following]), float(size[last])))


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


def box_feature(name: str, size: Any) -> Face:
    """Return the face, edge or corner called `name` of the box with extents `size` (3,).

    The frame of a corner has its origin there and the object's axes.
    """
    if name in FACE_NAMES:
        return box_face(name, size)
    if name in EDGE_NAMES:
        return box_edge(name, size)
    frame = np.eye(4)
    frame[:3, 3] = 0.5 * signs_of(name) * size
    return Face(frame, POINT)


def mesh_of(vertices: Any, triangles: Any) -> Any:
    """Return vertices (V, 3) and triangles (T, 3) as they are as a trimesh.Trimesh."""
    import trimesh

    return trimesh.Trimesh(vertices, triangles, process=False)
