"""Depth and label images in float64: the plain ray caster, and the reference for the engine's fast rows.

Triangle meshes are drawn by a z-buffer in inverse depth, which is affine over each triangle.
"""

import math
from typing import TYPE_CHECKING

import numpy as np

from derender.compilation.cache import address_of, call_for_nothing, njit
from derender.render.raycast.convex import PREPARED, inverse_depth, prepare_solid
from derender.scene.solids import MESH, Solids

if TYPE_CHECKING:
    from derender.camera.intrinsics import Camera


class FlatMeshes:
    """The meshes of Solids in arrays that compiled code can take: vertices, triangles, and where each mesh starts."""

    def __init__(self, meshes: tuple[tuple[np.ndarray, np.ndarray], ...]) -> None:
        sizes = [(len(vertices), len(triangles)) for vertices, triangles in meshes]
        self.starts = np.zeros((len(sizes) + 1, 2), np.int64)
        if sizes:
            self.starts[1:] = np.cumsum(np.array(sizes, np.int64), axis=0)
        self.vertices = np.zeros((max(self.starts[-1, 0], 1), 3))
        self.triangles = np.zeros((max(self.starts[-1, 1], 1), 3), np.int32)
        self.extents = np.ones((max(len(sizes), 1), 3))
        for k, (vertices, triangles) in enumerate(meshes):
            self.vertices[self.starts[k, 0] : self.starts[k + 1, 0]] = vertices
            self.triangles[self.starts[k, 1] : self.starts[k + 1, 1]] = triangles
            self.extents[k] = np.maximum(2.0 * np.abs(vertices).max(axis=0), 1e-12)


@njit(cache=True, nogil=True)
def draw(calls, kinds, poses, sizes, mesh_index, vertices, triangles, starts, extents, camera, inverse, label):
    """Write the greatest inverse depth (0: nothing hit) and the index of the solid hit (-1: none) of every pixel.

    calls (2,) int64, the addresses of `prepare_solid` and, where there are meshes, of `draw_mesh`;
    kinds (N,) int64, poses (N, 4, 4), sizes (N, 3), mesh_index (N,) int64; the arrays of FlatMeshes;
    camera (4,) float64 fx, fy, cx, cy; inverse (H, W) float64 and label (H, W) int32 are written.
    """
    height, width = inverse.shape
    inverse[:] = 0.0
    label[:] = -1
    prepared = np.zeros(PREPARED)
    rectangle = np.zeros(4, np.int64)
    for k in range(kinds.shape[0]):
        call_for_nothing(calls[0], kinds[k], poses[k], sizes[k], camera, width, height, prepared, rectangle)
        if rectangle[0] >= rectangle[1]:
            continue
        if kinds[k] == MESH:
            m = mesh_index[k]
            first, end = starts[m], starts[m + 1]
            buffer = np.zeros((rectangle[3], rectangle[1]))
            call_for_nothing(
                calls[1],
                buffer,
                vertices,
                triangles,
                first,
                end,
                sizes[k],
                extents[m],
                poses[k],
                camera,
                rectangle,
                np.empty((end[0] - first[0], 3)),
            )
            for row in range(rectangle[2], rectangle[3]):
                for column in range(rectangle[0], rectangle[1]):
                    if buffer[row, column] > inverse[row, column]:
                        inverse[row, column] = buffer[row, column]
                        label[row, column] = k
        else:
            for row in range(rectangle[2], rectangle[3]):
                for column in range(rectangle[0], rectangle[1]):
                    value = inverse_depth(prepared, column, row)
                    if value > inverse[row, column]:
                        inverse[row, column] = value
                        label[row, column] = k


def bound_address() -> int:
    """Return the address of `prepare_solid`."""
    pose, size, bounds, rectangle, index = np.eye(4), np.ones(3), np.zeros(PREPARED), np.zeros(4, np.int64), np.int64(0)
    return address_of(prepare_solid, index, pose, size, bounds, index, index, bounds, rectangle)


def rasterise_address(vertices: np.ndarray, triangles: np.ndarray, starts: np.ndarray, buffer: np.ndarray) -> int:
    """Return the address of `draw_mesh` for FlatMeshes' arrays and an image of inverse depths; 0 without meshes."""
    if len(starts) == 1:
        return 0
    pose, size, first, points = np.eye(4), np.ones(3), starts[0], np.zeros((1, 3))
    return address_of(draw_mesh, buffer, vertices, triangles, first, first, size, size, pose, size, first, points)


