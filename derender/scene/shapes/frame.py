"""The shape without extent: a coordinate frame, such as the root."""

import numpy as np

from derender.scene.shapes.base import Shape, shapes


@shapes.register("frame")
class Frame(Shape):
    """A coordinate frame: no surface, no parameters; others float in it by `6dof`."""

    solid_kind = None
    bounded = False

    def size(self, psi=(), options={}):  # noqa: B006 - never changed
        return None

    def psi_from_size(self, size=None, options={}):  # noqa: B006
        return np.zeros(0)

    def mesh(self, psi=(), options={}):  # noqa: B006
        import trimesh

        return trimesh.Trimesh()
