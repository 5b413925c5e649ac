"""Sizes of boxes beside what plainer tools measure, on made scenes and on real frames whose objects were measured.

    python scripts/evaluate.py peers -n 20

The peers get more than derender does: of each object the pixels that truly show it and whether it stands on the floor
(of the graspnet frames: what stands out of it). Each fits its own floor by RANSAC.
  upright      the rectangle of the least area about the footprint, from the floor up: what a plain pipeline measures
  oriented     the box of the least volume about the points, as Open3D and trimesh find it
  cuboid       two planes by RANSAC, the second across the first, and their normal; as far as points reach
  superquadric least squares of Solina and Bajcsy (IEEE PAMI 12, 1990), 11 numbers, begun at the upright box
Extents of points are taken between their 1 % and 99 % quantiles, which helps the peers against noise. (The measurements
of mosd were made as `upright` measures, noise included: they are no referee.)
"""

import numpy as np
import trimesh
from real_frames import GRASPNET, read_frame, real_folder
from scipy.ndimage import label as connected
from scipy.optimize import least_squares
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from derender.evaluation.metrics import assign, iou_matrix, solids_of
from derender.report.scene_json import scene_json
from derender.sampling.chains import SCENES, stream
from derender.structures.infer import infer_structure
from worlds.frontier_scenes import make
from worlds.made_scenes import SETS, make_scene

MADE = ("settled", "noisy", "tower", "clutter", "overhead", "stereo", "phone")
NEAR = 0.004  # metres within which a point lies on a plane of RANSAC's: about three times the noise of these images
TRIES = 300  # planes that RANSAC draws
ABOVE = 0.008  # metres from which a point of a graspnet frame stands out of the floor
TRIMMED = (0.01, 0.99)  # quantiles between which points reach
ENOUGH = 100  # pixels of an object that is measured
MOST_POINTS = 2000  # that a superquadric is fitted to


def plane_by_ransac(rng, points, normal=None):
    """Return (unit normal, offset) of the plane n . x = d of most points, across `normal` if that is given."""
    best, most = None, -1
    for _ in range(TRIES):
        first, second, third = points[rng.integers(len(points), size=3)]
        across = np.cross(second - first, third - first)
        if normal is not None:
            across -= normal * (normal @ across)
        length = np.linalg.norm(across)
        if length < 1e-12:
            continue
        across /= length
        on = np.abs((points - first) @ across) < NEAR
        if on.sum() > most:
            most, best = on.sum(), (across, on)
    if best is None:
        raise ValueError("the points lie on a line")
    if normal is not None:
        return best[0], float(np.median(points[best[1]] @ best[0]))
    middle = points[best[1]].mean(axis=0)
    return (fitted := np.linalg.svd(points[best[1]] - middle, full_matrices=False)[2][2]), float(fitted @ middle)


def floor_by_ransac(rng, points):
    """Return the pose (4, 4) of the floor in camera axes: z points at the camera."""
    normal, offset = plane_by_ransac(rng, points)
    if offset > 0:
        normal, offset = -normal, -offset
    side = np.linalg.svd(normal[None])[2][1]
    return pose_of(np.column_stack([side, np.cross(normal, side), normal]), offset * normal)


