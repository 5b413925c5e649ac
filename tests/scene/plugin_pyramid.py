"""A plug-in as another package would write it: one shape and one contact type in one small file."""

import numpy as np

from derender.registry import Parameter
from derender.scene.contacts import ContactType, Inverse, contacts
from derender.scene.shapes import Face, Outline, Shape, box_face, shapes


@shapes.register("pyramid")
class Pyramid(Shape):
    """A square pyramid with its top cut off at half the base's side."""

    parameters = (Parameter("base", "m", 0.0, np.inf), Parameter("height", "m", 0.0, np.inf))
    face_names = ("+z", "-z")

    def size(self, psi, options={}):  # noqa: B006
        return np.array([psi[0], psi[0], psi[1]])

    def psi_from_size(self, size, options={}):  # noqa: B006
        return np.array([0.5 * (size[0] + size[1]), size[2]])

    def face(self, name, psi, options={}):  # noqa: B006
        if name not in self.face_names:
            raise self.no_such_face(name)
        side = psi[0] if name == "-z" else 0.5 * psi[0]
        return Face(box_face(name, self.size(psi)).frame, Outline(side, side))

    def face_order(self, name):
        return 4

    def mesh(self, psi, options={}):  # noqa: B006
        import trimesh

        square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.5 * psi[0]
        low, high = np.full((4, 1), -0.5 * psi[1]), np.full((4, 1), 0.5 * psi[1])
        return trimesh.convex.convex_hull(np.vstack([np.hstack([square, low]), np.hstack([0.5 * square, high])]))


@contacts.register("concentric")
class Concentric(ContactType):
    """Two flat faces flush and centre on centre: theta alone is free."""

    def choices(self, parent, child):
        return contacts["face-to-face"].choices(parent, child) if parent.bounded and child.bounded else []

    def parameters(self, parent, child, parent_face, child_face):
        theta, *_ = contacts["face-to-face"].parameters(parent, child, parent_face, child_face)
        return (theta,)

    def relative_pose(self, values, parent, child, parent_face, child_face):
        return contacts["face-to-face"].relative_pose(values, parent, child, parent_face, child_face)

    def invert(self, relative, parent, child, parent_face, child_face):
        found = contacts["face-to-face"].invert(relative, parent, child, parent_face, child_face)
        theta = found.values["theta"]
        nearest = self.relative_pose({"theta": theta}, parent, child, parent_face, child_face)
        outside = float(np.linalg.norm(nearest[:3, 3] - relative[:3, 3]))
        theta_is_free = [p for p in self.parameters(parent.shape, child.shape, parent_face, child_face) if not p.slack]
        phi, slack = ({"theta": theta}, {}) if theta_is_free else ({}, {"theta": theta})
        return Inverse(phi, slack, outside if outside > 1e-12 else 0.0, found.angle)
