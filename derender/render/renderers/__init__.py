"""Renderers behind one interface: posed solids and a camera in, depth and labels out.

A renderer is a module with

    render_depth(solids, camera, antialias=1, background=nan) -> depth, label

depth is (height, width) float64 in metres, `background` where nothing is hit; label is (height, width) int32, the index
into the solids or -1. Each is imported when it is first asked for.
"""

import importlib
from typing import Any

from derender.errors import DerenderError
from derender.registry import suggest

RENDERERS = {"raycast": "derender.render.raycast.depth", "pyrender": "derender.render.renderers.opengl"}


def find_renderer(name: str) -> Any:
    """Import and return a renderer by name. Raises DerenderError : no renderer of that name; says which there are."""
    if name not in RENDERERS:
        raise DerenderError(f"no renderer is called {name!r}", remedy=suggest(name, RENDERERS))
    return importlib.import_module(RENDERERS[name])
