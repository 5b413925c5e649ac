"""What commands take as SCENE-or-DIR: a scene file, or a folder that `derender infer` wrote."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from derender.errors import DerenderError

if TYPE_CHECKING:
    import numpy as np

    from derender.inference.posterior import Posterior
    from derender.model.scene import SceneGraph
    from derender.vision.camera import Camera


class Found(NamedTuple):
    """A scene, and what else its file or folder holds.

    Attributes
    ----------
    name : of the scene, for titles and files.
    graph : the scene; of a posterior, its most probable one.
    posterior, camera : or None.
    likelihood : its numbers by name, {} where there is none.
    """

    name: str
    graph: "SceneGraph"
    posterior: "Posterior | None"
    camera: "Camera | None"
    likelihood: Mapping[str, Any] = {}


def read_scene(path: str) -> Found:
    """Read a scene file (`-`: stdin) or a folder written by `derender infer`.

    Raises
    ------
    DerenderError : no such file or folder, a folder without a scene, or a prior where a scene is needed.
    """
    from derender.document import read_document
    from derender.report.html import likelihood_numbers

    folder = Path(path)
    if path == "-" or not folder.is_dir():
        document = read_document(path)
        return Found(
            "scene" if path == "-" else folder.stem,
            document.graph,
            None,
            document.camera,
            likelihood_numbers(document.likelihood),
        )
    name = folder.resolve().name
    written = folder / "scene.yaml"
    best = read_document(written) if written.exists() else None
    if (folder / "posterior.npz").exists():
        from derender.inference.posterior import load

        posterior = load(folder)
        return Found(
            name,
            posterior.best_graph(),
            posterior,
            best.camera if best else None,
            likelihood_numbers(best.likelihood if best else None),
        )
    if best is None:
        raise DerenderError("there is no scene in this folder", path, "derender infer IMAGE -o DIR writes one")
    return Found(name, best.graph, None, best.camera, likelihood_numbers(best.likelihood))


def read_observation(folder: str | Path) -> "tuple[np.ndarray, Camera] | None":
    """Return the image from which the posterior in a folder was inferred, and its camera; None if it is not there."""
    from derender.vision.depth_file import read_depth

    path = Path(folder) / "observation.npz"
    if not path.exists():
        return None
    image = read_depth(path)
    return image.depth, image.camera
