"""Depth and label images in float64: the plain ray caster, and the reference for the engine's fast rows.

Triangle meshes are drawn by a z-buffer in inverse depth, which is affine over each triangle.
"""

import math
from typing import NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.compilation.cache import address_of, call_for_nothing, njit
from derender.render.raycast.convex import PREPARED, inverse_depths, prepare_solid
from derender.scene.solids import MESH, Solids


class Meshes(NamedTuple):
    """The meshes of Solids in arrays that compiled code can take. M of them, one after the other."""

    vertices: np.ndarray  # (V, 3) float64, object axes
    triangles: np.ndarray  # (T, 3) int32, each counted from its mesh's first vertex
    starts: np.ndarray  # (M + 1, 2) int64, where each mesh's vertices and triangles begin
    extents: np.ndarray  # (M, 3) float64, as they are; solids may be drawn larger
    points: np.ndarray  # (>= V of any, 6) float64, scratch: vertices in camera axes; column, row, inverse depth


def flat_meshes(meshes: tuple[tuple[np.ndarray, np.ndarray], ...]) -> Meshes:
    """Return the meshes (vertices, triangles) of Solids as Meshes."""
    sizes = np.array([(len(vertices), len(triangles)) for vertices, triangles in meshes], np.int64).reshape(-1, 2)
    if not meshes:  # arrays of no length have no type for what is compiled
        return Meshes(np.zeros((1, 3)), np.zeros((1, 3), np.int32), np.zeros((1, 2), np.int64), np.ones((1, 3)),
                      np.zeros((1, 6)))  # fmt: skip
    vertices, triangles = (np.concatenate(arrays) for arrays in zip(*meshes, strict=True))
    starts = np.concatenate([np.zeros((1, 2), np.int64), np.cumsum(sizes, axis=0)])
    extents = np.array([np.maximum(2.0 * np.abs(vertices).max(axis=0), 1e-12) for vertices, _ in meshes])
    return Meshes(vertices.astype(float), triangles.astype(np.int32), starts, extents, np.zeros((sizes[:, 0].max(), 6)))


@njit(cache=True, nogil=True)
def draw(calls, kinds, poses, sizes, mesh_index, meshes, camera, inverse, label):
    """Write the greatest inverse depth (0: nothing hit) and the index of the solid hit (-1: none) of every pixel.

    calls (2,) int64, the addresses of `prepare_solid` and, where there are meshes, of `draw_mesh`;
    kinds (N,) int64, poses (N, 4, 4), sizes (N, 3), mesh_index (N,) int64; Meshes;
    camera (4,) float64 fx, fy, cx, cy; inverse (H, W) float64 and label (H, W) int32 are written.
    """
    height, width = inverse.shape
    inverse[:] = 0.0
    label[:] = -1
    prepared, rectangle = np.zeros(PREPARED), np.zeros(4, np.int64)
    seen = np.empty(width)
    for k in range(kinds.shape[0]):
        call_for_nothing(calls[0], kinds[k], poses[k], sizes[k], camera, width, height, prepared, rectangle)
        if rectangle[0] >= rectangle[1]:
            continue
        if kinds[k] == MESH:
            buffer = np.zeros((rectangle[3], rectangle[1]))
            call_for_nothing(calls[1], buffer, meshes, mesh_index[k], sizes[k], poses[k], camera, rectangle)
            for row in range(rectangle[2], rectangle[3]):
                for column in range(rectangle[0], rectangle[1]):
                    if buffer[row, column] > inverse[row, column]:
                        inverse[row, column] = buffer[row, column]
                        label[row, column] = k
        else:
            left, count = rectangle[0], rectangle[1] - rectangle[0]
            for row in range(rectangle[2], rectangle[3]):
                inverse_depths(prepared, left, row, seen[:count])
                for n in range(count):
                    if seen[n] > inverse[row, left + n]:
                        inverse[row, left + n] = seen[n]
                        label[row, left + n] = k


def bound_address() -> int:
    """Return the address of `prepare_solid`."""
    pose, size, bounds, rectangle, index = np.eye(4), np.ones(3), np.zeros(PREPARED), np.zeros(4, np.int64), np.int64(0)
    return address_of(prepare_solid, index, pose, size, bounds, index, index, bounds, rectangle)


