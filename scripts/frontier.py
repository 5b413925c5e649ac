"""Measure inference where it is hardest: made scenes with walls, clutter and edges, with nothing, and free-form things.

    python scripts/frontier.py                        every kind, 12 scenes each
    python scripts/frontier.py edge free -n 24 -v     some kinds, more scenes, a line for each

edge : a table that ends, the room's floor below it, a wall and clutter behind, a shelf at another height
empty : a bare table, some ending in no return; fills : one box that fills most of the view
free : bowls, mugs and bottles among boxes

Recall and precision are of objects by their silhouettes (intersection over union at least .5 of the pixels that show
them); `background` counts solids a scene that show background; `one each` is the share of free-form things that are one
object; `explained` the share of the pixels within 3 cm of what is explained. Noise is shared by neighbours, as sensors
have it.
"""

import argparse
import sys
import time

import numpy as np
import trimesh

from derender.camera.intrinsics import Camera
from derender.cli import status_of
from derender.render.raycast.depth import render_depth
from derender.scene.pose import rotation_z
from derender.scene.solids import BOX, CYLINDER, MESH, PLANE, Solids
from derender.structures.infer import infer_structure
from derender.structures.options import Options

KINDS = ("edge", "empty", "fills", "free")
CAMERA = Camera.from_field_of_view(320, 240, 58.0)
SIGMA, SHARED = 0.0015, 2.0  # metres of noise at a metre; pixels over which neighbours share it
FEWEST = 100  # pixels of an object that is to be found
IOU = 0.5


def table_pose(rng):
    """Return a pose (4, 4), table to camera, seen from above at 30 to 55 degrees from 0.7 to 1 m."""
    down, away = np.radians(rng.uniform(30.0, 55.0)), rng.uniform(0.7, 1.0)
    up = np.array([0.0, -np.cos(down), -np.sin(down)])
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([[1.0, 0.0, 0.0], np.cross(up, [1.0, 0.0, 0.0]), up])
    pose[:3, 3] = 0.0, 0.02, away
    return pose @ rotation_z(rng.uniform(-0.4, 0.4))


def turned(profile):
    """Return (vertices, triangles) of a solid of revolution, its box's extents 1, and its (diameter, height)."""
    mesh = trimesh.creation.revolve(np.array(profile), sections=40)
    vertices = mesh.vertices - 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    size = np.ptp(vertices, axis=0)
    return (np.ascontiguousarray(vertices / size), np.ascontiguousarray(mesh.faces, np.int32)), size


def free_form(rng):
    """Return (mesh, size) of a bowl, a mug with a handle, or a bottle."""
    r, h = rng.uniform(0.04, 0.08), rng.uniform(0.05, 0.09)
    kind = rng.choice(["bowl", "mug", "bottle"])
    if kind == "bowl":
        return turned([(0, 0), (0.5 * r, 0), (r, h), (0.93 * r, h), (0.45 * r, 0.006), (0, 0.006)])
    if kind == "bottle":
        r, h = 0.5 * r + 0.01, 3.0 * h
        return turned([(0, 0), (r, 0), (r, 0.6 * h), (0.4 * r, 0.8 * h), (0.4 * r, h), (0, h)])
    r = 0.6 * r + 0.01
    (vertices, faces), size = turned([(0, 0), (r, 0), (r, h), (0.9 * r, h), (0.9 * r, 0.006), (0, 0.006)])
    ring = trimesh.creation.torus(0.3 * h, 0.09 * h, 24, 10)
    ring.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    ring.apply_translation([r + 0.25 * h, 0, 0])
    both = trimesh.util.concatenate([trimesh.Trimesh(vertices * size, faces), ring])
    points = both.vertices - 0.5 * (both.vertices.min(axis=0) + both.vertices.max(axis=0))
    size = np.ptp(points, axis=0)
    return (np.ascontiguousarray(points / size), np.ascontiguousarray(both.faces, np.int32)), size


