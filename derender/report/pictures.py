"""Arrays as pictures, without matplotlib: a report has to be written in a fraction of a second."""

import base64
import struct
import zlib
from functools import lru_cache

import numpy as np

from derender.model import solids as kinds
from derender.model.pose import inverse
from derender.model.solids import Solids
from derender.vision.camera import Camera

MISSING = np.array([58, 58, 64], dtype=np.uint8)

# Anchors of two maps, evenly spaced: viridis (perceptually even, for depth) and red - white - blue (for residuals).
DEPTH_ANCHORS = ("fde725", "90d743", "35b779", "21918c", "31688e", "443983", "440154")
RESIDUAL_ANCHORS = ("2166ac", "67a9cf", "d1e5f0", "f7f7f7", "fddbc7", "ef8a62", "b2182b")


def encode_png(pixels: np.ndarray) -> bytes:
    """Return a PNG file of (height, width, 3) uint8 pixels."""
    height, width, _ = pixels.shape
    rows = np.zeros((height, 1 + 3 * width), dtype=np.uint8)
    rows[:, 1:] = pixels.reshape(height, -1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def png_uri(pixels: np.ndarray) -> str:
    """Return the picture as a data: URI for an HTML page."""
    return "data:image/png;base64," + base64.b64encode(encode_png(pixels)).decode()


def paint(values: np.ndarray, low: float, high: float, anchors: tuple[str, ...] = DEPTH_ANCHORS) -> np.ndarray:
    """Return (height, width, 3) uint8 colours of values between `low` and `high`; what is not finite is dark grey."""
    table = colour_table(anchors)
    finite = np.isfinite(values)
    share = (np.where(finite, values, low) - low) / max(high - low, 1e-12)
    pixels = table[np.clip(np.round(share * 255), 0, 255).astype(int)]
    pixels[~finite] = MISSING
    return pixels


@lru_cache(maxsize=8)
def colour_table(anchors: tuple[str, ...]) -> np.ndarray:
    """Return (256, 3) uint8, the colours between the anchors (hexadecimal, evenly spaced)."""
    points = np.array([[int(text[k : k + 2], 16) for k in (0, 2, 4)] for text in anchors], float)
    place = np.linspace(0, len(points) - 1, 256)
    table = np.column_stack([np.interp(place, np.arange(len(points)), points[:, k]) for k in range(3)])
    return np.round(table).astype(np.uint8)


def depth_limits(depth: np.ndarray, objects: np.ndarray | None = None) -> tuple[float, float]:
    """Return near and far limits within which a depth image is painted.

    Parameters
    ----------
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


def colours_of(solids: Solids) -> np.ndarray:
    """Return (N, 3) uint8, the colour of each solid in every picture of a report."""
    from derender.vision.renderers.opengl import default_colours

    return default_colours(solids)


def shade(solids: Solids, camera: Camera, supersampling: int = 2) -> np.ndarray:
    """Return a shaded picture of the scene on white, by ray casting, without OpenGL.

    Returns
    -------
    (height, width, 3) uint8.
    """
    from derender.vision.raycast.depth import render_depth

    s = supersampling
    offset = (s - 1) / 2
    fine = Camera(
        camera.fx * s,
        camera.fy * s,
        camera.cx * s + offset,
        camera.cy * s + offset,
        camera.width * s,
        camera.height * s,
    )
    depth, label = render_depth(solids, fine)
    points = fine.points(np.where(label >= 0, depth, 1.0))
    normals = surface_normals(solids, label, points)
    # A lamp above the viewer's left shoulder, and one half as bright to the right.
    view = -points / np.linalg.norm(points, axis=-1, keepdims=True)
    lamps = np.array([[-0.4, -0.8, -0.45], [0.8, -0.3, -0.5]])
    lamps /= np.linalg.norm(lamps, axis=1, keepdims=True)
    facing = np.sign(np.sum(normals * view, axis=-1, keepdims=True))
    normals = normals * np.where(facing == 0, 1, facing)
    light = 0.35 + np.clip(normals @ lamps.T, 0, 1) @ np.array([0.55, 0.25])
    colours = colours_of(solids).astype(float)
    pixels = np.full((*label.shape, 3), 255.0)
    hit = label >= 0
    pixels[hit] = np.clip(colours[label[hit]] * light[hit][:, None], 0, 255)
    blocks = pixels.reshape(camera.height, s, camera.width, s, 3)
    return np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)


def surface_normals(solids: Solids, label: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the unit normal of the surface under each pixel, in camera axes.

    Parameters
    ----------
    label : (height, width) int, index into `solids` or -1.
    points : (height, width, 3) float64, where each pixel's ray meets the surface.

    Returns
    -------
    (height, width, 3) float64; of a mesh from neighbouring points; towards the camera where nothing is hit.
    """
    normals = np.zeros_like(points)
    normals[..., 2] = -1
    for index, kind in enumerate(solids.kind):
        mask = label == index
        if not mask.any():
            continue
        pose = solids.pose[index]
        local = points[mask] @ inverse(pose)[:3, :3].T + inverse(pose)[:3, 3]
        half = np.maximum(0.5 * solids.size[index], 1e-12)
        out = np.zeros_like(local)
        if kind == kinds.PLANE:
            out[:, 2] = 1
        elif kind == kinds.SPHERE:
            out = local / np.linalg.norm(local, axis=1, keepdims=True)
        elif kind == kinds.CYLINDER:
            radius = np.hypot(local[:, 0], local[:, 1])
            cap = np.abs(local[:, 2]) / half[2] > radius / half[0]
            out[cap, 2] = np.sign(local[cap, 2])
            out[~cap, :2] = local[~cap, :2] / radius[~cap, None]
        elif kind == kinds.BOX:
            axis = np.argmax(np.abs(local) / half, axis=1)
            out[np.arange(len(local)), axis] = np.sign(local[np.arange(len(local)), axis])
        else:
            across, down = np.gradient(points, axis=1)[mask], np.gradient(points, axis=0)[mask]
            normal = np.cross(across, down)
            normals[mask] = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
            continue
        normals[mask] = out @ pose[:3, :3].T
    return normals