def pose_of(rotation, position):
    """Return the pose (4, 4) of these."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    return pose


def box_along(axes, points, floor, stands):
    """Return (pose (4, 4), size (3,)) of the box along `axes` (3, 3) about points, down to the floor if it `stands`."""
    low, high = np.quantile(points @ axes, TRIMMED, axis=0)
    up = axes.T @ floor[:3, 2]
    k = int(np.argmax(np.abs(up)))
    if stands:
        ground = float(floor[:3, 3] @ floor[:3, 2]) * np.sign(up[k])
        low[k], high[k] = (ground, high[k]) if up[k] > 0 else (low[k], ground)
    return pose_of(axes, axes @ (0.5 * (low + high))), np.maximum(high - low, 1e-4)


def upright(rng, points, floor, stands):
    """Return (pose, size) of the upright box over the rectangle of the least area about the footprint."""
    plan = (points @ floor[:3, :3])[:, :2]
    hull = plan[ConvexHull(plan).vertices]
    best = None
    for edge in np.roll(hull, -1, axis=0) - hull:
        along = edge / np.linalg.norm(edge)
        turn = np.array([along, [-along[1], along[0]]]).T
        area = np.prod(np.diff(np.quantile(plan @ turn, TRIMMED, axis=0), axis=0))
        if best is None or area < best[0]:
            best = area, turn
    axes = floor[:3, :3] @ np.block([[best[1], np.zeros((2, 1))], [np.zeros((1, 2)), np.eye(1)]])
    return box_along(axes, points, floor, stands)


def oriented(rng, points, floor, stands):
    """Return (pose, size) of the box of the least volume about the points."""
    into, size = trimesh.bounds.oriented_bounds(points)
    return np.linalg.inv(into), size


def cuboid(rng, points, floor, stands):
    """Return (pose, size) of the box along two planes that RANSAC finds."""
    first, offset = plane_by_ransac(rng, points)
    rest = points[np.abs(points @ first - offset) > NEAR]
    second, _ = plane_by_ransac(rng, rest if len(rest) > 10 else points, first)
    return box_along(np.column_stack([first, second, np.cross(first, second)]), points, floor, stands)


def superquadric(rng, points, floor, stands):
    """Return (pose, size) of the superquadric of least squares."""
    pose, size = upright(rng, points, floor, stands)
    some = points[rng.permutation(len(points))[:MOST_POINTS]]
    axes = pose[:3, :3] * np.sign(np.linalg.det(pose[:3, :3]))

    def missed(numbers):
        half, (e1, e2) = np.exp(numbers[:3]), numbers[3:5]
        turned = Rotation.from_rotvec(numbers[5:8]).as_matrix() @ axes.T
        x, y, z = (np.abs((some - numbers[8:]) @ turned.T) / half + 1e-9).T
        inside = (x ** (2 / e2) + y ** (2 / e2)) ** (e2 / e1) + z ** (2 / e1)
        return np.sqrt(np.prod(half)) * (inside**e1 - 1)

    start = np.r_[np.log(0.5 * size), 0.3, 0.3, 0, 0, 0, pose[:3, 3]]
    bounds = np.full((2, 11), [[-np.inf], [np.inf]])
    bounds[:, 3:5] = [[0.1], [1.9]]
    fit = least_squares(missed, start, bounds=bounds, max_nfev=200).x
    turned = Rotation.from_rotvec(fit[5:8]).as_matrix() @ axes.T
    return pose_of(turned.T, fit[8:]), 2 * np.exp(fit[:3])


PEERS = (upright, oriented, cuboid, superquadric)


def off(size, truth):
    """Return by how much the three extents, in order of length, are off on average, metres."""
    return float(np.mean(np.abs(np.sort(size) - np.sort(truth))))


def scene_of(name, number):
    """Return (depth, camera, label, objects, names of the planes that objects stand on) of a made scene."""
    if name in SETS:
        scene = make_scene(stream(number, SCENES, SETS.index(name)), name)
        return scene["depth"], scene["camera"], scene["label"], scene["objects"], ("floor",)
    scene = make(np.random.default_rng(number), name)
    return scene.depth, scene.camera, scene.label, scene.objects, tuple(scene.tables)


def measure_made(name, number, options):
    """Return for each box of a made scene the errors of derender (inf: not found) and the peers, metres."""
    depth, camera, label, true, planes = scene_of(name, number)
    graph = infer_structure(depth, camera, options, np.random.default_rng(number)).best_graph()
    found = solids_of(scene_json(graph))
    pairs = {j: i for i, j in assign(iou_matrix(found, true), 0.25)}
    rng, points = np.random.default_rng([number, 2026]), camera.points(depth)
    floor, rows = floor_by_ransac(rng, points[np.isfinite(depth)]), []
    for k, item in enumerate(true):
        shows = (label == k) & np.isfinite(depth)
        if item["type"] not in ("box", "cube") or shows.sum() < ENOUGH:
            continue
        ours = off(found[pairs[k]]["size"], item["size"]) if k in pairs else np.inf
        stands = item["parent"] in planes
        rows.append([ours, *(off(peer(rng, points[shows], floor, stands)[1], item["size"]) for peer in PEERS)])
    return rows


def measure_graspnet(folder, options):
    """Return the errors at the sugar box of the graspnet frames, as `measure_made` does. (The carton beside it was
    measured on its frame, as `upright` does: that is no referee.)"""
    depth, camera = read_frame(folder / "graspnet", "sugar")
    found = solids_of(scene_json(infer_structure(depth, camera, options, np.random.default_rng(0)).best_graph()))
    rng, points = np.random.default_rng(2026), camera.points(depth)
    floor = floor_by_ransac(rng, points[np.isfinite(depth)])
    height = np.nan_to_num((points - floor[:3, 3]) @ floor[:3, 2])
    parts, _ = connected(height > ABOVE)
    most = points[parts == 1 + np.argmax(np.bincount(parts.ravel())[1:])]
    ours = found[0]["size"] if found else np.full(3, np.inf)
    return [[off(size, GRASPNET["sugar"]) for size in (ours, *(peer(rng, most, floor, True)[1] for peer in PEERS))]]


def evaluate_peers(count, first, options):
    """Print the table: median and ninth decile of the mean error of an object's extents, and our share of the best."""
    data = {
        name: lambda name=name: sum((measure_made(name, k, options) for k in range(first, first + count)), [])
        for name in MADE
    }
    if (folder := real_folder()) is not None:
        data["graspnet"] = lambda: measure_graspnet(folder, options)
    names = ["derender", *(peer.__name__ for peer in PEERS)]
    print(f"| data | boxes | {' | '.join(names)} | best peer's error, times ours |\n" + "|---" * (3 + len(names)) + "|")
    for name, measure in data.items():
        errors = 1000 * np.array(measure())
        middle, most = np.quantile(errors, 0.5, axis=0), np.quantile(errors, 0.9, axis=0, method="higher")
        cells = [f"{a:.1f} ({b:.1f})" for a, b in zip(middle, most, strict=True)]
        print(f"| {name} | {len(errors)} | {' | '.join(cells)} | {middle[1:].min() / middle[0]:.1f} |", flush=True)
    print("\nmm: median (ninth decile) of the mean error of an object's extents")