def camera_array(camera: "Camera") -> np.ndarray:
    """Return fx, fy, cx, cy as (4,) float64."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64)


def render_depth(
    solids: Solids, camera: "Camera", antialias: int = 1, background: float = np.nan
) -> tuple[np.ndarray, np.ndarray]:
    """Render the depth image of posed solids by casting a ray through every pixel centre.

    solids : Solids.
    camera : Camera (fx, fy, cx, cy, width, height; the centre of pixel (i, j) is at image coordinates (i, j)).
    antialias : n casts n x n rays a pixel on a regular grid and averages their depths.
    background : depth in metres where nothing is hit.

    Returns
    -------
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
    meshes = FlatMeshes(solids.meshes)
    draw(
        np.array([bound_address(), rasterise_address(meshes.vertices, meshes.triangles, meshes.starts, inverse)]),
        np.ascontiguousarray(solids.kind, np.int64),
        np.ascontiguousarray(solids.pose, np.float64),
        np.ascontiguousarray(solids.size, np.float64),
        np.ascontiguousarray(solids.mesh, np.int64),
        meshes.vertices,
        meshes.triangles,
        meshes.starts,
        meshes.extents,
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


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def fill_triangle(buffer, x0, y0, w0, x1, y1, w1, x2, y2, w2, first_column, end_column, first_row, end_row):
    """Raise `buffer` to the inverse depth of one projected triangle inside the rectangle (either winding)."""
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    if area == 0.0 or not math.isfinite(area):
        return
    left = max(math.ceil(min(x0, x1, x2) - 1e-9), float(first_column))
    right = min(math.floor(max(x0, x1, x2) + 1e-9), float(end_column - 1))
    top = max(math.ceil(min(y0, y1, y2) - 1e-9), float(first_row))
    bottom = min(math.floor(max(y0, y1, y2) + 1e-9), float(end_row - 1))
    if left > right or top > bottom:
        return
    scale = 1.0 / area
    # barycentric coordinates are affine in the pixel: value at (x2, y2)-anchored origin and the two slopes
    slope_0x, slope_0y = (y1 - y2) * scale, (x2 - x1) * scale
    slope_1x, slope_1y = (y2 - y0) * scale, (x0 - x2) * scale
    slope_x = slope_0x * (w0 - w2) + slope_1x * (w1 - w2)
    slope_y = slope_0y * (w0 - w2) + slope_1y * (w1 - w2)
    for row in range(int(top), int(bottom) + 1):
        dy = row - y2
        for column in range(int(left), int(right) + 1):
            dx = column - x2
            first = slope_0x * dx + slope_0y * dy
            second = slope_1x * dx + slope_1y * dy
            # a hair inside out, so that no crack opens between neighbours that share an edge
            if first >= -1e-9 and second >= -1e-9 and first + second <= 1.0 + 1e-9:
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
    for k in range(2, count):
        fill_triangle(
            buffer,
            polygon[0, 0],
            polygon[0, 1],
            polygon[0, 2],
            polygon[k - 1, 0],
            polygon[k - 1, 1],
            polygon[k - 1, 2],
            polygon[k, 0],
            polygon[k, 1],
            polygon[k, 2],
            rectangle[0],
            rectangle[1],
            rectangle[2],
            rectangle[3],
        )


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def draw_mesh(buffer, vertices, triangles, first, end, size, extents, pose, camera, rectangle, points):
    """Raise an inverse-depth image to a mesh's inside a rectangle.

    buffer : (>= rows, >= columns) float32 or float64 inverse depth, 0 or more, raised in place.
    vertices : (V, 3) float64, object axes. triangles : (T, 3) int32: those of all meshes, one after the other.
    first, end : (2,) int64, where this mesh's vertices and triangles start and end; triangles count from its first.
    size, extents : (3,) float64, drawn and original extents. pose : (4, 4) float64, object to camera.
    camera : (>= 4,) float64, fx, fy, cx, cy, ... rectangle : (4,) int64, columns and rows to draw, ends excluded.
    points : (>= V, 3) float64, scratch.
    """
    sx, sy, sz = size[0] / extents[0], size[1] / extents[1], size[2] / extents[2]
    for k in range(end[0] - first[0]):
        v = first[0] + k
        x, y, z = vertices[v, 0] * sx, vertices[v, 1] * sy, vertices[v, 2] * sz
        for axis in range(3):
            points[k, axis] = pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2] * z + pose[axis, 3]
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    first_column, end_column, first_row, end_row = rectangle[0], rectangle[1], rectangle[2], rectangle[3]
    for k in range(first[1], end[1]):
        i0, i1, i2 = triangles[k, 0], triangles[k, 1], triangles[k, 2]
        z0, z1, z2 = points[i0, 2], points[i1, 2], points[i2, 2]
        if z0 >= NEAR and z1 >= NEAR and z2 >= NEAR:
            w0, w1, w2 = 1.0 / z0, 1.0 / z1, 1.0 / z2
            fill_triangle(
                buffer,
                fx * points[i0, 0] * w0 + cx,
                fy * points[i0, 1] * w0 + cy,
                w0,
                fx * points[i1, 0] * w1 + cx,
                fy * points[i1, 1] * w1 + cy,
                w1,
                fx * points[i2, 0] * w2 + cx,
                fy * points[i2, 1] * w2 + cy,
                w2,
                first_column,
                end_column,
                first_row,
                end_row,
            )
        elif z0 >= NEAR or z1 >= NEAR or z2 >= NEAR:
            _fill_clipped(buffer, points, triangles[k], camera, rectangle)
