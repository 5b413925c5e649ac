"""Arrays as pictures, without matplotlib: a report has to be written in a fraction of a second."""

import base64
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from derender.atomic import write_bytes
from derender.camera.image_files import png_bytes
from derender.camera.intrinsics import Camera
from derender.scene.graph import SceneGraph
from derender.scene.pose import inverse
from derender.scene.solids import Solids

if TYPE_CHECKING:
    from derender.physics.next_view import NextView

MISSING = np.array([58, 58, 64], dtype=np.uint8)
LEVELS = 255  # colours of a map: with that of what is missing they make a palette

# Anchors of two maps, evenly spaced: viridis (perceptually even, for depth) and red - white - blue (for residuals).
DEPTH_ANCHORS = ("fde725", "90d743", "35b779", "21918c", "31688e", "443983", "440154")
RESIDUAL_ANCHORS = ("2166ac", "67a9cf", "d1e5f0", "f7f7f7", "fddbc7", "ef8a62", "b2182b")

NAMED_COLOURS = {
    "red": (214, 80, 70),
    "green": (110, 175, 85),
    "blue": (70, 145, 200),
    "yellow": (240, 195, 70),
    "orange": (235, 150, 60),
    "purple": (146, 104, 172),
    "brown": (160, 120, 90),
    "black": (60, 60, 62),
    "white": (238, 238, 235),
    "grey": (150, 150, 150),
}


def data_uri(kind: str, data: bytes) -> str:
    """Return bytes of a media type as a data: URI for an HTML page."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def png_uri(pixels: np.ndarray, palette: np.ndarray | None = None) -> str:
    """Return the picture as a data: URI for an HTML page; see `png_bytes`."""
    return data_uri("image/png", png_bytes(pixels, palette))


def painted_uri(values: np.ndarray, low: float, high: float, anchors: tuple[str, ...] = DEPTH_ANCHORS) -> str:
    """Return `paint`'s picture as a data: URI, with a palette: a third of the bytes to compress."""
    return png_uri(_levels(values, low, high), colour_table(anchors))


def paint(values: np.ndarray, low: float, high: float, anchors: tuple[str, ...] = DEPTH_ANCHORS) -> np.ndarray:
    """Return (height, width, 3) uint8 colours of values between `low` and `high`; what is not finite is dark grey."""
    return colour_table(anchors)[_levels(values, low, high)]


def _levels(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return (height, width) uint8, numbers of colours in a `colour_table`."""
    finite = np.isfinite(values)
    share = (np.where(finite, values, low) - low) / max(high - low, 1e-12)
    return np.where(finite, np.clip(np.round(share * (LEVELS - 1)), 0, LEVELS - 1), LEVELS).astype(np.uint8)


@lru_cache(maxsize=8)
def colour_table(anchors: tuple[str, ...]) -> np.ndarray:
    """Return (256, 3) uint8, the LEVELS colours between the anchors (hexadecimal, evenly spaced), and MISSING."""
    points = np.array([[int(text[k : k + 2], 16) for k in (0, 2, 4)] for text in anchors], float)
    place = np.linspace(0, len(points) - 1, LEVELS)
    table = np.column_stack([np.interp(place, np.arange(len(points)), points[:, k]) for k in range(3)])
    return np.vstack([np.round(table), MISSING]).astype(np.uint8)


def depth_limits(depth: np.ndarray, objects: np.ndarray | None = None) -> tuple[float, float]:
    """Return near and far limits within which a depth image is painted.

    depth : (height, width) float64, NaN without return.
    objects : (height, width) bool: where given, the limits are what these pixels span, and as much again before and
        behind: a floor that runs to the horizon must not take all the colours.
    """
    values = depth[np.isfinite(depth)]
    if not values.size:
        return 0.0, 1.0
    low, high = (float(value) for value in np.percentile(values, (0.5, 99.5)))
    seen = depth[objects & np.isfinite(depth)] if objects is not None else values[:0]
    if seen.size:
        near, far = (float(value) for value in np.percentile(seen, (1, 99)))
        span = max(far - near, 0.02)
        low, high = max(low, near - span), min(high, far + span)
    return low, max(high, low + 1e-3)


def colours_of(solids: Solids, names: Sequence[str] = ()) -> np.ndarray:
    """Return (N, 3) uint8, the colour of each solid in all pictures: the one that its name says, or one of its own."""
    from derender.render.renderers.preview import default_colours

    colours = default_colours(solids)
    for index, name in enumerate(names):
        for word in name.lower().replace("-", "_").replace(" ", "_").split("_"):
            if word in NAMED_COLOURS:
                colours[index] = NAMED_COLOURS[word]
    return colours


def shade(
    solids: Solids,
    camera: Camera,
    names: Sequence[str] = (),
    samples: int = 2,
    shadows: bool = True,
    colours: np.ndarray | None = None,
) -> np.ndarray:
    """Return a shaded picture of the scene, (height, width, 3) uint8, by ray casting.

    samples : of each pixel, along either side. colours : (N, 3) uint8; None: as `colours_of` has them.
    """
    from derender.render.raycast.depth import render_depth
    from derender.render.renderers.preview import draw_preview

    colours = colours_of(solids, names) if colours is None else colours
    return draw_preview(render_depth, solids, camera, colours, samples, shadows)


HEIGHT = 240  # pixels
HERE, BEST = (40, 40, 40), (214, 80, 70)  # colours of the marks at the camera that was there, and at the best view
MARK = 5  # pixels, radius


def write_picture(path: Path, graph: SceneGraph, camera: Camera, views: "Sequence[NextView]", about: str) -> None:
    """Write a PNG: left the scene from the best of `views`, right the map of all, the more nats the darker.

    On the map the scene is in the middle and seen from above, the camera that was there below it; the farther from the
    middle, the lower the camera.
    """
    small = camera.downscaled(camera.height / HEIGHT)
    there = replace(graph, root_pose=inverse(views[0].pose) @ graph.root_pose)
    # an object has the colour that it has in the other pictures, where it stands elsewhere among its neighbours
    scene = shade(there.solids(), small, colours=colours_of(graph.solids(), graph.solid_names))
    chart = polar_map(views, about, len(scene))
    write_bytes(path, png_bytes(np.hstack([scene[..., :3], chart])))


def polar_map(views: "Sequence[NextView]", about: str, side: int) -> np.ndarray:
    """Return (side, side, 3) uint8, each pixel coloured as the candidate nearest to it on the map."""
    places = np.array([place_of(view.turn, view.elevation, side) for view in views])
    rows, columns = np.mgrid[:side, :side]
    away = np.hypot(rows[..., None] - places[:, 0], columns[..., None] - places[:, 1])
    nats = np.array([view.nats[about] for view in views])
    shown = np.where(np.hypot(rows - side / 2, columns - side / 2) < side / 2, nats[away.argmin(axis=-1)], np.nan)
    pixels = paint(shown, 0.0, float(max(nats.max(), 1e-9)))
    pixels[~np.isfinite(shown)] = 255
    here = place_of(0.0, next(view.elevation for view in sorted(views, key=lambda v: v.moved)), side)
    for place, colour in ((here, HERE), (places[0], BEST)):
        pixels[np.hypot(rows - place[0], columns - place[1]) < MARK] = colour
    return pixels


def place_of(turn: float, elevation: float, side: int) -> tuple[float, float]:
    """Return the (row, column) of a view on a map of `side` pixels."""
    radius = 0.5 * side * (1.0 - elevation / (0.5 * np.pi))
    return 0.5 * side + radius * float(np.cos(turn)), 0.5 * side + radius * float(np.sin(turn))