def rasterise_address(meshes: Meshes, buffer: np.ndarray) -> int:
    """Return the address of `draw_mesh` for Meshes and an image of inverse depths; 0 without meshes."""
    if len(meshes.starts) == 1:
        return 0
    pose, size, rectangle = np.eye(4), np.ones(3), np.zeros(4, np.int64)
    return address_of(draw_mesh, buffer, meshes, np.int64(0), size, pose, size, rectangle)


def camera_array(camera: Camera) -> np.ndarray:
    """Return fx, fy, cx, cy as (4,) float64."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64)


def render_depth(
    solids: Solids, camera: Camera, antialias: int = 1, background: float = np.nan
) -> tuple[np.ndarray, np.ndarray]:
    """Render the depth image of posed solids by casting a ray through every pixel centre.

    solids : Solids.
    camera : Camera (fx, fy, cx, cy, width, height; the centre of pixel (i, j) is at image coordinates (i, j)).
    antialias : n casts n x n rays a pixel on a regular grid and averages their depths.
    background : depth in metres where nothing is hit.

    Returns (depth, label).

    depth : (height, width) float64, metres along the optical axis. With antialias > 1 the mean over the rays that hit
        something, or over all rays if `background` is a number.
    label : (height, width) int32, index of the solid at the pixel's centre (antialiased: of the ray nearest to it),
        -1 where nothing is hit.
    """
    n = int(antialias)
    if n < 1:
        raise ValueError("antialias must be 1 or more")
    intrinsics = camera_array(camera)
    if n > 1:  # pixel i's rays are at i + (k - (n - 1) / 2) / n, which on the fine grid is column i n + k
        intrinsics[:2] *= n
        intrinsics[2:] = intrinsics[2:] * n + (n - 1) / 2.0
    height, width = camera.height * n, camera.width * n
    inverse = np.zeros((height, width))
    label = np.zeros((height, width), np.int32)
    meshes = flat_meshes(solids.meshes)
    draw(
        np.array([bound_address(), rasterise_address(meshes, inverse)]),
        np.ascontiguousarray(solids.kind, np.int64),
        np.ascontiguousarray(solids.pose, np.float64),
        np.ascontiguousarray(solids.size, np.float64),
        np.ascontiguousarray(solids.mesh, np.int64),
        meshes,
        intrinsics,
        inverse,
        label,
    )
    hit = label >= 0
    depth = np.full(inverse.shape, background, np.float64)
    np.divide(1.0, inverse, out=depth, where=hit)
    if n == 1:
        return depth, label
    blocks = (camera.height, n, camera.width, n)
    depth, hit = depth.reshape(blocks), hit.reshape(blocks)
    middle = np.ascontiguousarray(label.reshape(blocks)[:, n // 2, :, n // 2])
    if np.isfinite(background):
        return depth.mean(axis=(1, 3)), middle
    count = hit.sum(axis=(1, 3))
    total = np.where(hit, depth, 0.0).sum(axis=(1, 3))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan), middle


NEAR = 1e-4  # metres: triangles are cut here so that they can be projected


@njit(cache=True, nogil=True, no_cpython_wrapper=True, borrows=True)
def fill_triangle(buffer, first, second, third, left, right, top, bottom):
    """Raise `buffer` to the inverse depth of a triangle in columns left:right and rows top:bottom (either winding).

    first, second, third : (>= 3,) float64 each: column, row, inverse depth of a corner.
    """
    x0, y0, w0 = first[0], first[1], first[2]
    x1, y1, w1 = second[0], second[1], second[2]
    x2, y2, w2 = third[0], third[1], third[2]
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    if area == 0.0 or not math.isfinite(area):
        return
    begin = max(math.ceil(min(x0, x1, x2) - 1e-9), float(left))
    end = min(math.floor(max(x0, x1, x2) + 1e-9), float(right - 1))
    start = max(math.ceil(min(y0, y1, y2) - 1e-9), float(top))
    stop = min(math.floor(max(y0, y1, y2) + 1e-9), float(bottom - 1))
    if begin > end or start > stop:
        return
    scale = 1.0 / area
    # barycentric coordinates are affine in the pixel: value at (x2, y2)-anchored origin and the two slopes
    slope_0x, slope_0y = (y1 - y2) * scale, (x2 - x1) * scale
    slope_1x, slope_1y = (y2 - y0) * scale, (x0 - x2) * scale
    slope_x = slope_0x * (w0 - w2) + slope_1x * (w1 - w2)
    slope_y = slope_0y * (w0 - w2) + slope_1y * (w1 - w2)
    for row in range(int(start), int(stop) + 1):
        dy = row - y2
        for column in range(int(begin), int(end) + 1):
            dx = column - x2
            one = slope_0x * dx + slope_0y * dy
            other = slope_1x * dx + slope_1y * dy
            # a hair inside out, so that no crack opens between neighbours that share an edge
            if one >= -1e-9 and other >= -1e-9 and one + other <= 1.0 + 1e-9:
                value = w2 + slope_x * dx + slope_y * dy
                if value > buffer[row, column]:
                    buffer[row, column] = value


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _fill_clipped(buffer, points, triangle, camera, rectangle):
    """Cut a triangle that crosses the plane depth = NEAR and fill what lies beyond it (a triangle or a quadrangle)."""
    polygon = np.empty((4, 3))
    count = 0
    for k in range(3):
        start, end = points[triangle[k]], points[triangle[(k + 1) % 3]]
        if start[2] >= NEAR:
            for axis in range(3):
                polygon[count, axis] = start[axis]
            count += 1
        if (start[2] >= NEAR) != (end[2] >= NEAR):
            share = (NEAR - start[2]) / (end[2] - start[2])
            for axis in range(3):
                polygon[count, axis] = start[axis] + share * (end[axis] - start[axis])
            polygon[count, 2] = NEAR
            count += 1
    for k in range(count):
        inverse = 1.0 / polygon[k, 2]
        polygon[k, 0] = camera[0] * polygon[k, 0] * inverse + camera[2]
        polygon[k, 1] = camera[1] * polygon[k, 1] * inverse + camera[3]
        polygon[k, 2] = inverse
    left, right, top, bottom = rectangle[0], rectangle[1], rectangle[2], rectangle[3]
    for k in range(2, count):
        fill_triangle(buffer, polygon[0], polygon[k - 1], polygon[k], left, right, top, bottom)


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def draw_mesh(buffer, meshes, m, size, pose, camera, rectangle):
    """Raise an inverse-depth image to a mesh's inside a rectangle.

    buffer : (>= rows, >= columns) float32 or float64 inverse depth, 0 or more, raised in place.
    meshes : Meshes. m : which of them. size : (3,) float64, drawn extents. pose : (4, 4) float64, object to camera.
    camera : (>= 4,) float64, fx, fy, cx, cy, ... rectangle : (4,) int64, columns and rows to draw, ends excluded.
    """
    vertices, triangles, points = meshes.vertices, meshes.triangles, meshes.points
    extents, first, end = meshes.extents[m], meshes.starts[m], meshes.starts[m + 1]
    sx, sy, sz = size[0] / extents[0], size[1] / extents[1], size[2] / extents[2]
    for k in range(end[0] - first[0]):
        v = first[0] + k
        x, y, z = vertices[v, 0] * sx, vertices[v, 1] * sy, vertices[v, 2] * sz
        for axis in range(3):
            points[k, axis] = pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2] * z + pose[axis, 3]
        if points[k, 2] >= NEAR:
            inverse = 1.0 / points[k, 2]
            points[k, 3] = camera[0] * points[k, 0] * inverse + camera[2]
            points[k, 4] = camera[1] * points[k, 1] * inverse + camera[3]
            points[k, 5] = inverse
    left, right, top, bottom = rectangle[0], rectangle[1], rectangle[2], rectangle[3]
    for k in range(first[1], end[1]):
        i, j, n = triangles[k, 0], triangles[k, 1], triangles[k, 2]
        before = int(points[i, 2] >= NEAR) + int(points[j, 2] >= NEAR) + int(points[n, 2] >= NEAR)
        if before == 3:
            fill_triangle(buffer, points[i, 3:], points[j, 3:], points[n, 3:], left, right, top, bottom)
        elif before > 0:
            _fill_clipped(buffer, points, triangles[k], camera, rectangle)
