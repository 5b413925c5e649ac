"""Scenes and posteriors shown: small pictures and tables in a notebook's page, and plots with matplotlib."""

from html import escape
from typing import Any

import numpy as np

from derender.camera.depth_file import DepthImage
from derender.camera.intrinsics import Camera
from derender.errors import DerenderError
from derender.interface.posterior import SIDES, Posterior
from derender.interface.scene import HEIGHT, WIDTH, Scene
from derender.report import pictures

SHOWN_WIDTH = 240  # pixels of a picture in a notebook


def scene_html(scene: Scene) -> str:
    """Return a shaded picture of a scene and its objects."""
    rows = "".join(
        f"<tr><td>{escape(name)}</td><td>{escape(scene.graph.vertex(name).shape)}</td><td>{_sides(size)}</td>"
        f"<td>{escape(scene.parents[name])}</td></tr>"
        for name, size in scene.sizes.items()
    )
    return f"<div>{_shaded(scene)}{_table(('object', 'type', 'size, cm', 'rests on'), rows)}</div>"


def posterior_html(posterior: Posterior) -> str:
    """Return the observed depth, the best scene, the structures' probabilities and the objects with their errors."""
    shown = ""
    if posterior.image is not None:
        depth = posterior.image.depth
        painted = pictures.paint(depth, *pictures.depth_limits(depth), pictures.DEPTH_ANCHORS)
        shown = _picture(painted, "observed depth")
    rows = "".join(
        f"<tr><td>{escape(found.name)}</td><td>{escape(found.type)}</td><td>{_sides(found.size, found.size_error)}</td>"
        f"<td>{escape(found.parent)}</td><td>{found.probability:.2f}</td></tr>"
        for found in posterior.objects
    )
    likely = "<br>".join(f"{each.probability:.3f} {escape(each.words)}" for each in posterior.structures[:4])
    head = ("object", "type", "size ± 90 %, cm", "rests on", "p")
    return f"<div>{shown}{_shaded(posterior.best)}<p>{likely}</p>{_table(head, rows)}</div>"


def _shaded(scene: Scene) -> str:
    camera = scene.camera or Camera.from_field_of_view(WIDTH, HEIGHT)
    camera = camera.downscaled(max(1.0, camera.width / SHOWN_WIDTH))
    return _picture(pictures.shade(scene.graph.solids(), camera, scene.graph.solid_names), "the scene")


def _picture(pixels: np.ndarray, words: str) -> str:
    style = f"width:{SHOWN_WIDTH}px;margin-right:8px;display:inline-block"
    return f'<img src="{pictures.png_uri(pixels)}" alt="{escape(words)}" style="{style}">'


def _sides(size: np.ndarray, error: np.ndarray | None = None) -> str:
    spread = [""] * 3 if error is None else [f" ± {100 * e:.1f}" for e in error]
    return " × ".join(f"{100 * side:.1f}{more}" for side, more in zip(size, spread, strict=True))


def _table(head: tuple[str, ...], rows: str) -> str:
    return f"<table><tr>{''.join(f'<th>{name}</th>' for name in head)}</tr>{rows}</table>"


MOST_BARS = 12  # structures in one plot


def plot_depth(seen: Any, ax: Any = None) -> Any:
    """Draw a depth image: of a DepthImage, a Scene, a Posterior (the observed one) or an array (H, W) in metres."""
    if isinstance(seen, Posterior):
        if seen.image is None:
            raise DerenderError("the posterior does not have its image", remedy="load the folder, not posterior.npz")
        seen = seen.image
    depth = seen.depth if isinstance(seen, DepthImage) else seen.render().depth if hasattr(seen, "render") else seen
    axes = _axes(ax)
    shown = axes.imshow(np.ma.masked_invalid(np.asarray(depth, float)), cmap="viridis_r", interpolation="nearest")
    axes.figure.colorbar(shown, ax=axes, label="depth, m")
    axes.set_xticks([])
    axes.set_yticks([])
    return axes


def plot_sizes(posterior: Posterior, ax: Any = None) -> Any:
    """Draw the length, width and height of each object with their 90 % ranges, in millimetres."""
    axes, objects = _axes(ax), posterior.objects
    places = np.arange(len(objects))
    for number, side in enumerate(SIDES):
        sizes = [1000 * found.size[number] for found in objects]
        errors = [1000 * found.size_error[number] for found in objects]
        axes.errorbar(places + 0.2 * (number - 1), sizes, errors, fmt="o", capsize=3, label=side)
    axes.set_xticks(places, [found.name for found in objects], rotation=30, ha="right")
    axes.set_ylabel("mm, 90 % range")
    axes.set_ylim(bottom=0)
    axes.legend()
    return axes


def plot_structures(posterior: Posterior, ax: Any = None) -> Any:
    """Draw the probabilities of the structures found, the most probable on top."""
    from derender.report.tree_text import told_structures

    axes = _axes(ax)
    told = told_structures(posterior)[:MOST_BARS][::-1]
    axes.barh([words for _, words in told], [weight for weight, _ in told])
    axes.set_xlim(0, 1)
    axes.set_xlabel("probability")
    return axes


def _axes(ax: Any) -> Any:
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots()[1]
