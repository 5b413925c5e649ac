"""What is known beforehand: a library of objects with their sizes, or with their meshes.

    known:
      cracker_box: {type: mesh, file: 003_cracker_box.obj}     # scale: 0.001 for one in millimetres
      brick: {type: box, length: 20 cm, width: 10 cm, height: 6 cm, count: 2}

`count` says how many of it there may be (default: any number).  Files are looked for beside the library.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.scene.codec.yaml_tree import read_yaml
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
    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """(V, 3) float64 vertices in object axes, metres, and (T, 3) int32 triangles wound outwards.

        Of a mesh whose outside is not defined every triangle is there twice, once each way round.
        """
        if self.shape == "sphere":
            import trimesh

            mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.5 * float(self.size[0]))
        else:
            mesh = self.body.shape.mesh(self.body.psi, self.options)
        faces = np.asarray(mesh.faces, np.int32)
        if not mesh.is_watertight:
            faces = np.vstack([faces, faces[:, ::-1]])
        elif mesh.volume < 0:
            faces = faces[:, ::-1]
        return np.ascontiguousarray(mesh.vertices, dtype=np.float64), np.ascontiguousarray(faces)

    def resting(self) -> list[np.ndarray]:
        """Return the ways in which it may lie, (3, 3) rotations, object to floor.

        One of its own axes points down, and it is turned about the vertical by multiples of an eighth turn; of ways
        that its symmetry makes one only the first is there.
        """
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


def read_library(path: str | Path) -> tuple[Known, ...]:
    """Read a library of known objects.

    Raises
    ------
    DerenderError : with file, line and address; a distribution where a number is needed; a mesh that is missing, has
        too many triangles, or is metres long (it was written in millimetres: give scale: 0.001).
    """
    top = read_yaml(path).allow("derender", "known")
    if "known" not in top:
        raise top.fault("no objects are listed", "write known: and below it name: {type: ..., ...}")
    library = []
    for name, node in top["known"].section().items():
        prior = read_shape(node, Path(path).resolve().parent, ("count",))
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
        if len(item.triangles[1]) > MOST_TRIANGLES:
            what = f"the mesh has {len(item.triangles[1])} triangles, more than {MOST_TRIANGLES}"
            raise node.fault(what, "simplify it, or leave hull: true")
        library.append(item)
    if not library:
        raise top["known"].fault("no objects are listed", "below known: write name: {type: ..., ...}")
    return tuple(library)


def chosen_library(given: Any) -> tuple[Known, ...]:
    """Return the library for an option: a path, or objects already read."""
    if isinstance(given, str | Path):
        return read_library(given)
    library = tuple(given)
    if not all(isinstance(item, Known) for item in library):
        raise DerenderError("not a library of known objects", remedy="give its file")
    return library
