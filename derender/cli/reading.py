"""What commands take as SCENE-or-DIR: a scene file, or a folder that `derender infer` wrote."""

from collections.abc import Iterator, Sequence
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from derender.atomic import check_files
from derender.errors import DerenderError

if TYPE_CHECKING:
    import numpy as np

    from derender.camera.intrinsics import Camera
    from derender.document import Document, LikelihoodPrior
    from derender.results.posterior import Posterior
    from derender.scene.graph import SceneGraph
    from derender.scene.priors.tree import Prior


class Found(NamedTuple):
    """A scene, or draws of one, and what else a file or folder holds."""

    name: str  # of the scene, for titles and files
    graph: "SceneGraph"  # the scene; of a posterior its most probable one, of a prior the first drawn
    camera: "Camera | None"
    prior: "Prior | None" = None  # where the scene was drawn from one
    posterior: "Posterior | None" = None
    likelihood: "LikelihoodPrior | None" = None  # how its images come about

    @property
    def missed(self) -> float:
        """See `Posterior.missed`."""
        return 0.0 if self.posterior is None else self.posterior.missed

    @property
    def uncertain(self) -> bool:
        """Whether draws differ."""
        from derender.scene.priors.reading import is_drawn

        if self.posterior is not None:
            return self.posterior.uncertain
        return self.prior is not None or any(is_drawn(vertex.options) for vertex in self.graph.vertices)

    def draws(self, rng: "np.random.Generator", count: int) -> "Iterator[SceneGraph]":
        """Return so many scenes, one by one."""
        from derender.scene.priors.reading import with_drawn_matter

        if self.posterior is not None:
            return self.posterior.each_graph(rng, count)
        if (prior := self.prior) is None:
            return repeat(self.graph, count)
        return (with_drawn_matter(prior.sample(rng), rng) for _ in range(count))


def read_scene_document(path: str) -> "Document":
    """Read a scene or prior file (`-`: stdin), or the most probable scene in a folder written by `derender infer`."""
    from derender.document import built_in_priors, read_document
    from derender.report.result_folder import WRITTEN

    folder = Path(path)
    if path in built_in_priors() and not folder.exists():
        raise DerenderError("this is a prior, not a scene", path, f"draw a scene: derender sample {path}")
    if path == "-" or not folder.is_dir():
        return read_document(path)
    if not (folder / "scene.yaml").exists():
        raise no_scene(folder)
    check_files(folder, WRITTEN)
    return read_document(folder / "scene.yaml")


def no_scene(folder: Path) -> DerenderError:
    """Return what is wrong with a folder that holds no scene."""
    if (folder / "track.json").exists():
        remedy = "derender view shows it, and its track.json holds the poses"
        return DerenderError("this folder holds a film, not a scene", folder, remedy)
    inside = sorted(folder.glob("**/scene.yaml"))
    if inside:
        what = f"this folder holds {len(inside)} result{'s' * (len(inside) != 1)}"
        return DerenderError(what, folder, f"name one, such as {inside[0].parent}")
    return DerenderError("there is no scene in this folder", folder, "derender infer IMAGE -o DIR writes one")


def read_scene(path: str, seed: int | None = None) -> Found:
    """Read a scene file (`-`: stdin) or a folder written by `derender infer`.

    seed : of the first draw from a prior, where one (by its file or its name) may be given in place of a scene.

    Raises DerenderError : no such file or folder, a folder without a scene, or a prior where a scene is needed.
    """
    from derender.document import read_prior_document
    from derender.posterior.forward import draw_documents

    folder = Path(path)
    name = "scene" if path == "-" else folder.resolve().name if folder.is_dir() else folder.stem
    by_name = seed is None or (path != "-" and folder.is_dir())
    document = read_scene_document(path) if by_name else read_prior_document(path)
    if path != "-" and (folder / "posterior.npz").exists():
        from derender.results.posterior import load

        posterior = load(folder)
        return Found(name, posterior.best_graph(), document.camera, None, posterior, document.likelihood)
    if seed is not None and not document.is_scene:
        (drawn,) = draw_documents(document, 1, seed, {})  # the one that `derender sample` writes
        return Found(name, drawn.graph, document.camera, document.prior, likelihood=drawn.likelihood)
    return Found(name, document.graph, document.camera, likelihood=document.likelihood)


