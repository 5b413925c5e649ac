"""What is known beforehand: a library of objects with their sizes, or with their meshes.

    known:
      cracker_box: {type: mesh, file: 003_cracker_box.obj}     # scale: 0.001 for one in millimetres
      brick: {type: box, length: 20 cm, width: 10 cm, height: 6 cm, count: 2}

`count` says how many of it there may be (default: any number).  Files are looked for beside the library.

Also grids of equal known boxes, as on a pallet, between which hardly a gap shows: which numbers of them fill a space,
and where the grid stands, how it is turned and how wide its gaps are, fitted to the image as of one body.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from derender.detection.solids.image import SIZE, make_row, rotation_of
from derender.render.raycast.depth import Meshes, flat_meshes
from derender.scene.codec.yaml_tree import parse_yaml, read_yaml, to_yaml
from derender.scene.pose import rotation_z
from derender.scene.priors.reading import read_shape
from derender.scene.shapes import Body, shapes
from derender.scene.solids import BOX, CYLINDER, SPHERE

MOST_TRIANGLES = 20_000


@dataclass(frozen=True)
class Known:
    """One object of a library."""

    name: str  # of the object
    shape: str  # registered shape type
    parameters: Mapping[str, float]  # psi by name
    options: Mapping[str, Any]  # a mesh's file
    count: int = 1000  # how many of it there may be

    @cached_property
    def body(self) -> Body:
        """The shape with its numbers."""
        kind = shapes[self.shape]
        psi = [self.parameters.get(p.name, p.default) for p in kind.parameters]
        return Body(kind, np.array(psi, dtype=float), self.options)

    @cached_property
    def size(self) -> np.ndarray:
        """(3,) full extents along its own axes."""
        return np.asarray(self.body.size(), float)

    @cached_property
    def proxy(self) -> int:
        """The kind of solid that stands for it where solids must not enter each other: a mesh's oriented box."""
        kind = self.body.shape.solid_kind
        return kind if kind in (CYLINDER, SPHERE) else BOX

    @cached_property
    def meshes(self) -> Meshes:
        """Its triangles, in object axes, as the ray caster draws them."""
        if self.shape == "sphere":
            import trimesh

            mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.5 * float(self.size[0]))
        else:
            mesh = self.body.shape.mesh(self.body.psi, self.options)
        return flat_meshes(((np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int32)),))

    def resting(self) -> list[np.ndarray]:
        """Return the ways in which it may lie, (3, 3) rotations, object to floor: one of its own axes down, turned
        about it by eighths, once where its symmetry makes several one."""
        found: list[np.ndarray] = []
        eighths = [rotation_z(k * np.pi / 4)[:3, :3] for k in range(8)]
        for down in range(3):
            for sign in (1.0, -1.0):
                z = np.zeros(3)
                z[down] = -sign
                x = np.roll(np.eye(3)[down], 1)
                way = np.stack([x, np.cross(z, x), z])
                for spin in eighths:
                    rotation = spin @ way
                    if not any(self.same(rotation, other) for other in found):
                        found.append(rotation)
        return found

    def same(self, first: np.ndarray, second: np.ndarray) -> bool:
        """Whether the object looks the same under two rotations (3, 3)."""
        symmetry = self.body.shape.symmetry
        if symmetry.axis == "all":
            return True
        relative = first.T @ second
        if symmetry.axis == "z":
            return bool(abs(relative[2, 2]) > 0.999)
        return bool(any(np.trace(relative @ other) > 2.999 for other in symmetry.rotations))


