"""The compound: a few primitives that move as one, such as a mallet, an L, or a mug with its handle."""

import json
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from derender.errors import DerenderError
from derender.registry import suggest
from derender.scene.parameter import Parameter
from derender.scene.pose import from_quaternion
from derender.scene.shapes.base import FACE_NAMES, Shape, box_face, shapes

MOST_PARTS = 100
PLACE = ("position", "quat_wxyz")


class Assembly(NamedTuple):
    """The parts of a compound put together, at scale 1, about the centre of their box.

    Attributes
    ----------
    vertices : (V, 3) float64, metres. triangles : (T, 3) int32. extents : (3,) float64, metres.
    corners : for each part (C, 3) float64, metres, of its convex hull.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    extents: np.ndarray
    corners: tuple[np.ndarray, ...]


def part_mesh(part: Any):
    """Return a part as a trimesh.Trimesh in the compound's own axes, metres; DerenderError where it is at fault."""
    if not isinstance(part, Mapping) or "type" not in part:
        raise DerenderError("a part is {type: box, length: 0.1, ..., position: [x, y, z]}")
    solids = [name for name in shapes if shapes[name].bounded and shapes[name].solid_kind and not shapes[name].options]
    if part["type"] not in solids:
        raise DerenderError(f"{part['type']!r} can be no part", remedy=suggest(str(part["type"]), solids))
    shape = shapes[part["type"]]
    names = [parameter.name for parameter in shape.parameters]
    for key in part:
        if key not in ("type", *names, *PLACE):
            raise DerenderError(f"a part has no {key!r}", remedy=suggest(str(key), [*names, *PLACE]))
    psi = _numbers([part.get(each.name, each.default) for each in shape.parameters], f"the numbers of the {shape.name}")
    shape.check(psi)
    position = _numbers(part.get("position", [0.0, 0.0, 0.0]), "position", 3)
    turn = _numbers(part.get("quat_wxyz", [1.0, 0.0, 0.0, 0.0]), "quat_wxyz", 4)
    if not turn.any():
        raise DerenderError("the quaternion is zero", remedy="write quat_wxyz: [1, 0, 0, 0]")
    return shape.mesh(psi).apply_transform(from_quaternion(turn, position))


def _numbers(values: Any, what: str, count: int | None = None) -> np.ndarray:
    """Return `count` finite numbers of a part."""
    try:
        found = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        found = np.array(np.nan)
    if found.ndim != 1 or (count is not None and len(found) != count) or not np.isfinite(found).all():
        raise DerenderError(f"{what} must be {count or ''} fixed numbers".replace("  ", " "), remedy="write metres")
    return found


@lru_cache(maxsize=64)
def _assemble(text: str) -> Assembly:
    """Return the Assembly of parts written as JSON."""
    import trimesh

    meshes = [part_mesh(part) for part in json.loads(text)]
    whole: Any = trimesh.util.concatenate(meshes)
    middle = whole.vertices.min(axis=0) + 0.5 * np.ptp(whole.vertices, axis=0)
    corners = tuple(np.array(mesh.convex_hull.vertices) - middle for mesh in meshes)
    vertices, triangles = np.array(whole.vertices) - middle, np.array(whole.faces, dtype=np.int32)
    for array in (vertices, triangles, *corners):
        array.flags.writeable = False
    return Assembly(vertices, triangles, np.ptp(vertices, axis=0), corners)


@shapes.register("compound")
class Compound(Shape):
    """Several solids that move as one, times `scale`; its axes are those of its parts, its faces those of their box.

    Options: `parts`, a list of solids with fixed numbers, each with its `position` and `quat_wxyz`.
    """

    parameters = (Parameter("scale", "", 0.0, np.inf, 1.0),)
    options = ("parts",)
    face_names = FACE_NAMES

    def assemble(self, options) -> Assembly:
        """Return its parts put together; DerenderError where one is at fault."""
        parts = options.get("parts")
        if not isinstance(parts, list | tuple) or not 1 <= len(parts) <= MOST_PARTS:
            raise DerenderError(
                f"a compound needs a list of 1 to {MOST_PARTS} parts", remedy="give parts: [{type: ...}]"
            )
        return _assemble(json.dumps(parts, default=str))

    def size(self, psi, options={}):  # noqa: B006 - never changed
        return float(psi[0]) * self.assemble(options).extents

    def psi_from_size(self, size, options={}):  # noqa: B006
        return np.array([float(np.cbrt(np.prod(np.asarray(size) / self.assemble(options).extents)))])

    def face(self, name, psi, options={}):  # noqa: B006
        if name not in self.face_names:
            raise self.no_such_face(name)
        return box_face(name, self.size(psi, options))

    def mesh(self, psi, options={}):  # noqa: B006
        import trimesh

        assembly = self.assemble(options)
        return trimesh.Trimesh(float(psi[0]) * assembly.vertices, assembly.triangles, process=False)

    def convex_parts(self, psi, options={}):  # noqa: B006
        return tuple(float(psi[0]) * corners for corners in self.assemble(options).corners)

    def drawn_mesh(self, psi, options={}):  # noqa: B006
        assembly = self.assemble(options)
        return json.dumps(options["parts"], default=str), (assembly.vertices, assembly.triangles)

    def check(self, psi, options={}, where=None):  # noqa: B006
        super().check(psi, options, where)
        self.assemble(options)
