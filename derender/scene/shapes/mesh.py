"""Solids drawn by triangles: a mesh file in the axes of its own oriented box; the compound; the free-form thing.

A compound is a few primitives that move as one, such as a mallet, an L, or a mug with its handle. A thing is a body
that no primitive explains, kept with the object, as text, so that a scene file is whole by itself.
"""

import base64
import binascii
import json
import struct
import zlib
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple
from warnings import warn

import numpy as np

from derender.errors import DerenderError
from derender.registry import Parameter, suggest
from derender.scene.pose import from_axes, from_quaternion
from derender.scene.shapes.base import FACE_NAMES, NONE, SIDES, Options, Psi, Shape, mesh_of, shapes
from derender.scene.shapes.kinds import ROTATIONS, box_mesh

MOST_BYTES, MOST_TRIANGLES = 200_000_000, 2_000_000  # of a mesh file: beyond, fitting its box takes minutes
LARGEST_METRES = 5.0  # no household solid is larger: a mesh that is was written in millimetres
FLAT = 1e-6  # of a mesh's longest extent, up to which its shortest is what rounding leaves of none
FARTHEST = 1e9  # metres, or whatever the file counts in, of a vertex: volumes beyond it overflow


class LoadedMesh(NamedTuple):
    """A mesh as loaded, at scale 1.

    box_from_file : (4, 4) float64, from the file's axes to the box's: applied to the file's vertices gives ours.
    """

    vertices: np.ndarray  # (V, 3) float64, in the axes of the oriented box, its centre the origin; not writeable
    triangles: np.ndarray  # (T, 3) int32; not writeable
    extents: np.ndarray  # (3,) float64 of the oriented box
    box_from_file: np.ndarray


def load_mesh(path: str | Path, hull: bool = True) -> LoadedMesh:
    """Return the mesh in a file that trimesh reads (.ply, .obj, .stl, .glb, ...), as its convex hull or in full.

    A mesh's own axes need not be its box's, so the smallest oriented box is fitted. Warns of a mesh that is not
    watertight and of one that seems to be in millimetres. Raises DerenderError for a missing or unreadable file.
    """
    path = Path(path)
    try:
        stamp = path.stat().st_mtime_ns
        if path.stat().st_size > MOST_BYTES:
            remedy = "decimate it: a few thousand triangles show all that a depth camera sees"
            raise DerenderError(f"the mesh file has more than {MOST_BYTES // 1_000_000} MB", path, remedy)
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        reason = getattr(error, "strerror", None) or str(error)
        raise DerenderError(f"cannot read the mesh ({reason})", ascii(str(path)), "check the path") from None
    return _load(str(path.resolve()), bool(hull), stamp)


@lru_cache(maxsize=64)
def _load(path: str, hull: bool, stamp: int) -> LoadedMesh:
    import trimesh

    try:
        with np.errstate(invalid="ignore", over="ignore"):  # what is no number, or too far away, is told by fit_box
            mesh = trimesh.load_mesh(path)
        if not isinstance(mesh, trimesh.Trimesh):
            mesh = mesh.to_mesh() if hasattr(mesh, "to_mesh") else None
    except Exception as error:  # trimesh's readers raise whatever the garbage in the file provokes
        what = f"not a mesh that trimesh can read ({error})"
        raise DerenderError(what, path, "give a .ply, .obj, .stl or .glb") from None
    if mesh is None or len(mesh.faces) == 0:
        raise DerenderError("the mesh has no triangles", path, "give a surface, not a point cloud")
    if len(mesh.faces) > MOST_TRIANGLES:
        remedy = "decimate it: a few thousand triangles show all that a depth camera sees"
        raise DerenderError(f"the mesh has {len(mesh.faces):,} triangles, more than {MOST_TRIANGLES:,}", path, remedy)
    return fit_box(mesh, hull, path)


