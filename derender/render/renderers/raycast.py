"""The compiled ray caster as a renderer."""

from derender.render.raycast.depth import render_depth

__all__ = ["render_depth"]