def read_library(given: str | Path | Mapping[str, Any]) -> tuple[Known, ...]:
    """Read a library of known objects. given : its file; or a mapping of what stands there under `known`, by name.

    Raises DerenderError : with file, line and address; a distribution where a number is needed; a mesh that is missing,
        has too many triangles, or is metres long (it was written in millimetres: give scale: 0.001).
    """
    if isinstance(given, Mapping):
        top, folder = parse_yaml(to_yaml({"known": given}, {"known": 1}), "known"), Path.cwd()
    else:
        top, folder = read_yaml(given), Path(given).resolve().parent
    top.allow("derender", "known")
    if "known" not in top:
        raise top.fault("no objects are listed", "write known: and below it name: {type: ..., ...}")
    library = []
    for name, node in top["known"].section().items():
        prior = read_shape(node, folder, ("count",))
        if not shapes[prior.type].bounded:
            raise node.fault(f"a {prior.type} has no size", "known objects are solids")
        if "." in name or name in ("root", "floor"):
            raise node.fault(f"{name!r} cannot name an object", "take a name without a dot that is not root or floor")
        for key, value in prior.values.items():
            if not isinstance(value, int | float):
                raise node.fault(f"its {key} is a distribution", "a known object has known numbers")
        section = node.section() if hasattr(node, "nodes") else {}
        count = section["count"].integer(lower=1) if "count" in section else 1000
        numbers = {key: float(value) for key, value in prior.values.items()}  # type: ignore[arg-type]
        item = Known(name, prior.type, numbers, dict(prior.options), count)
        if item.size.max() > 2.0:
            remedy = "give scale: 0.001 for a mesh in millimetres" if item.shape == "mesh" else "lengths are metres"
            raise node.fault(f"it is {item.size.max():.4g} m long", remedy)
        if len(item.meshes.triangles) > MOST_TRIANGLES:
            what = f"the mesh has {len(item.meshes.triangles)} triangles, more than {MOST_TRIANGLES}"
            raise node.fault(what, "simplify it, or leave hull: true")
        library.append(item)
    if not library:
        raise top["known"].fault("no objects are listed", "below known: write name: {type: ..., ...}")
    return tuple(library)


GAP = 0.006  # metres between neighbours, at most
INEXACT = 0.01  # metres by which a large box's sides may be wrong
LEVEL = 0.99  # cosine of the large box's tilt
MOST = 64  # of cells
# Metres by which a grid's faces are moved when it is fitted, coarse to fine: ten thousand pixels of a face tell its
# place to a thirtieth of a millimetre; a grid that was off by a quarter lost 14 nats to a single box in its place.
STEPS = 0.016 * 0.5 ** np.arange(10)
# Metres by which a grid's foot may be off the floor, which other pixels tell: .2 mm cost one of 18 cartons 68 nats, and
# one box of free sizes nothing.
OFF_THE_FLOOR = 0.001


class Space(NamedTuple):
    """An upright box that may be a grid: middle (2,) on the floor, metres; its lower end's height; radians about the
    vertical; size (3,); metres by which that may be wrong (3,)."""

    middle: np.ndarray
    bottom: float
    yaw: float
    size: np.ndarray
    inexact: np.ndarray


class Layout(NamedTuple):
    """How a known box fills a space: which of its own axes lies along each of the grid's; counts (3,) along these."""

    known: Known
    axes: tuple[int, ...]
    counts: np.ndarray

    @property
    def piece(self) -> np.ndarray:
        """(3,) metres of one box along the grid's axes."""
        return self.known.size[list(self.axes)]


def space_of(row: np.ndarray, base: float = np.nan) -> Space | None:
    """Return the Space that a solid's row (ROW,) fills; None where it is no upright box.
    base : height of what it stands on; NaN: of its own lower end."""
    rotation = rotation_of(row)
    if int(row[0]) != BOX or abs(rotation[2, 2]) < LEVEL:
        return None
    bottom = float(row[12] - 0.5 * row[15]) if np.isnan(base) else base
    yaw = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
    return Space(row[10:12], bottom, yaw, row[13:16], np.full(3, INEXACT))


def layouts_of(space: Space, known: Known) -> list[Layout]:
    """Return the Layouts of a known box that fill a space but for gaps, the narrowest gaps first."""
    if known.body.shape.solid_kind != BOX:
        return []
    fitting: list[tuple[float, Layout]] = []
    for axes in permutations(range(3)):
        piece = known.size[list(axes)]
        count = np.maximum(np.rint((space.size + space.inexact) / (piece + 0.5 * GAP)), 1.0)
        spare = space.size - count * piece
        within = np.all(spare > -space.inexact) and np.all(spare < (count - 1.0) * GAP + space.inexact)
        if within and 1 < count.prod() <= MOST:
            fitting.append((float(np.abs(spare).sum()), Layout(known, axes, count.astype(int))))
    return [layout for _, layout in sorted(fitting, key=lambda each: each[0])]


def numbers_of(space: Space, layout: Layout) -> np.ndarray:
    """Return the (5,) numbers of a grid that fills a space: x, y, yaw, and the gaps along its two level axes."""
    spare = space.size - layout.counts * layout.piece
    gaps = np.clip(spare / np.maximum(layout.counts - 1, 1), 0.0, GAP)
    return np.array([*space.middle, space.yaw, *gaps[:2]])


