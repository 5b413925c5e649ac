"""The compiled ray caster as a renderer."""

from derender.vision.raycast.depth import render_depth

__all__ = ["render_depth"]
