"""Random scenes for the engine's tests, and ray casting by plain numpy to hold against it."""

import numpy as np
import trimesh

from derender.scene.pose import random_rotation
from derender.scene.solids import BOX, CYLINDER, MESH, PLANE, SPHERE, Solids


def lumpy_mesh():
    """Return vertices and triangles of a convex-hull-free, centred, closed mesh of extent 1 along each axis."""
    ball = trimesh.creation.icosphere(2, 0.5)
    vertices = ball.vertices * (1.0 + 0.2 * np.sin(7.0 * ball.vertices[:, [1]]))
    vertices = vertices - (vertices.max(axis=0) + vertices.min(axis=0)) / 2
    return np.ascontiguousarray(vertices / np.ptp(vertices, axis=0)), np.ascontiguousarray(ball.faces, np.int32)


def random_solids(rng, count, kinds=(PLANE, BOX, SPHERE, CYLINDER, MESH), nearest=0.3) -> Solids:
    """Return solids of random kind, size and pose; some stick out of the image, and with a small `nearest` behind."""
    rows = []
    for _ in range(count):
        kind = int(rng.choice(kinds))
        pose = np.eye(4)
        pose[:] = random_rotation(rng)
        pose[:3, 3] = rng.uniform([-0.5, -0.4, nearest], [0.5, 0.4, 1.2])
        size = rng.uniform(0.04, 0.3, 3)
        if kind == SPHERE:
            size[:] = size[0]
        elif kind == CYLINDER:
            size[1] = size[0]
        elif kind == PLANE:
            size[:] = 0.0
            pose[2, 3] += 0.5
        rows.append((kind, pose, size))
    kind = np.array([row[0] for row in rows], np.int32)
    meshes = (lumpy_mesh(),) if (kind == MESH).any() else ()
    return Solids(
        kind,
        np.array([row[1] for row in rows]),
        np.array([row[2] for row in rows]),
        np.where(kind == MESH, 0, -1).astype(np.int32),
        meshes,
    )


def cast_rays(solids: Solids, camera, columns, rows):
    """Return (nearest depth or inf, index or -1) of rays through image points, by textbook formulas."""
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(np.shape(rows))], -1)
    rays = rays.reshape(-1, 3).astype(float)
    depth, label = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for index, (kind, pose, size) in enumerate(zip(solids.kind, solids.pose, solids.size, strict=True)):
        origin, direction = -pose[:3, :3].T @ pose[:3, 3], rays @ pose[:3, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            hit = _CASTERS[int(kind)](origin, direction, size, solids, index)
        nearer = hit < depth
        depth[nearer], label[nearer] = hit[nearer], index
    return depth.reshape(np.shape(rows)), label.reshape(np.shape(rows))


def _where_ahead(depth, valid):
    return np.where(valid & (depth > 0), depth, np.inf)


def _plane(origin, direction, size, solids, index):
    return _where_ahead(-origin[2] / direction[:, 2], True)


def _slabs(origin, direction, half):
    first, second = (-half - origin) / direction, (half - origin) / direction
    return np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)


def _box(origin, direction, size, solids, index):
    enter, leave = _slabs(origin, direction, size / 2)
    return _where_ahead(enter, enter <= leave)


def _quadratic(a, b, c):
    root = np.sqrt(b * b - a * c)
    return (-b - root) / a, (-b + root) / a


def _sphere(origin, direction, size, solids, index):
    enter, _ = _quadratic((direction**2).sum(1), direction @ origin, origin @ origin - (size[0] / 2) ** 2)
    return _where_ahead(enter, np.isfinite(enter))


def _cylinder(origin, direction, size, solids, index):
    flat, across = direction[:, :2], origin[:2]
    enter, leave = _quadratic((flat**2).sum(1), flat @ across, across @ across - (size[0] / 2) ** 2)
    above, below = _slabs(origin[2:], direction[:, 2:], size[2:] / 2)
    enter, leave = np.maximum(enter, above), np.minimum(leave, below)
    return _where_ahead(enter, enter <= leave)


def _mesh(origin, direction, size, solids, index):
    vertices, triangles = solids.meshes[solids.mesh[index]]
    corners = (vertices * size)[triangles]
    result = np.full(len(direction), np.inf)
    for a, b, c in corners:  # Moeller and Trumbore
        p = np.cross(direction, c - a)
        determinant = p @ (b - a)
        first = p @ (origin - a) / determinant
        q = np.cross(origin - a, b - a)
        second = direction @ q / determinant
        depth = (c - a) @ q / determinant
        inside = (first >= 0) & (second >= 0) & (first + second <= 1)
        result = np.minimum(result, _where_ahead(depth, inside))
    return result


_CASTERS = {PLANE: _plane, BOX: _box, SPHERE: _sphere, CYLINDER: _cylinder, MESH: _mesh}
