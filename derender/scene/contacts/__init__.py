"""The library of contacts. A new one is a file with a class under `@contacts.register(name)`, here or elsewhere."""

from derender.scene.contacts.base import ContactType, Inverse, SurfaceContact, contacts

# The built-in types register themselves when they are imported.
from derender.scene.contacts import on_face, six_dof  # noqa: F401  # isort: skip

__all__ = ["ContactType", "Inverse", "SurfaceContact", "contacts"]