def drawn_scenes(path: str, count: int, seed: int) -> "Iterator[Found]":
    """Yield the scenes that `derender sample PRIOR -n COUNT --seed SEED` draws, named after its files.

    Raises DerenderError : what is there is no prior.
    """
    from derender.document import read_prior_document
    from derender.posterior.forward import draw_documents

    folder = Path(path)
    document = read_scene_document(path) if path != "-" and folder.is_dir() else read_prior_document(path)
    if document.is_scene:
        raise DerenderError("this is a scene, not a prior: nothing is drawn", path, "leave out -n")
    for number, drawn in enumerate(draw_documents(document, count, seed, {})):
        name = f"{'prior' if path == '-' else folder.stem}/{sample_name(number, count)}"
        yield Found(name, drawn.graph, drawn.camera, likelihood=drawn.likelihood)


def sample_name(number: int, count: int) -> str:
    """Return the name, without suffix, of the files of a scene of so many that were drawn from a prior."""
    return f"sample_{number:0{max(3, len(str(count - 1)))}d}"


def scene_paths(paths: "Sequence[str]") -> list[str]:
    """Return the scenes meant: a folder without a scene of its own stands for the scenes and results in it."""
    found: list[str] = []
    for path in paths:
        folder = Path(path)
        if path == "-" or not folder.is_dir() or (folder / "scene.yaml").exists():
            found.append(path)
            continue
        inside = [str(each) for each in sorted(folder.glob("*.yaml"))]
        inside += [str(each.parent) for each in sorted(folder.glob("*/scene.yaml"))]
        if not inside:
            raise no_scene(folder)
        found += inside
    return found


def read_observation(folder: str | Path) -> "tuple[np.ndarray, Camera] | None":
    """Return the image from which the posterior in a folder was inferred, and its camera; None if it is not there."""
    from derender.camera.depth_file import read_depth

    path = Path(folder) / "observation.npz"
    if not path.exists():
        return None
    image = read_depth(path)
    if image.camera_is_guess:
        raise DerenderError("it holds no camera", path, "infer again, or move it away")
    return image.depth, image.camera


def read_explained(folder: str | Path, shape: tuple[int, int]) -> "np.ndarray | None":
    """Return the depths (H, W) that explain the image of a result folder, NaN where nothing does; None without them.

    shape : (H, W) of the image.
    """
    from derender.camera.image_files import read_numbers

    try:
        depth = read_numbers(Path(folder) / "explained.npy", "the explained depths", "")
    except DerenderError:
        return None
    return depth.astype(float) if depth.shape == shape and depth.dtype.kind == "f" else None


MOVING = {".gif": "image/gif", ".webp": "image/webp"}  # media types of animations that a page can hold
MOST_MOVING = 8_000_000  # bytes of one


def read_simulation(folder: str | Path) -> tuple[dict[str, Any], list[str]]:
    """Return what simulation.json of a result folder says, {} where there is none, and its animation as a data: URI.

    Only the one that was made with it and lies beside it: others show other simulations.
    """
    import json

    from derender.report.pictures import data_uri
    from derender.report.result_folder import SIMULATION

    try:
        told = json.loads((Path(folder) / SIMULATION).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}, []
    if not isinstance(told, dict):
        return {}, []
    path = Path(folder) / Path(str(told.get("animation"))).name
    kind = MOVING.get(path.suffix.lower())
    if kind is None or not path.is_file() or path.stat().st_size > MOST_MOVING:
        return told, []
    return told, [data_uri(kind, path.read_bytes())]
