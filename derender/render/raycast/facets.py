"""Triangle meshes in the antialiased image: planes of inverse depth, edges as lines, and which triangles a pixel sees.

A triangle that faces the camera is one more flat face. Where the mesh is closed, its other triangles are hidden, and
the outline is the edges between the two kinds; edges between two that are seen matter as creases only.
"""

from typing import NamedTuple

import numpy as np

from derender.compilation.cache import njit
from derender.render.raycast.outline import add_line
from derender.scene.solids import MESH

NEAR = 1e-4  # metres: a triangle that comes nearer to the camera's plane is left out
FLAT, CREASE, OUTLINE = range(3)  # a side between triangles that are seen and nearly in line, at an angle, or not so
SHARP = 0.95  # cosine of the angle between neighbours from which their crease is taken for none


class Facets(NamedTuple):
    """The triangles of all mesh solids of a scene, and of every pixel. T triangles, V vertices.

    Attributes
    ----------
    first : (N + 1,) int64, the first triangle of each solid; vertex : (N + 1,) int64, its first vertex.
    vertices : (V, 3) float64, object axes, as shares of the solid's extents.
    triangles : (T, 3) int64, vertices. neighbours : (T, 3) int64, the triangle across each side, -1 if there is none.
    winding : (N,) int64, 1 or -1 where a mesh is closed: by which winding triangles face outwards; else 0.
    points : (V, 3) float64, camera axes. plane : (T, 3) float64, inverse depth a + b i + c j.
    normal : (T, 3) float64. side : (T, 3) int64, what the side from each corner to the next is: FLAT, CREASE, OUTLINE.
    shown : (T,) bool. solid : (T,) int64.
    bounds : (T, 4) int64, columns and rows that it may touch, ends excluded.
    listed : (H, W, 2) int64, start and end of each mixed pixel's part of what `list_facets` returned last.
    """

    first: np.ndarray
    vertex: np.ndarray
    vertices: np.ndarray
    triangles: np.ndarray
    neighbours: np.ndarray
    winding: np.ndarray
    points: np.ndarray
    plane: np.ndarray
    normal: np.ndarray
    side: np.ndarray
    shown: np.ndarray
    solid: np.ndarray
    bounds: np.ndarray
    listed: np.ndarray


def _neighbours(triangles: np.ndarray) -> np.ndarray:
    """Return (T, 3) the triangle across the side from each corner to the next, -1 where there is none or several."""
    sides = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    number = {}
    for n, (start, end) in enumerate(sides.tolist()):
        number[start, end] = -1 if (start, end) in number else n // 3
    return np.array([number.get((end, start), -1) for start, end in sides.tolist()], np.int64).reshape(-1, 3)


