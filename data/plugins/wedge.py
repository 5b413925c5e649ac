"""A shape of one's own: import this file, or announce it as an entry point, and scene files know the type `wedge`."""

import numpy as np
import trimesh

from derender.registry import Parameter
from derender.scene.shapes import Shape, box_face, shapes


@shapes.register("wedge")
class Wedge(Shape):
    """A ramp: a box cut from its upper edge at -x to its lower edge at +x."""

    parameters = tuple(Parameter(name, "m", 0.0, np.inf) for name in ("length", "width", "height"))
    face_names = ("-x", "-z")

    def size(self, psi, options=None):
        return np.array(psi, dtype=float)

    def psi_from_size(self, size, options=None):
        return np.array(size, dtype=float)

    def face(self, name, psi, options=None):
        if name not in self.face_names:
            raise self.no_such_face(name)
        return box_face(name, np.asarray(psi, dtype=float))

    def mesh(self, psi, options=None):
        corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1) if not (x == 1 and z == 1)]
        return trimesh.convex.convex_hull(np.array(corners) / 2 * psi)
