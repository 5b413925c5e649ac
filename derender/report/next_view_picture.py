"""A small picture of the best next view: the scene as it would be seen from there, beside a map of what views tell."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from derender.atomic import atomic_path
from derender.camera.image_files import png_bytes
from derender.camera.intrinsics import Camera
from derender.physics.next_view import NextView
from derender.report.pictures import paint, shade
from derender.scene.graph import SceneGraph
from derender.scene.pose import inverse

HEIGHT = 240  # pixels
HERE, BEST = (40, 40, 40), (214, 80, 70)  # colours of the marks at the camera that was there, and at the best view
MARK = 5  # pixels, radius


def write_picture(path: Path, graph: SceneGraph, camera: Camera, views: Sequence[NextView], about: str) -> None:
    """Write a PNG: left the scene from the best of `views`, right the map of all, the more nats the darker.

    On the map the scene is in the middle and seen from above, the camera that was there below it; the farther from the
    middle, the lower the camera.
    """
    small = camera.downscaled(camera.height / HEIGHT)
    there = replace(graph, root_pose=inverse(views[0].pose) @ graph.root_pose)
    scene = shade(there.solids(), small, there.solid_names)
    chart = polar_map(views, about, len(scene))
    with atomic_path(path) as temporary:
        temporary.write_bytes(png_bytes(np.hstack([scene[..., :3], chart])))


def polar_map(views: Sequence[NextView], about: str, side: int) -> np.ndarray:
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