def make(rng, kind):
    """Return (depth, label (H, W) of the objects or -1, which objects are free-form) of one scene."""
    table = table_pose(rng)
    items = []  # (kind of solid, pose on the table, size, mesh, what it is: object number, -1 support, -2 background)

    def put(solid, x, y, bottom, size, what, mesh=None, yaw=0.0):
        pose = rotation_z(yaw)
        pose[:3, 3] = x, y, bottom + 0.5 * size[2]
        items.append((solid, table @ pose, np.asarray(size, float), mesh, what))

    free = []
    if kind == "edge":
        put(BOX, 0.0, 0.0, -0.04, (rng.uniform(0.7, 0.9), rng.uniform(0.5, 0.6), 0.04), -1)
        floor = np.eye(4)
        floor[2, 3] = -0.7
        items.append((PLANE, table @ floor, np.zeros(3), None, -2))
        put(BOX, 0.0, 1.2, -0.7, (6.0, 0.1, 3.0), -2)
        for _ in range(rng.integers(2, 5)):
            size = rng.uniform(0.1, 0.4, 3)
            put(
                BOX,
                rng.uniform(-0.7, 0.7),
                rng.uniform(0.55, 0.9),
                -0.7,
                (*size[:2], 0.7 + size[2]),
                -2,
                yaw=rng.uniform(0, 1.5),
            )
    else:
        items.append((PLANE, table, np.zeros(3), None, -1))
    if kind == "fills":
        put(BOX, 0.0, 0.0, 0.0, (*rng.uniform(0.4, 0.6, 2), rng.uniform(0.25, 0.4)), 0, yaw=rng.uniform(0, 1.5))
    if kind in ("edge", "free"):
        places = [(x, y) for x in (-0.22, 0.0, 0.22) for y in (-0.13, 0.12)]
        for number, k in enumerate(rng.permutation(len(places))[: rng.integers(2, 6)]):
            x, y = places[k] + rng.uniform(-0.02, 0.02, 2)
            if kind == "free" and number % 2 == 0:
                mesh, size = free_form(rng)
                free.append(number)
                put(MESH, x, y, 0.0, size, number, mesh, rng.uniform(0, 6.2))
            elif rng.random() < 0.7:
                put(BOX, x, y, 0.0, rng.uniform(0.04, 0.13, 3), number, yaw=rng.uniform(0, 1.5))
            else:
                d = rng.uniform(0.04, 0.1)
                put(CYLINDER, x, y, 0.0, (d, d, rng.uniform(0.05, 0.15)), number)
    meshes = [item[3] for item in items if item[3] is not None]
    index = np.cumsum([item[3] is not None for item in items]) - 1
    solids = Solids(np.array([i[0] for i in items], np.int32), np.array([i[1] for i in items]),
                    np.array([i[2] for i in items]),
                    np.where([i[3] is not None for i in items], index, -1).astype(np.int32), tuple(meshes))  # fmt: skip
    depth, which = render_depth(solids, CAMERA)
    label = np.array([*(item[4] for item in items), -2])[which]
    if kind == "empty" and rng.random() < 0.5:
        depth[: CAMERA.height // 4] = np.nan
    return sensed(rng, depth), label, free


def sensed(rng, depth):
    """Return a depth image with noise that grows with depth and is shared by neighbours; far away nothing returns."""
    from scipy import ndimage

    noise = ndimage.gaussian_filter(rng.standard_normal(depth.shape), SHARED)
    depth = depth + SIGMA * depth**2 * noise / noise.std()
    return np.where(depth < 4.0, depth, np.nan)


def judge(told, depth, label, free):
    """Return counts: objects, found, said, on background, free-form things, those that are one object, explained."""
    objects = [k for k in range(label.max() + 1) if (label == k).sum() >= FEWEST]
    said = [k for k in range(len(told.names)) if (told.label == k).any()]
    overlap = np.array([[np.sum((told.label == j) & (label == k)) / np.sum((told.label == j) | (label == k))
                         for k in objects] for j in said]).reshape(len(said), len(objects))  # fmt: skip
    found = overlap > IOU
    shows = [np.median(label[told.label == k]) for k in said]
    one = [bool(found[:, objects.index(k)].any()) for k in free if k in objects]
    return np.array([len(objects), found.any(axis=0).sum() if said else 0, len(said), sum(x == -2 for x in shows),
                     len(one), sum(one), told.share(depth)])  # fmt: skip


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", default=KINDS, metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("-n", type=int, default=12, help="scenes of each kind")
    parser.add_argument("-v", action="store_true", help="a line for each scene")
    given = parser.parse_args(arguments)
    print("| kind | scenes | recall | precision | background a scene | one each | explained | median seconds |")
    print("|---|---|---|---|---|---|---|---|")
    for kind in given.kinds or KINDS:
        counts, seconds = [], []
        for number in range(given.n):
            depth, label, free = make(np.random.default_rng([number, KINDS.index(kind)]), kind)
            start = time.perf_counter()
            posterior = infer_structure(depth, CAMERA, Options(seed=0, method="map"))
            seconds.append(time.perf_counter() - start)
            counts.append(judge(posterior.explanation, depth, label, free))
            if given.v:
                print(kind, number, counts[-1], posterior.explanation.names, flush=True)
        true, found, said, behind, things, one, _ = total = np.sum(counts, axis=0)
        shares = [found / true if true else np.nan, found / said if said else np.nan, behind / given.n,
                  one / things if things else np.nan, total[-1] / given.n]  # fmt: skip
        print(f"| {kind} | {given.n} | " + " | ".join(f"{x:.3f}" for x in shares) + f" | {np.median(seconds):.2f} |")


if __name__ == "__main__":
    sys.exit(status_of(main))
