"""Make pyrender work without a screen: the one place that imports it and PyOpenGL.

pyrender 0.1.45 is the last release and pins PyOpenGL 3.1.0, which asks for the patches below; each says what it cures.
They are harmless with newer PyOpenGL and with the fork `pyrender2`, which Python 3.13 and later need.
"""

import ctypes
import ctypes.util
import functools
import os
import sys
import types
from collections.abc import Callable
from typing import Any

import numpy as np

from derender.errors import DerenderError

PLATFORMS = {"osmesa": "OSMesa", "egl": "EGL"}  # our order of preference, and the library that each needs
REMEDY = "install it (apt-get install libosmesa6, or libegl1 libgl1-mesa-dri libopengl0 libgl1), or use raycast"
# Constants of <GL/osmesa.h>
OSMESA_ATTRIBUTES = {
    "OSMESA_DEPTH_BITS": 0x30,
    "OSMESA_STENCIL_BITS": 0x31,
    "OSMESA_ACCUM_BITS": 0x32,
    "OSMESA_PROFILE": 0x33,
    "OSMESA_CORE_PROFILE": 0x34,
    "OSMESA_COMPAT_PROFILE": 0x35,
    "OSMESA_CONTEXT_MAJOR_VERSION": 0x36,
    "OSMESA_CONTEXT_MINOR_VERSION": 0x37,
}


def choose_platform() -> str:
    """Return "osmesa" or "egl": what PYOPENGL_PLATFORM names, else the first whose library is here.

    Raises DerenderError : neither library is installed.
    """
    named = os.environ.get("PYOPENGL_PLATFORM")
    if named in PLATFORMS:
        return named
    for platform, library in PLATFORMS.items():
        if ctypes.util.find_library(library):
            return platform
    raise DerenderError("OpenGL cannot draw here: neither OSMesa nor EGL is installed", remedy=REMEDY)


@functools.cache
def load_pyrender() -> types.ModuleType:
    """Import pyrender, patched; see the module's docstring.

    Raises DerenderError : pyrender or an OpenGL library is missing.
    """
    platform = choose_platform()
    os.environ["PYOPENGL_PLATFORM"] = platform
    try:
        # The viewer's pyglet wants X11 at import; nobody looks at a window here.
        viewer = types.ModuleType("pyrender.viewer")
        viewer.Viewer = None  # type: ignore[attr-defined]
        sys.modules.setdefault("pyrender.viewer", viewer)
        if not hasattr(np, "infty"):
            setattr(np, "infty", np.inf)  # noqa: B010  # pyrender's name, gone from numpy 2
        if platform == "osmesa":
            _patch_osmesa()
        import pyrender
        import pyrender.renderer
    except (ImportError, AttributeError, OSError) as error:
        why = ": ".join(str(part) for part in error.args[:2])  # PyOpenGL gives several
        raise DerenderError(f"OpenGL cannot draw here: {why}", f"pyrender on {platform}", REMEDY) from error
    # A multisample buffer is resolved to one off-centre sample: depth wrong by millimetres.
    pyrender.renderer.glRenderbufferStorageMultisample = _single_sample(pyrender.renderer.glRenderbufferStorage)
    return pyrender


def _single_sample(storage: Any) -> Callable[..., Any]:
    def allocate(target, samples, form, width, height):
        storage(target, form, width, height)

    return allocate


def _patch_osmesa() -> None:
    import OpenGL.osmesa
    import OpenGL.platform

    # As an opaque pointer a context is a new object at each call, so that PyOpenGL and pyrender's shader cache never
    # know it again: every draw recompiles and leaks. As an address it is equal to itself.
    current = OpenGL.platform.PLATFORM.GetCurrentContext
    current.restype = ctypes.c_void_p
    OpenGL.platform.GetCurrentContext = current
    OpenGL.platform.CurrentContextIsValid = current
    if hasattr(OpenGL.osmesa, "OSMesaCreateContextAttribs"):
        return
    # PyOpenGL 3.1.0 lacks the only call that gives a core profile.
    create = OpenGL.platform.PLATFORM.OSMesa.OSMesaCreateContextAttribs
    create.argtypes = [ctypes.POINTER(ctypes.c_int), ctypes.c_void_p]
    create.restype = OpenGL.osmesa.OSMesaContext
    OpenGL.osmesa.OSMesaCreateContextAttribs = lambda attributes, share: create(
        (ctypes.c_int * len(attributes))(*attributes), share
    )
    for name, value in OSMESA_ATTRIBUTES.items():
        setattr(OpenGL.osmesa, name, value)
