"""A free-form thing: a body that no primitive explains, as a closed surface in the axes of its bounding box.

The surface is kept with the object, as text, so that a scene file is whole by itself.
"""

import base64
import binascii
import struct
import zlib
from functools import lru_cache
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.scene.shapes.base import FACE_NAMES, NONE, SIDES, Options, Psi, Shape, shapes
from derender.scene.shapes.box import box_mesh

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
        import trimesh

        vertices, triangles = self.surface(options)
        return trimesh.Trimesh(vertices * np.asarray(psi, float), triangles, process=False)

    def drawn_mesh(self, psi: Psi, options: Options = NONE) -> Any:
        return ("thing", options.get("surface")), self.surface(options)

    def check(self, psi: Psi, options: Options = NONE, where: object = None) -> None:
        super().check(psi, options, where)
        self.surface(options)