def fit_box(mesh: Any, hull: bool, where: object) -> LoadedMesh:
    """Return a trimesh.Trimesh in the axes of its smallest oriented box; `where` names it in errors and warnings."""
    import trimesh

    if not (np.abs(mesh.vertices) < FARTHEST).all():
        raise DerenderError("the mesh has vertices that are not finite, or too far away", where, "export it again")
    try:
        with np.errstate(divide="ignore", invalid="ignore"):
            convex = mesh.convex_hull
            box_from_file, extents = trimesh.bounds.oriented_bounds(convex)
        if not min(extents) > FLAT * max(extents):
            raise ValueError("flat but for rounding")
    except Exception:  # qhull's and numpy's several ways to say that the vertices lie in a plane
        raise DerenderError("the mesh is flat or a point", where, "a solid needs three extents") from None
    if not mesh.is_watertight and not hull:
        warn(f"{where}: the mesh is not watertight, its inside is not defined; use its convex hull", stacklevel=2)
    if max(extents) > LARGEST_METRES:
        remedy = "if it is in millimetres give scale: 0.001"
        warn(f"{where}: the mesh is {max(extents):.0f} m long; {remedy}", stacklevel=2)
    box_from_file = upright(np.asarray(box_from_file, dtype=float))
    drawn = convex if hull else mesh
    vertices = np.ascontiguousarray(trimesh.transform_points(drawn.vertices, box_from_file))
    # The box of the transformed hull, exactly: centre and extents agree with the vertices to the last digit.
    corners = trimesh.transform_points(convex.vertices, box_from_file)
    low, high = corners.min(axis=0), corners.max(axis=0)
    vertices -= 0.5 * (low + high)
    box_from_file[:3, 3] -= 0.5 * (low + high)
    triangles = np.ascontiguousarray(drawn.faces, dtype=np.int32)
    loaded = LoadedMesh(vertices, triangles, high - low, box_from_file)
    for array in loaded:
        array.flags.writeable = False
    return loaded


def upright(box_from_file: np.ndarray) -> np.ndarray:
    """Return the fitted box's pose with its axes renamed and signed so that they are nearest to the file's.

    The fit orders the box's axes by length; people who wrote the file meant its own z to be up.
    """
    traces = np.einsum("kij,ji->k", ROTATIONS, box_from_file[:3, :3])
    return from_axes(ROTATIONS[int(np.argmax(traces))].T) @ box_from_file


class Scaled(Shape):
    """What mesh and compound share: a fixed form times `scale`, with the faces of its box.

    A subclass gives `load(options)`, with `vertices` (V, 3), `triangles` (T, 3) and `extents` (3,) at scale 1.
    """

    parameters = (Parameter("scale", "", 0.0, np.inf, 1.0),)
    face_names = FACE_NAMES

    def load(self, options: Options) -> Any:
        """Return its form at scale 1; DerenderError where its options are at fault."""
        raise NotImplementedError

    def size(self, psi: Psi, options: Options = NONE) -> np.ndarray:
        return float(psi[0]) * self.load(options).extents

    def psi_from_size(self, size: np.ndarray, options: Options = NONE) -> np.ndarray:
        return np.array([float(np.cbrt(np.prod(np.asarray(size) / self.load(options).extents)))])

    def mesh(self, psi: Psi, options: Options = NONE) -> Any:
        loaded = self.load(options)
        return mesh_of(float(psi[0]) * loaded.vertices, loaded.triangles)

    def drawn_mesh(self, psi: Psi, options: Options = NONE) -> Any:
        loaded = self.load(options)
        return id(loaded.vertices), (loaded.vertices, loaded.triangles)

    def check(self, psi: Psi, options: Options = NONE, where: object = None) -> None:
        super().check(psi, options, where)
        self.load(options)


@shapes.register("mesh")
class Mesh(Scaled):
    """A mesh from a file, times `scale`. Its faces are those of its oriented box, fitted when it is loaded.

    Options: `file`, the path; `hull`, true (default) for the convex hull and false for the mesh as it is.
    """

    options = ("file", "hull")

    def load(self, options: Options) -> LoadedMesh:
        """Return the file's mesh at scale 1."""
        if not options.get("file"):
            raise DerenderError("a mesh needs its file", remedy="give file: PATH")
        return load_mesh(options["file"], options.get("hull", True))


MOST_PARTS = 100
PLACE = ("position", "quat_wxyz")


class Assembly(NamedTuple):
    """The parts of a compound put together, at scale 1, about the centre of their box."""

    vertices: np.ndarray  # (V, 3) float64, metres
    triangles: np.ndarray  # (T, 3) int32
    extents: np.ndarray  # (3,) float64, metres
    corners: tuple[np.ndarray, ...]  # for each part (C, 3) float64, metres, of its convex hull


