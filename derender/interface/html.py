"""Scenes and posteriors in a notebook: small pictures and a table, all in the page itself, so that it works offline."""

from html import escape

import numpy as np

from derender.camera.intrinsics import Camera
from derender.interface.posterior import Posterior
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
