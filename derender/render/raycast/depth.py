"""Depth and label images in float64: the plain ray caster, and the reference for the engine's fast rows."""

from typing import TYPE_CHECKING, Any

import numpy as np

from derender.compilation.cache import address_of, call_for_nothing, njit
from derender.render.raycast.convex import PREPARED, inverse_depth, prepare_solid
from derender.render.raycast.mesh import draw_mesh
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
    solids: Solids, camera: Any, antialias: int = 1, background: float = np.nan
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
