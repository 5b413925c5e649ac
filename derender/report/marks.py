"""What is drawn over a report's pictures: outlines of objects and of regions in doubt, and a scale bar."""

from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from derender.camera.intrinsics import Camera
from derender.results.regions import Region

FINEST = 320  # columns of an outline, at most: a page stays small
SCALES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)  # metres that a scale bar may be long
LONGEST = 0.3  # share of the image's width


def outline_path(mask: np.ndarray) -> str:
    """Return the border of a mask (H, W) as an SVG path in its pixels, each pixel a unit square."""
    padded = np.pad(mask, 1).astype(np.int8)
    parts = []
    for way, steps in (("h", np.diff(padded, axis=0)[:, 1:-1]), ("v", np.diff(padded, axis=1)[1:-1].T)):
        # a run of one row or column where the mask begins or ends is one line
        edges = np.pad(steps != 0, ((0, 0), (1, 1))).astype(np.int8)
        line, begin = np.nonzero(np.diff(edges, axis=1) == 1)
        _, end = np.nonzero(np.diff(edges, axis=1) == -1)
        for where, first, last in zip(line, begin, end, strict=True):
            x, y = (first, where) if way == "h" else (where, first)
            parts.append(f"M{x} {y}{way}{last - first}")
    return "".join(parts)


def area_path(mask: np.ndarray) -> str:
    """Return a mask (H, W) as an SVG path of rectangles, one for each run of a row."""
    edges = np.pad(mask, ((0, 0), (1, 1))).astype(np.int8)
    row, begin = np.nonzero(np.diff(edges, axis=1) == 1)
    _, end = np.nonzero(np.diff(edges, axis=1) == -1)
    return "".join(f"M{a} {y}h{b - a}v1h{a - b}z" for y, a, b in zip(row, begin, end, strict=True))


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
