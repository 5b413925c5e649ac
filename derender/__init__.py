"""derender: from one depth image to a posterior over scene graphs, and on to physics.

>>> import derender
>>> scene = derender.sample("stack", seed=1)                     # a Scene
>>> image = derender.render(scene, noise=True, seed=1)           # a DepthImage
>>> posterior = derender.infer(image, quick=True)                # a Posterior
>>> posterior.best.names[0]
'floor'

Importing it takes a few milliseconds: what is behind a name is imported when the name is first used.
"""

import importlib
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

__all__ = ["Camera", "DepthImage", "Posterior", "Scene", "infer", "load", "read_depth", "render", "sample", "simulate"]

if TYPE_CHECKING:
    from derender.camera.depth_file import DepthImage as DepthImage
    from derender.camera.intrinsics import Camera as Camera
    from derender.errors import DerenderError as DerenderError
    from derender.interface.functions import infer as infer
    from derender.interface.functions import load as load
    from derender.interface.functions import read_depth as read_depth
    from derender.interface.functions import render as render
    from derender.interface.functions import sample as sample
    from derender.interface.functions import simulate as simulate
    from derender.interface.posterior import Posterior as Posterior
    from derender.interface.scene import Scene as Scene

PLACES = {
    **dict.fromkeys(("infer", "load", "read_depth", "render", "sample", "simulate"), "interface.functions"),
    "DepthImage": "camera.depth_file", "Camera": "camera.intrinsics", "Posterior": "interface.posterior",
    "Scene": "interface.scene", "DerenderError": "errors",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in PLACES:
        raise AttributeError(f"module 'derender' has no attribute {name!r}")
    return getattr(importlib.import_module(f"derender.{PLACES[name]}"), name)


class _Package(types.ModuleType):
    """The package itself. Its `render` is the function, also when the room derender.render has been imported."""

    @property
    def render(self) -> Callable[..., Any] | None:
        return __getattr__("render")

    @render.setter
    def render(
        self, room: Any
    ) -> None:  # what an import of the room sets; `from derender.render.x import y` needs it not
        pass


sys.modules[__name__].__class__ = _Package


def __dir__() -> list[str]:
    return sorted([*__all__, "DerenderError", "data_path", "__version__"])


def data_path(name: str) -> Path:
    """Return the path of a file that ships with derender, such as ``priors/tabletop.yaml``.

    A checkout keeps them in ``data/`` at its top; a wheel in ``derender/_data``.
    """
    package = Path(__file__).parent
    installed = package / "_data" / name
    return installed if installed.exists() else package.parent / "data" / name
