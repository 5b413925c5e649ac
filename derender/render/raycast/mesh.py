"""Triangle meshes: a z-buffer rasteriser in inverse depth, which is affine over each triangle."""

import math

import numpy as np

from derender.compilation.cache import njit

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
