"""The library of shapes. A new one is a file with a class under `@shapes.register(name)`, here or elsewhere."""

# The built-in types register themselves when they are imported.
from derender.scene.shapes import kinds, mesh  # noqa: F401 - registered by being imported
from derender.scene.shapes.base import POINT, UNBOUNDED, Body, Face, Outline, Shape, Symmetry, box_face, shapes

__all__ = ["POINT", "UNBOUNDED", "Body", "Face", "Outline", "Shape", "Symmetry", "box_face", "shapes"]
