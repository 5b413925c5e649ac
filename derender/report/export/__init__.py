"""Scenes in the formats of other programs, by suffix: one file for each, found through EXPORTERS.

An exporter is a module with `export(graph, path, camera) -> dict[name, bytes]`: the files to write, the first of which
is the one asked for; others (a material library, meshes) go beside it.
"""

import importlib
from pathlib import Path
from typing import TYPE_CHECKING

from derender.atomic import atomic_path
from derender.errors import DerenderError

if TYPE_CHECKING:
    from derender.camera.intrinsics import Camera
    from derender.scene.graph import SceneGraph

EXPORTERS = {
    ".glb": "derender.report.export.glb",
    ".obj": "derender.report.export.obj",
    ".xml": "derender.report.export.mjcf",
    ".urdf": "derender.report.export.urdf",
    ".json": "derender.report.export.bop",
}


def export_scene(graph: "SceneGraph", path: str | Path, camera: "Camera | None" = None) -> list[Path]:
    """Write a scene in the format of the suffix, and return the names of the files written.

    Raises
    ------
    DerenderError : a suffix that none of the formats has, or a folder that cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in EXPORTERS:
        raise DerenderError(f"no format has the suffix {suffix!r}", path, "choose from " + " ".join(EXPORTERS))
    files = importlib.import_module(EXPORTERS[suffix]).export(graph, path, camera)
    written = []
    for name, data in files.items():
        target = path.parent / name
        with atomic_path(target) as temporary:
            temporary.write_bytes(data)
        written.append(target)
    return written