def part_mesh(part: Any) -> Any:
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
class Compound(Scaled):
    """Several solids that move as one, times `scale`; its axes are those of its parts, its faces those of their box.

    Options: `parts`, a list of solids with fixed numbers, each with its `position` and `quat_wxyz`.
    """

    options = ("parts",)

    def load(self, options: Options) -> Assembly:
        """Return its parts put together; DerenderError where one is at fault."""
        parts = options.get("parts")
        if not isinstance(parts, list | tuple) or not 1 <= len(parts) <= MOST_PARTS:
            raise DerenderError(
                f"a compound needs a list of 1 to {MOST_PARTS} parts", remedy="give parts: [{type: ...}]"
            )
        return _assemble(json.dumps(parts, default=str))

    def convex_parts(self, psi: Psi, options: Options = NONE) -> tuple[np.ndarray, ...]:
        return tuple(float(psi[0]) * corners for corners in self.load(options).corners)


STEPS = 65535  # to which a vertex is rounded along each extent: a hundredth of a millimetre of half a metre
HEAD = "<II"  # how many vertices, how many triangles
MOST = 65536  # vertices: their numbers have 16 bits


def encode_surface(vertices: np.ndarray, triangles: np.ndarray) -> tuple[str, np.ndarray, np.ndarray]:
    """Return (text, size (3,), centre (3,)) of a surface: its bounding box, and the text that fits into it.

    vertices : (V, 3) float64, metres, V at most MOST. triangles : (T, 3) int.
    """
    if not 4 <= len(vertices) <= MOST:
        raise ValueError(f"a surface has 4 to {MOST} vertices, not {len(vertices)}")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if not (high > low).all():
        raise ValueError("the surface is flat")
    rounded = np.rint((vertices - low) / (high - low) * STEPS).astype("<u2")
    data = struct.pack(HEAD, len(rounded), len(triangles)) + rounded.tobytes()
    data += np.asarray(triangles).astype("<u2").tobytes()
    return base64.b64encode(zlib.compress(data, 9)).decode(), high - low, 0.5 * (low + high)


@lru_cache(maxsize=256)
def decode_surface(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) float64 in [-.5, .5] and triangles (T, 3) int32 of `encode_surface`'s text.

    Raises DerenderError for any other text.
    """
    try:
        data = zlib.decompress(base64.b64decode(text, validate=True))
        count, faces = struct.unpack_from(HEAD, data)
        start = struct.calcsize(HEAD)
        vertices = np.frombuffer(data, "<u2", 3 * count, start).reshape(-1, 3) / STEPS - 0.5
        triangles = np.frombuffer(data, "<u2", 3 * faces, start + 6 * count).reshape(-1, 3).astype(np.int32)
        whole = len(data) == start + 6 * (count + faces) and count >= 4 and faces >= 4 and int(triangles.max()) < count
    except (ValueError, struct.error, zlib.error, binascii.Error):
        whole = False
    if not whole:
        raise DerenderError("the surface of a thing is damaged", remedy="take it as derender infer wrote it")
    vertices.flags.writeable = triangles.flags.writeable = False
    return vertices, triangles


@shapes.register("thing")
class Thing(Shape):
    """A free-form body, as its visible surface tells it, closed behind. Its faces are those of its bounding box.

    Options: `surface`, its closed surface as text (`encode_surface`), which `derender infer` writes; without it the
    whole box is filled.
    """

    parameters = SIDES
    options = ("surface",)
    face_names = FACE_NAMES

    def surface(self, options: Options) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices (V, 3) in [-.5, .5] and triangles (T, 3) of the closed surface."""
        text = options.get("surface")
        return decode_surface(str(text)) if text else box_mesh(np.ones(3))

    def mesh(self, psi: Psi, options: Options = NONE) -> Any:
        vertices, triangles = self.surface(options)
        return mesh_of(vertices * np.asarray(psi, float), triangles)

    def drawn_mesh(self, psi: Psi, options: Options = NONE) -> Any:
        return ("thing", options.get("surface")), self.surface(options)

    def check(self, psi: Psi, options: Options = NONE, where: object = None) -> None:
        super().check(psi, options, where)
        self.surface(options)
