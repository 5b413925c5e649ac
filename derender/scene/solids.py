"""The solids of a posed scene as flat arrays: all that renderers, overlap tests and the engine need to know."""

from typing import NamedTuple

import numpy as np

PLANE, BOX, SPHERE, CYLINDER, MESH = range(5)
KINDS = {"plane": PLANE, "cube": BOX, "box": BOX, "sphere": SPHERE, "cylinder": CYLINDER, "mesh": MESH}


class Solids(NamedTuple):
    """Posed solids of a scene, in the order of its vertices.

    size : (N, 3) float64, full extents in metres along the object's axes (sphere: three diameters; cylinder: diameter,
        diameter, height; plane: zeros; mesh: extents of its oriented box as scaled).
    meshes : tuple of (vertices (V, 3) float64 in metres at scale 1 in the axes of the oriented box, triangles (T, 3)
        int32); a drawn vertex is its vertex times size / extents.
    """

    kind: np.ndarray  # (N,) int32, one of PLANE, BOX, SPHERE, CYLINDER, MESH
    pose: np.ndarray  # (N, 4, 4) float64, object to camera
    size: np.ndarray
    mesh: np.ndarray  # (N,) int32, index into `meshes`, or -1
    meshes: tuple[tuple[np.ndarray, np.ndarray], ...] = ()