def new_facets(camera, count: int, solids=None) -> Facets:
    """Allocate Facets for a Camera and scenes with the meshes of these Solids; without meshes almost nothing."""
    first, vertex = np.zeros(count + 1, np.int64), np.zeros(count + 1, np.int64)
    winding = np.zeros(count, np.int64)
    vertices, triangles, neighbours, solid = [np.zeros((0, 3))], [np.zeros((0, 3), int)], [np.zeros((0, 3), int)], []
    for k in range(count):
        first[k + 1], vertex[k + 1] = first[k], vertex[k]
        if solids is None or solids.kind[k] != MESH:
            continue
        points, corners = (np.asarray(array) for array in solids.meshes[solids.mesh[k]])
        across = _neighbours(corners)
        a, b, c = (points[corners[:, n]] for n in range(3))
        winding[k] = int(np.sign(np.sum(a * np.cross(b, c)))) if np.all(across >= 0) else 0
        vertices.append(points / np.maximum(2.0 * np.abs(points).max(axis=0), 1e-12))
        triangles.append(corners + vertex[k])
        neighbours.append(np.where(across >= 0, across + first[k], -1))
        solid += [k] * len(corners)
        first[k + 1], vertex[k + 1] = first[k] + len(corners), vertex[k] + len(points)
    total = max(first[-1], 1)
    return Facets(
        first,
        vertex,
        np.concatenate(vertices),
        np.concatenate(triangles).astype(np.int64),
        np.concatenate(neighbours).astype(np.int64),
        winding,
        np.zeros((max(vertex[-1], 1), 3)),
        np.zeros((total, 3)),
        np.zeros((total, 3)),
        np.zeros((total, 3), np.int64),
        np.zeros(total, np.bool_),
        np.array([*solid, 0], np.int64),
        np.zeros((total, 4), np.int64),
        np.zeros((camera.height, camera.width, 2) if solid else (1, 1, 2), np.int64),
    )


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def pose_facets(facets, k, pose, size, camera, width, height, lines, base):
    """Place the triangles of mesh solid k: planes, bounds, and their sides' lines, the first of all at lines[base]."""
    points, triangles, plane, normal = facets.points, facets.triangles, facets.plane, facets.normal
    vertices, shown, bounds, winding = facets.vertices, facets.shown, facets.bounds, facets.winding[k]
    for v in range(facets.vertex[k], facets.vertex[k + 1]):
        x, y, z = vertices[v, 0] * size[0], vertices[v, 1] * size[1], vertices[v, 2] * size[2]
        for axis in range(3):
            points[v, axis] = pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2] * z + pose[axis, 3]
    middle = np.zeros(3)
    for t in range(facets.first[k], facets.first[k + 1]):
        shown[t] = False
        p, q, r = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if min(points[p, 2], points[q, 2], points[r, 2]) < NEAR:
            continue
        ax, ay, az = points[q, 0] - points[p, 0], points[q, 1] - points[p, 1], points[q, 2] - points[p, 2]
        bx, by, bz = points[r, 0] - points[p, 0], points[r, 1] - points[p, 1], points[r, 2] - points[p, 2]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        offset = nx * points[p, 0] + ny * points[p, 1] + nz * points[p, 2]
        if abs(offset) < 1e-9 * length or offset * winding > 0.0:  # edge on, or seen from behind
            continue
        normal[t, 0], normal[t, 1], normal[t, 2] = nx / length, ny / length, nz / length
        plane[t, 1], plane[t, 2] = nx / (offset * camera[0]), ny / (offset * camera[1])
        plane[t, 0] = nz / offset - plane[t, 1] * camera[2] - plane[t, 2] * camera[3]
        left, right, top, bottom = 1e9, -1e9, 1e9, -1e9
        for corner in range(3):
            v = triangles[t, corner]
            i = camera[0] * points[v, 0] / points[v, 2] + camera[2]
            j = camera[1] * points[v, 1] / points[v, 2] + camera[3]
            left, right, top, bottom = min(left, i), max(right, i), min(top, j), max(bottom, j)
        bounds[t, 0], bounds[t, 1] = int(max(np.ceil(left - 0.5), 0)), int(min(np.floor(right + 0.5) + 1, width))
        bounds[t, 2], bounds[t, 3] = int(max(np.ceil(top - 0.5), 0)), int(min(np.floor(bottom + 0.5) + 1, height))
        for axis in range(3):
            middle[axis] = (points[p, axis] + points[q, axis] + points[r, axis]) / 3.0
        good = True
        for side in range(3):
            start, end = points[triangles[t, side]], points[triangles[t, (side + 1) % 3]]
            line = base + 3 * t + side
            good = add_line(lines, line, start, end, middle, camera) > line and good
        shown[t] = good
    for t in range(facets.first[k], facets.first[k + 1]):
        if shown[t]:
            for side in range(3):
                facets.side[t, side] = _side(facets.neighbours[t, side], t, shown, normal, points[triangles[t, side]])


@njit(cache=True, nogil=True, no_cpython_wrapper=True)
def _side(other, t, shown, normal, corner):
    """What the side between a triangle that is seen and another one is; they share a corner."""
    if other < 0 or not shown[other]:
        return OUTLINE
    cosine, here, there = 0.0, 0.0, 0.0
    for axis in range(3):
        cosine += normal[t, axis] * normal[other, axis]
        here += normal[t, axis] * corner[axis]
        there += normal[other, axis] * corner[axis]
    if here * there < 0.0:  # an open mesh, of which one is seen from inside: it folds here
        return OUTLINE
    return CREASE if cosine < SHARP else FLAT
