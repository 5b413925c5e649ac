"""The library of contacts. A new one is a file with a class under `@contacts.register(name)`, here or elsewhere."""

# The built-in types register themselves when they are imported.
from derender.scene.contacts import kinds  # noqa: F401 - registered by being imported
from derender.scene.contacts.base import ContactType, Inverse, SurfaceContact, contacts

__all__ = ["ContactType", "Inverse", "SurfaceContact", "contacts"]
