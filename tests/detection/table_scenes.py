"""Small scenes on a table, drawn with noise: for the tests of things and of the background."""

import numpy as np
import trimesh

from derender.camera.intrinsics import Camera
from derender.render.raycast.depth import render_depth
from derender.scene.solids import PLANE, Solids

CAMERA = Camera.from_field_of_view(160, 120)
TABLE = np.array([[1.0, 0, 0, 0], [0, -0.5, -0.8660254, 0.02], [0, 0.8660254, -0.5, 0.75], [0, 0, 0, 1]])
SIGMA = 0.001


def seen_on_the_table(solids, seed=0, table=TABLE):
    """Return a noisy depth image of (kind, x, y, size, mesh or None) that stand on the table."""
    kinds, poses, sizes, which, meshes = [PLANE], [table], [np.zeros(3)], [-1], []
    for kind, x, y, size, mesh in solids:
        pose = np.eye(4)
        pose[:3, 3] = x, y, 0.5 * size[2]
        kinds.append(kind), poses.append(table @ pose), sizes.append(np.array(size, float))
        which.append(-1 if mesh is None else len(meshes))
        if mesh is not None:
            meshes.append((mesh[0] / np.ptp(mesh[0], axis=0), mesh[1]))
    scene = Solids(
        np.array(kinds, np.int32), np.array(poses), np.array(sizes), np.array(which, np.int32), tuple(meshes)
    )
    depth, _ = render_depth(scene, CAMERA)
    return depth + SIGMA * np.random.default_rng(seed).standard_normal(depth.shape)


def bowl(radius=0.07, height=0.06):
    """Return vertices and triangles of a bowl about its bounding box's centre."""
    inner = 0.92 * radius
    line = [(0, 0), (0.5 * radius, 0), (radius, height), (inner, height), (0.45 * radius, 0.006), (0, 0.006)]
    mesh = trimesh.creation.revolve(np.array(line), sections=48)
    return mesh.vertices - [0, 0, 0.5 * height], np.ascontiguousarray(mesh.faces, np.int32)


def blob(seed):
    """Return vertices and triangles of a ball with six lobes, which meet in creases."""
    ball, rng = trimesh.creation.icosphere(4), np.random.default_rng(seed)
    ways = rng.normal(size=(6, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    points = ball.vertices * (1.0 + 0.6 * np.exp(-8.0 * (1.0 - ball.vertices @ ways.T)).sum(axis=1))[:, None]
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return points - middle, np.ascontiguousarray(ball.faces, np.int32)
