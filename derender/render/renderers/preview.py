"""A shaded picture from any renderer's depth and labels: sunlight with shadows, and sky light, in numpy.

It needs no OpenGL, and shows how things touch: a shadow map from the sun is one more depth image.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from derender.camera.intrinsics import Camera
from derender.scene.pose import from_axes
from derender.scene.solids import PLANE, Solids

SUPERSAMPLING = 2
PALETTE = np.array(
    [[214, 96, 77], [67, 147, 195], [120, 180, 90], [240, 190, 80], [146, 104, 172], [90, 190, 180], [225, 140, 170]]
)
PLANE_COLOUR = np.array([205, 203, 198])
LEAN = 0.4  # of the line that meets solids from left to right: upright, it would meet those of a stack at once
SUN = np.array([-0.45, -0.8, -0.4])  # from the scene to the sun, camera axes: above, left, and behind the camera
SUN_PIXELS, MOST_SUN_PIXELS = 2, 1024  # a side of the shadow map: for each pixel of the picture's, and at most


def default_colours(solids: Solids) -> np.ndarray:
    """Return (N, 3) uint8, a colour for each solid: a palette from left to right, light grey for planes.

    By where they are, not by their order in a file: the true and the inferred scene have the same colours.
    """
    thing = solids.kind != PLANE
    x, y, z = solids.pose[:, :3, 3].T
    place = (x + LEAN * y) / np.maximum(z, 1e-6)
    order = np.argsort(np.argsort(np.where(thing, place, np.inf))) % len(PALETTE)
    return np.where(thing[:, None], PALETTE[order], PLANE_COLOUR).astype(np.uint8)


def draw_preview(
    render_depth: Callable[..., tuple[np.ndarray, np.ndarray]],
    solids: Solids,
    camera: Camera,
    colours: np.ndarray | None = None,
    samples: int = SUPERSAMPLING,
    shadows: bool = True,
) -> np.ndarray:
    """Draw a shaded picture on white.

    render_depth : a renderer's.
    colours : (N, 3) uint8, one for each solid. samples : of each pixel, along either side.
    shadows : whether solids cast them, which takes as long as all else.

    Returns (height, width, 3) uint8.
    """
    colours = default_colours(solids) if colours is None else colours
    large = camera.downscaled(1 / samples)
    depth, label = render_depth(solids, large)
    points = large.points(depth)
    normals = _normals(points, label)
    sun = SUN / np.linalg.norm(SUN)
    planes = solids.pose[solids.kind == PLANE]
    if len(planes):  # above the floor, from wherever the camera looks at it
        up = planes[0, :3, 2] * (-1 if planes[0, :3, 2] @ planes[0, :3, 3] > 0 else 1)
        sun = 1.1 * up + 0.55 * _unit(np.cross(up, [0.0, 0.0, 1.0])) - [0, 0, 0.35]
        sun /= np.linalg.norm(sun)
    light = np.clip(normals @ sun, 0, None)
    if shadows:
        light *= _lit(render_depth, solids, points, normals, label, sun)
    sky = 0.5 + 0.5 * np.clip(-normals @ np.array([0.0, 0.5, 0.87]), -1, 1)
    shade = 0.18 + 0.37 * sky + 0.55 * light
    picture = np.full((*label.shape, 3), 255.0)
    hit = label >= 0
    picture[hit] = colours[label[hit]] * np.clip(shade[hit], 0, 1.15)[:, None]
    blocks = np.clip(picture, 0, 255).reshape(camera.height, samples, camera.width, samples, 3)
    return np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)


def _unit(vector: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-9 else np.array([1.0, 0.0, 0.0])


def _normals(points: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Return (height, width, 3) normals towards the camera, from neighbours that see the same solid.

    On each axis the neighbour with the smaller step is taken, so that creases inside a solid stay sharp.
    """
    steps = []
    for axis in (1, 0):
        forward = np.full(points.shape, np.nan)
        ahead = np.diff(points, axis=axis)
        same = np.diff(label, axis=axis) == 0
        ahead[~same] = np.nan
        inner = (slice(None), slice(None, -1)) if axis == 1 else (slice(None, -1), slice(None))
        outer = (slice(None), slice(1, None)) if axis == 1 else (slice(1, None), slice(None))
        forward[inner] = ahead
        backward = np.full(points.shape, np.nan)
        backward[outer] = ahead
        sizes = [np.nan_to_num(np.abs(step[..., 2]), nan=np.inf) for step in (forward, backward)]
        steps.append(np.where((sizes[0] <= sizes[1])[..., None], forward, backward))
    normals = np.cross(steps[1], steps[0])
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        normals = normals / length
    normals[~np.isfinite(normals).all(axis=-1)] = (0.0, 0.0, -1.0)
    # Towards the camera, whatever the winding.
    away = np.einsum("ijk,ijk->ij", normals, np.nan_to_num(points, nan=1.0, posinf=1.0)) > 0
    normals[away] *= -1
    return normals


def _lit(
    render_depth: Callable[..., Any],
    solids: Solids,
    points: np.ndarray,
    normals: np.ndarray,
    label: np.ndarray,
    sun: np.ndarray,
) -> np.ndarray:
    """Return (height, width) in [0, 1]: the share of sunlight that reaches each point."""
    things = np.flatnonzero(solids.kind != PLANE)
    if not len(things):
        return np.ones(label.shape)
    centre = solids.pose[things, :3, 3].mean(axis=0)
    reach = np.linalg.norm(solids.pose[things, :3, 3] - centre, axis=1) + np.linalg.norm(solids.size[things], axis=1)
    radius = float(reach.max()) / 2 + 0.05
    distance = 8 * radius  # far enough that its rays are nearly parallel
    back = -sun
    side = _unit(np.cross([0.0, 1.0, 0.0], back))
    rotation = np.stack([side, np.cross(back, side), back])  # camera frame to sun's frame
    to_sun = from_axes(rotation.T, rotation @ (-centre) + [0, 0, distance])
    pixels = min(SUN_PIXELS * max(label.shape), MOST_SUN_PIXELS)
    focal = pixels / 2 * (distance - radius) / (radius * 1.3)
    eye = Camera(focal, focal, (pixels - 1) / 2, (pixels - 1) / 2, pixels, pixels)
    casting = solids._replace(
        kind=solids.kind[things], pose=to_sun @ solids.pose[things], size=solids.size[things], mesh=solids.mesh[things]
    )
    shadow, _ = render_depth(casting, eye, background=np.inf)
    pixel_size = 2.6 * radius / pixels
    above = points + 3 * pixel_size * normals  # a face along the sunlight would else cast shadow on itself in stripes
    seen = np.nan_to_num(above, nan=0.0, posinf=0.0) @ rotation.T + to_sun[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        image = eye.project(seen)
    lit = np.zeros(label.shape)
    slack = 0.004 * radius + 0.0015
    offsets = np.array([(-1.5, -0.5), (-0.5, 1.5), (0.5, -1.5), (1.5, 0.5), (0, 0)])
    for offset in offsets:  # a soft edge
        pixel = np.round(np.nan_to_num(image + offset, nan=-1.0, posinf=-1.0, neginf=-1.0)).astype(np.int64)
        inside = ((pixel >= 0) & (pixel < pixels)).all(axis=-1)
        pixel = np.where(inside[..., None], pixel, 0)
        lit += ~inside | (seen[..., 2] <= shadow[pixel[..., 1], pixel[..., 0]] + slack)
    return lit / len(offsets)
