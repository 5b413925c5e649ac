"""Arrays as pictures, without matplotlib: a report has to be written in a fraction of a second.

Drawn over them: outlines of objects and of regions in doubt, and a scale bar.
"""

import base64
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from html import escape
from pathlib import Path

import numpy as np

from derender.atomic import write_bytes
from derender.camera.image_files import png_bytes
from derender.camera.intrinsics import Camera
from derender.render.raycast.depth import render_depth
from derender.render.renderers.preview import default_colours, draw_preview
from derender.results.trust import Region
from derender.scene.graph import SceneGraph
from derender.scene.pose import inverse
from derender.scene.solids import Solids

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
    colours = default_colours(solids)
    for index, name in enumerate(names):
        for word in name.lower().replace("-", "_").replace(" ", "_").split("_"):
            if word in NAMED_COLOURS:
                colours[index] = NAMED_COLOURS[word]
    return colours


def shade(solids: Solids, camera: Camera, names: Sequence[str] = (), samples: int = 2, shadows: bool = True,
          colours: np.ndarray | None = None) -> np.ndarray:  # fmt: skip
    """Return a shaded picture of the scene, (height, width, 3) uint8, by ray casting.

    samples : of each pixel, along either side. colours : (N, 3) uint8; None: as `colours_of` has them.
    """
    colours = colours_of(solids, names) if colours is None else colours
    return draw_preview(render_depth, solids, camera, colours, samples, shadows)


HEIGHT = 240  # pixels


def write_view(path: Path, graph: SceneGraph, camera: Camera, pose: np.ndarray) -> None:
    """Write a PNG of a scene as a camera sees it from a pose (4, 4), that camera's axes to the scene's own camera's."""
    there = replace(graph, root_pose=inverse(pose) @ graph.root_pose)
    small = camera.downscaled(camera.height / HEIGHT)
    # An object has the colour that it has in the other pictures, where it stands elsewhere among its neighbours.
    write_bytes(path, png_bytes(shade(there.solids(), small, colours=colours_of(graph.solids(), graph.solid_names))))


FINEST = 320  # columns of an outline, at most: a page stays small
SCALES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)  # metres that a scale bar may be long
LONGEST = 0.3  # share of the image's width


def outline_path(mask: np.ndarray) -> str:
    """Return the border of a mask (H, W) as an SVG path in its pixels, each pixel a unit square."""
    padded = np.pad(mask, 1).astype(np.int8)
    parts = []
    for way, steps in (("h", np.diff(padded, axis=0)[:, 1:-1]), ("v", np.diff(padded, axis=1)[1:-1].T)):
        for where, first, last in runs(steps != 0):  # of one row or column where the mask begins or ends: one line
            x, y = (first, where) if way == "h" else (where, first)
            parts.append(f"M{x} {y}{way}{last - first}")
    return "".join(parts)


def area_path(mask: np.ndarray) -> str:
    """Return a mask (H, W) as an SVG path of rectangles, one for each run of a row."""
    return "".join(f"M{a} {y}h{b - a}v1h{a - b}z" for y, a, b in runs(mask))


def runs(mask: np.ndarray) -> Iterable[tuple[int, int, int]]:
    """Return (row, first column, first column beyond) of each run of pixels in the rows of a mask (H, W)."""
    edges = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, begin = np.nonzero(edges == 1)
    return zip(row, begin, np.nonzero(edges == -1)[1], strict=True)


def marks_svg(
    shape: tuple[int, int], objects: Iterable[tuple[str, np.ndarray]], regions: Sequence[Region] = (), bar: str = ""
) -> str:
    """Return what lies over a picture of (H, W) pixels; the objects show when they are chosen.

    objects : (name, mask (H, W)). bar : of `scale_bar`.
    """
    step = max(1, -(-shape[1] // FINEST))
    size = 0.05 * shape[1] / step
    parts = []
    for name, mask in objects:
        small = mask[::step, ::step]
        if small.any():
            parts.append(f'<g class="mark" data-object="{escape(name)}"><path class="area" d="{area_path(small)}"/>'
                         f'<path class="edge" d="{outline_path(small)}"/></g>')  # fmt: skip
    for region in regions:
        small = region.mask[::step, ::step]
        if small.any():
            rows, columns = np.nonzero(small)
            nearest = np.argmin((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2)
            parts.append(f'<path class="doubt" d="{outline_path(small)}"/><text class="doubt" font-size="{size:.1f}" '
                         f'x="{columns[nearest]}" y="{rows[nearest] + 0.35 * size:.1f}" text-anchor="middle">'
                         f"{escape(region.name)}</text>")  # fmt: skip
    view = f'viewBox="0 0 {shape[1] / step:g} {shape[0] / step:g}"'
    return f'<svg class="marks" {view} preserveAspectRatio="none" aria-hidden="true">{"".join(parts)}{bar}</svg>'


def scale_bar(camera: Camera, distance: float) -> str:
    """Return a bar of a round length at a distance (metres along the axis), for `marks_svg` of the camera's images."""
    step = max(1, -(-camera.width // FINEST))
    longest = LONGEST * camera.width * distance / camera.fx
    length = max((each for each in SCALES if each <= longest), default=SCALES[0])
    across = length * camera.fx / distance / step
    width, height = camera.width / step, camera.height / step
    x, y, size = 0.04 * width, height - 0.05 * width, 0.045 * width
    words = f"{100 * length:g} cm" if length < 1.0 else f"{length:g} m"
    words += f" at {distance:.2g} m"
    bar = f'd="M{x:.1f} {y:.1f}h{across:.1f}"'
    line = f'<path class="under" {bar} stroke-width="{0.024 * width:.1f}"/>'
    line += f'<path class="scale" {bar} stroke-width="{0.012 * width:.1f}"/>'
    place = f'x="{x:.1f}" y="{y - 0.5 * size:.1f}" font-size="{size:.1f}"'
    return f'{line}<text class="scale" {place}>{words}</text>'
