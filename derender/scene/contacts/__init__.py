"""The library of contacts. A new one is a file with a class under `@contacts.register(name)`, here or elsewhere."""

from derender.scene.contacts.base import ContactType, Inverse, SurfaceContact, contacts

# The built-in types register themselves when they are imported.
from derender.scene.contacts import (  # isort: skip
    corner_on_face,
    edge_on_face,
    face_to_face,
    point_on_face,
    side_on_face,
    six_dof,
)

__all__ = [
    "ContactType",
    "Inverse",
    "SurfaceContact",
    "contacts",
    "corner_on_face",
    "edge_on_face",
    "face_to_face",
    "point_on_face",
    "side_on_face",
    "six_dof",
]