def cells_of(layout: Layout, numbers: np.ndarray, bottom: float) -> np.ndarray:
    """Return the rows (N, ROW) of a grid's boxes, lowest first. numbers : see `numbers_of`; bottom : metres."""
    rotation = rotation_z(numbers[2])[:3, :3]
    own = rotation[:, np.argsort(layout.axes)]  # columns: the known box's own axes
    own[:, 2] *= np.sign(np.linalg.det(own))
    pitch = layout.piece + [*numbers[3:5], 0.0]
    middle = np.array([*numbers[:2], bottom + 0.5 * layout.counts[2] * layout.piece[2]])
    places = sorted(np.ndindex(*layout.counts), key=lambda each: each[2])
    offsets = (np.array(places) - 0.5 * (layout.counts - 1)) * pitch
    return np.array([make_row(BOX, own, middle + rotation @ offset, layout.known.size) for offset in offsets])


def hull_of(layout: Layout, numbers: np.ndarray, bottom: float) -> np.ndarray:
    """Return the rows (1, ROW) of the one box that a grid fills, gaps and all."""
    size = layout.counts * layout.piece + np.append((layout.counts[:2] - 1) * numbers[3:5], 0.0)
    return make_row(BOX, rotation_z(numbers[2])[:3, :3], np.array([*numbers[:2], bottom + 0.5 * size[2]]), size)[None]


def with_gaps(layout: Layout, numbers: np.ndarray, gaps: tuple[float, ...], origin: np.ndarray) -> np.ndarray:
    """Return the numbers of a grid with other gaps whose faces towards the camera stay where they are."""
    axes = rotation_z(numbers[2])[:2, :2]
    found = np.array([*numbers[:3], *gaps])
    grown = (hull_of(layout, found, 0.0) - hull_of(layout, numbers, 0.0))[0, SIZE : SIZE + 2]
    found[:2] += axes @ (0.5 * np.sign(axes.T @ (numbers[:2] - origin[:2])) * grown)
    return found


def fitted(
    space: Space, layout: Layout, misfit: Callable[[np.ndarray], float], origin: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return (misfit, rows (N, ROW)) of a layout, moved and its gaps changed while that explains the image better.

    As the one box that it fills first, and then as its boxes, from there or with other gaps.

    misfit : of the image, of rows (N, ROW). origin : (3,) the camera's centre.
    """
    scale = np.array([1.0, 1.0, 2.0 / float(space.size[:2].max()), *(1.0 / np.maximum(layout.counts[:2] - 1, 1)), 1.0])
    low, high = (np.array([*np.full(3, end), *gaps, np.copysign(OFF_THE_FLOOR, end)]) for end, gaps in
                 ((-np.inf, np.zeros(2)), (np.inf, GAP * (layout.counts[:2] > 1))))  # fmt: skip

    # A gap is changed by itself, the grid's middle staying, and with the faces staying that are seen best.
    ways = [*((k, False) for k in range(6)), (3, True), (4, True)]

    def rows_at(rows, numbers):
        """Return the rows of numbers (6,): those of `numbers_of`, and by how much the bottom is higher."""
        return rows(layout, numbers, space.bottom + numbers[5])

    def searched(rows, numbers):
        """Return (misfit, numbers) of a pattern search: each number by its step while that helps, then by its half."""
        least = misfit(rows_at(rows, numbers))
        for step in STEPS:
            better = True
            while better:
                better = False
                for (k, faces_stay), sign in product(ways, (1.0, -1.0)):
                    trial = numbers.copy()
                    if k < 2:  # along its own axes, on which its faces depend one by one
                        trial[:2] += sign * step * rotation_z(numbers[2])[:2, k]
                    else:
                        trial[k] = np.clip(trial[k] + sign * step * scale[k], low[k], high[k])
                    if faces_stay:
                        trial = np.append(with_gaps(layout, numbers, tuple(trial[3:5]), origin), numbers[5])
                    if (trial != numbers).any() and (found := misfit(rows_at(rows, trial))) < least:
                        least, numbers, better = found, trial, True
        return least, numbers

    _, whole = searched(hull_of, np.append(numbers_of(space, layout), 0.0))
    starts = [whole, *(np.append(with_gaps(layout, whole, gaps, origin), whole[5])
                       for gaps in product(*(np.linspace(0.0, most, 4) for most in high[3:5])))]  # fmt: skip
    least, found = searched(cells_of, min(starts, key=lambda each: misfit(rows_at(cells_of, each))))
    return least, rows_at(cells_of, found)
