"""A scene for use from Python: its graph, the camera that sees it, and what one does with them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from derender.camera.depth_file import SHOWN_WIDTH, DepthImage
from derender.camera.intrinsics import Camera
from derender.document import LikelihoodPrior, document_text, write_document
from derender.posterior.forward import HEIGHT, WIDTH
from derender.registry import only_its_keywords
from derender.report.export import export_mjcf, export_scene
from derender.report.geometry import solid_mesh
from derender.report.pictures import png_uri, shade
from derender.report.scene_json import scene_json
from derender.results.table import extents_text
from derender.scene.graph import SceneGraph
from derender.scene.solids import PLANE

if TYPE_CHECKING:
    import trimesh

    from derender.interface.functions import Acts, Simulation


@dataclass(frozen=True, repr=False)
class Scene:
    """A scene graph with the camera that sees it.

    graph : the scene graph.
    camera : or None, where its file has none.
    likelihood : how its images come about (noise, blur), or None.

    >>> import derender
    >>> scene = derender.sample("stack", seed=0)
    >>> scene.names
    ('floor', 'green', 'red', 'yellow')
    >>> scene.poses["yellow"].shape  # object to camera, metres
    (4, 4)
    >>> scene.sizes["yellow"].shape  # full extents along its own axes, metres
    (3,)
    """

    graph: SceneGraph
    camera: Camera | None = None
    likelihood: LikelihoodPrior | None = None

    def __repr__(self) -> str:
        return f"<Scene: {', '.join(self.names)}>"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects, in order, floor included."""
        return self.graph.names

    @property
    def poses(self) -> dict[str, np.ndarray]:
        """Pose (4, 4) float64, object to camera, of each object by name."""
        poses = self.graph.poses()
        return {name: poses[name] for name in self.names}

    @property
    def sizes(self) -> dict[str, np.ndarray]:
        """Full extents (3,) float64 in metres along its own axes, of each object that has a size, by name."""
        found = {name: self.graph.body(name).size() for name in self.names}
        return {name: np.asarray(size, float) for name, size in found.items() if size is not None}

    @property
    def parents(self) -> dict[str, str]:
        """What each object rests on, by name."""
        return {vertex.name: vertex.parent for vertex in self.graph.vertices}

    def to_dict(self) -> dict[str, Any]:
        """Return the scene as `derender show --json` prints it."""
        return scene_json(self.graph)

    def to_yaml(self) -> str:
        """Return the scene file's text."""
        return document_text(self.graph, self.camera, self.likelihood)

    def save(self, path: str | Path) -> None:
        """Write the scene as YAML, or in the format of the suffix: .glb .obj .xml .urdf .json; whole or not at all."""
        if Path(path).suffix.lower() in (".yaml", ".yml"):
            write_document(path, self.graph, self.camera, self.likelihood)
            return
        export_scene(self.graph, path, self.camera, besides=(".yaml",))

    @only_its_keywords
    def render(self, camera: Camera | str | Path | None = None, noise: bool = False, seed: int = 0) -> DepthImage:
        """Return its depth image; see `derender.render`."""
        from derender.interface.functions import render

        return render(self, camera, noise=noise, seed=seed)

    def simulate(self, duration: float = 2.0, **acts: "Unpack[Acts]") -> "Simulation":
        """Return what physics does to it, as under push="red:+x:5N@0.1s"; see `derender.simulate`."""
        from derender.interface.functions import simulate

        return simulate(self, duration=duration, **acts)

    def to_trimesh(self) -> "trimesh.Scene":
        """Return a trimesh.Scene in camera axes, metres: a mesh for each object but planes, by its name.

        >>> import derender
        >>> sorted(derender.sample("stack", seed=0).to_trimesh().geometry)
        ['green', 'red', 'yellow']
        """
        import trimesh

        solids, scene = self.graph.solids(), trimesh.Scene()
        for index, name in enumerate(self.graph.solid_names):
            if solids.kind[index] != PLANE:
                vertices, triangles = solid_mesh(solids, index)
                mesh = trimesh.Trimesh(vertices, triangles, process=False)
                scene.add_geometry(mesh, node_name=name, geom_name=name, transform=solids.pose[index])
        return scene

    def to_mjcf(self) -> str:
        """Return the scene as MJCF, the XML that MuJoCo loads; z is up there. Meshes need `save("scene.xml")`.

        >>> import derender
        >>> derender.sample("stack", seed=0).to_mjcf()[:7]
        '<mujoco'
        """
        (text,) = (data for name, data in export_mjcf(self.graph, Path("scene.xml")).items() if name.endswith(".xml"))
        return text.decode()

    def plot_depth(self, ax: Any = None) -> Any:
        """Draw its depth image into matplotlib axes, new ones by default, and return them."""
        return plot_depth(self.render().depth, ax)

    def _repr_html_(self) -> str:
        rows = [
            (name, self.graph.vertex(name).shape, extents_text(size), self.parents[name])
            for name, size in self.sizes.items()
        ]
        return f"<div>{self.picture_html()}{table_html(('object', 'type', 'size, cm', 'rests on'), rows)}</div>"

    def picture_html(self) -> str:
        """Return a small shaded picture of it for a page."""
        camera = self.camera or Camera.from_field_of_view(WIDTH, HEIGHT)
        camera = camera.downscaled(max(1.0, camera.width / SHOWN_WIDTH))
        return picture_html(shade(self.graph.solids(), camera, self.graph.solid_names), "the scene")


def picture_html(pixels: np.ndarray, words: str) -> str:
    """Return a small picture (H, W, 3) uint8 for a page that needs no network."""
    style = f"width:{SHOWN_WIDTH}px;margin-right:8px;display:inline-block"
    return f'<img src="{png_uri(pixels)}" alt="{escape(words)}" style="{style}">'


def table_html(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of plain texts."""
    lines = ("".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows)
    inside = "".join(f"<tr>{line}</tr>" for line in ("".join(f"<th>{name}</th>" for name in head), *lines))
    return f"<table>{inside}</table>"


def axes_for(ax: Any) -> Any:
    """Return matplotlib axes: those given, or new ones."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots()[1]


def plot_depth(depth: np.ndarray, ax: Any = None) -> Any:
    """Draw a depth image (H, W), metres, into matplotlib axes, and return them."""
    axes = axes_for(ax)
    shown = axes.imshow(np.ma.masked_invalid(depth), cmap="viridis_r", interpolation="nearest")
    axes.figure.colorbar(shown, ax=axes, label="depth, m")
    axes.set_xticks([])
    axes.set_yticks([])
    return axes
