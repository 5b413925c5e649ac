"""The library of contacts. A new one is a file with a class under `@contacts.register(name)`, here or elsewhere."""

from derender.scene.contacts.kinds import ContactType, Inverse, SurfaceContact, contacts

__all__ = ["ContactType", "Inverse", "SurfaceContact", "contacts"]
