"""Scenes with known truth for scripts/evaluate.py: settled, noisy, mixed, tower, groups, cubes, bridge.

A scene is a dict: depth (H, W) float64 metres with NaN where nothing returned, its Camera,
label (H, W) int32 (index of the object, -1 floor, -2 nothing), and objects: list of dicts with type, size (3,),
pose (4, 4) object to camera, parent ("floor" or an index), pixels (how many are visible), and in the set `bridge`
supports (indices of what else carries it).
"""

from dataclasses import replace
from typing import Any

import numpy as np

from derender.camera.intrinsics import Camera
from derender.detection.solids.image import FAR, ROW, draw, make_image, make_row
from derender.physics.bodies import DENSITY
from derender.render.blur import blur
from derender.render.raycast.depth import render_depth
from derender.scene.pose import rotation_x, translation
from derender.scene.solids import BOX, KINDS, PLANE, Solids
from worlds.settling import come_to_rest

BEARS = 0.1  # share of a body's weight from which another one counts as carrying it
GRAVITY = 9.81


def turned(yaw: float, x: float, y: float, z: float) -> np.ndarray:
    """Return the pose (4, 4) of an upright body."""
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:3, 3] = [x, y, z]
    return pose


def place_bridge(rng):
    """Return sizes (3, 3) and poses (3, 4, 4), object to world: two towers 5 to 12 cm high and a plank over them."""
    height, yaw = rng.uniform(0.05, 0.12), rng.uniform(0, np.pi)
    plank = np.array([rng.uniform(0.16, 0.26), rng.uniform(0.04, 0.08), rng.uniform(0.02, 0.04)])
    sizes = np.array([[*rng.uniform(0.04, 0.07, 2), height], [*rng.uniform(0.04, 0.07, 2), height], plank])
    along, across = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    poses = []
    for side in (-1, 1):
        middle = side * rng.uniform(0.3, 0.42) * plank[0] * along + rng.uniform(-0.008, 0.008) * across
        poses.append(turned(yaw + rng.uniform(-0.3, 0.3), *middle, height / 2))
    poses.append(turned(yaw, 0.0, 0.0, height + plank[2] / 2))
    return sizes, np.array(poses)


def let_rest(sizes: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Let upright boxes come to rest where they stand; see `come_to_rest`."""
    turns = [about_z(np.arctan2(pose[1, 0], pose[0, 0])) for pose in poses]
    bodies = [free_body("box", *each) for each in zip(sizes, poses[:, :3, 3], turns, strict=True)]
    return come_to_rest(bodies, 2.0)


def about_z(yaw: float) -> np.ndarray:
    """Return the quaternion (4,), w first, of a turn about z."""
    return np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])


def free_body(kind: str, size: np.ndarray, place: np.ndarray, turn: np.ndarray) -> str:
    """Return the MJCF of a solid that is free to move. place : (3,) metres. turn : (4,) quaternion, w first."""
    shape, extents = {"sphere": ("sphere", size[:1]), "cylinder": ("cylinder", size[[0, 2]])}.get(kind, ("box", size))
    numbers = (" ".join(map(str, each)) for each in (place, turn, extents / 2))
    return '<body pos="{}" quat="{}"><freejoint/><geom type="{shape}" size="{}"/></body>'.format(*numbers, shape=shape)


def settled_bridge(rng: np.random.Generator) -> Any:
    """Return kinds, sizes, poses, parents and second supports of a bridge at rest that bears on both its towers."""
    while True:
        sizes, poses = place_bridge(rng)
        rest = let_rest(sizes, poses)
        if rest is None:
            continue
        poses, lift = rest
        weight = DENSITY * GRAVITY * np.prod(sizes, axis=1)
        bears = lift > BEARS * weight[:, None]
        carried = [[int(j) - 1 for j in np.argsort(-lift[k]) if bears[k, j]] for k in range(3)]
        if carried[0] == carried[1] == [-1] and set(carried[2]) == {0, 1}:
            parents = ["floor", "floor", carried[2][0]]
            return ["box"] * 3, sizes, poses, parents, [[], [], carried[2][1:]]


SETS = ("settled", "noisy", "mixed", "tower", "groups", "cubes", "bridge")


FIELD_OF_VIEW = np.radians(60.0)
KINECT_DISPARITY = 580.0 * 0.075  # focal length in pixels times baseline in metres


def camera_of(width: int, height: int) -> Camera:
    """Return the pinhole camera that sees the scenes."""
    focal = width / 2 / np.tan(FIELD_OF_VIEW / 2)
    return Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)


def look_at(rng: np.random.Generator, distance: float, elevation: float, target: np.ndarray) -> np.ndarray:
    """Return the pose of the world (z up) in a camera at this distance and elevation that looks at `target`."""
    azimuth = rng.uniform(0, 2 * np.pi)
    direction = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    forward = -direction
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ (np.asarray(target) + distance * direction)
    return pose


def random_size(rng: np.random.Generator, kind: str, low: float = 0.04, high: float = 0.14) -> np.ndarray:
    """Return the full extents (3,) of a solid of this kind, each edge or diameter uniform in [low, high] metres."""
    if kind == "cube":
        return np.full(3, rng.uniform(low, high))
    if kind == "sphere":
        return np.full(3, rng.uniform(low, 0.8 * high))
    if kind == "cylinder":
        diameter = rng.uniform(low, 0.7 * high)
        return np.array([diameter, diameter, rng.uniform(low, high)])
    return rng.uniform(low, high, 3)


def settle(rng, kinds, sizes, spread, upright_share=0.5, seconds=4.0):
    """Drop solids one above the other into MuJoCo, let them come to rest, and read who carries whom.

    Returns poses (N, 4, 4), object to world (z up, floor at 0), and parents, a list of "floor" or index: the body that
    bears most of the object's weight (upward part of the contact force); None where the scene does not come to rest.
    """
    geoms, height = [], 0.02
    for kind, size in zip(kinds, sizes, strict=True):
        quaternion = rng.normal(size=4)
        if rng.random() < upright_share:
            quaternion = about_z(rng.uniform(0, 2 * np.pi))
        quaternion /= np.linalg.norm(quaternion)
        height += float(np.linalg.norm(size)) / 2
        x, y = rng.uniform(-spread, spread, 2)
        geoms.append(free_body(kind, size, np.array([x, y, height]), quaternion))
        height += float(np.linalg.norm(size)) / 2 + 0.005
    rest = come_to_rest(geoms, seconds)
    if rest is None:
        return None
    poses, lift = rest
    parents = ["floor" if j == 0 else int(j - 1) for j in lift.argmax(axis=1)]
    return poses, parents


def stack(rng: np.random.Generator, count: int) -> tuple[list[str], np.ndarray, np.ndarray, list[int | str]]:
    """Return kinds, sizes, poses and parents of a flush tower of boxes: upright, centres anywhere on the face below."""
    kinds, sizes, poses, parents = [], [], [], []
    height, centre, yaw = 0.0, np.zeros(2), rng.uniform(0, np.pi / 2)
    for index in range(count):
        kind = "cube" if rng.random() < 0.5 else "box"
        size = random_size(rng, kind)
        if index:
            half = sizes[-1][:2] / 2
            offset = rng.uniform(-0.8, 0.8, 2) * half
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            centre = centre + turn @ offset
            yaw += rng.uniform(-np.pi / 4, np.pi / 4)
        pose = turned(yaw, centre[0], centre[1], height + size[2] / 2)
        height += size[2]
        kinds.append(kind)
        sizes.append(size)
        poses.append(pose)
        parents.append(index - 1 if index else "floor")
    return kinds, np.array(sizes), np.array(poses), parents


def render_floor_scene(
    kinds: list[str], poses: np.ndarray, sizes: Any, floor_pose: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Return depth (H, W), NaN where nothing is hit, and label (H, W) of solids over a floor.

    poses : (N, 4, 4) object to camera; floor_pose : (4, 4) floor to camera.
    """
    blank = np.zeros(camera.shape)
    image = make_image(blank, 1.0, camera, floor_pose)
    local = np.linalg.inv(floor_pose) @ poses
    rows = np.array(
        [make_row(KINDS[k], p[:3, :3], p[:3, 3], s) for k, p, s in zip(kinds, local, sizes, strict=True)]
    ).reshape(-1, ROW)
    depth, label = blank.copy(), np.zeros(blank.shape, np.int32)
    draw(image, rows, -1, depth, label)
    depth[depth >= FAR] = np.nan
    return depth, label


def kinect_noise(rng: np.random.Generator, depth: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Return the depth as a Kinect-like sensor gives it: noise 1.2 mm + 1.9 mm/m^2 (z - 0.4)^2, disparity in steps of
    1/8 pixel at the sensor's own focal length, 60 % of the edge pixels and 1 % of all lost."""
    noisy = depth + rng.normal(size=depth.shape) * (0.0012 + 0.0019 * (depth - 0.4) ** 2)
    disparity = np.round(KINECT_DISPARITY / noisy * 8) / 8
    noisy = KINECT_DISPARITY / np.where(disparity > 0, disparity, np.nan)  # too far to tell: no return
    filled = np.nan_to_num(depth, nan=10.0)
    edge = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        jump = np.abs(np.diff(filled, axis=axis)) > 0.02
        change = (np.diff(label, axis=axis) != 0) & jump
        before = [slice(None)] * 2
        after = [slice(None)] * 2
        before[axis], after[axis] = slice(None, -1), slice(1, None)
        edge[tuple(before)] |= change
        edge[tuple(after)] |= change
    lost = (edge & (rng.random(depth.shape) < 0.6)) | (rng.random(depth.shape) < 0.01)
    return np.where(lost, np.nan, noisy)


def photograph(
    rng: np.random.Generator,
    kinds: list[str],
    sizes: np.ndarray,
    poses: np.ndarray,
    parents: list[int | str],
    *,
    width: int = 160,
    height: int = 120,
    noise: str = "millimetre",
    distance: tuple[float, float] = (0.65, 0.9),
    elevation: tuple[float, float] = (20.0, 50.0),
) -> Any:
    """Return the scene dict that a camera sees which is so many degrees up."""
    middle = poses[:, :3, 3].mean(axis=0) * [1, 1, 0.8]
    world = look_at(rng, rng.uniform(*distance), np.radians(rng.uniform(*elevation)), middle)
    camera = camera_of(width, height)
    posed = world @ poses
    depth, label = render_floor_scene(kinds, posed, sizes, world, camera)
    if noise == "kinect":
        observed = kinect_noise(rng, depth, label)
    else:
        observed = depth + rng.normal(size=depth.shape) * 0.001
    objects = [
        {
            "type": kind, "size": size, "pose": pose, "parent": parent, "pixels": int((label == index).sum()),
        }
        for index, (kind, size, pose, parent) in enumerate(zip(kinds, sizes, posed, parents, strict=True))
    ]  # fmt: skip
    return {"depth": observed, "clean": depth, "label": label, "camera": camera, "floor": world, "objects": objects}


def make_scene(rng: np.random.Generator, name: str) -> Any:
    """Return one scene of the set `name` (one of SETS)."""
    while True:
        if name in ("settled", "noisy", "mixed", "pile"):
            count = int(rng.integers(1, 7)) if name != "pile" else int(rng.integers(4, 7))
            choices = ["box", "cube"] if name != "mixed" else ["box", "cube", "cylinder", "sphere"]
            kinds = [str(rng.choice(choices)) for _ in range(count)]
            sizes = np.array([random_size(rng, kind) for kind in kinds])
            settled = settle(rng, kinds, sizes, *((0.03, 0.2) if name == "pile" else (0.1, 0.5)))
            if settled is None:
                continue
            poses, parents = settled
            if np.abs(poses[:, :2, 3] - poses[:, :2, 3].mean(0)).max() > 0.3:
                continue
        elif name == "tower":
            kinds, sizes, poses, parents = stack(rng, int(rng.integers(3, 6)))
        elif name == "cubes":
            kinds, sizes, poses, parents = stack(rng, 3)
            kinds, sizes = ["cube"] * 3, np.full((3, 3), 0.1)
            poses[:, 2, 3] = [0.05, 0.15, 0.25]
        elif name == "groups":
            return make_groups(rng)
        elif name == "bridge":
            kinds, sizes, poses, parents, supports = settled_bridge(rng)
        else:
            raise ValueError(f"unknown set {name!r}; choose from {', '.join(SETS)}")
        scene = photograph(rng, kinds, sizes, poses, parents, noise="kinect" if name == "noisy" else "millimetre")
        if name == "bridge":
            for item, others in zip(scene["objects"], supports, strict=True):
                item["supports"] = others
        if all(o["pixels"] >= 1 for o in scene["objects"]):
            return scene


def make_groups(rng: np.random.Generator, count: Any = 20) -> Any:
    """Return 20 boxes scattered in three groups, none of which reaches into another, at 320 x 240."""
    from derender.detection.solids.interpenetration import penetration

    kinds, sizes, poses, parents = [], [], [], []
    centres = np.array([[np.cos(a), np.sin(a)] for a in rng.uniform(0, 6.28) + np.arange(3) * 2 * np.pi / 3]) * 0.3
    for group, members in enumerate(np.array_split(np.arange(count), 3)):
        while True:
            k = ["cube" if rng.random() < 0.5 else "box" for _ in members]
            s = np.array([random_size(rng, kind, 0.04, 0.10) for kind in k])
            settled = settle(rng, k, s, spread=0.12)
            if settled is not None:
                break
        pose, parent = settled
        pose[:, :2, 3] += centres[group] - pose[:, :2, 3].mean(0)
        parents += [p if p == "floor" else p + len(kinds) for p in parent]
        kinds += k
        sizes += list(s)
        poses += list(pose)
    rows = [make_row(BOX, p[:3, :3], p[:3, 3], s) for p, s in zip(poses, sizes, strict=True)]
    if any(penetration(rows[i], rows[j]) > 0.002 for i in range(count) for j in range(i)):
        return make_groups(rng, count)
    return photograph(rng, kinds, np.array(sizes), np.array(poses), parents, width=320, height=240, distance=(1.0, 1.2))


def before_horizon(
    elevation: float, distance: float, view: float, seed: int = 0, columns: int = 160, blurred: float = 0.5
) -> Any:
    """Return (depth (H, W), Camera, the floor's pose) of a cube of 6 cm before the horizon of a floor, ten metres to
    what lies behind all, with 2 mm of noise. elevation, view : degrees. blurred : pixels."""
    camera = Camera.from_field_of_view(columns, columns * 3 // 4, view)
    floor = rotation_x(np.pi / 2 + np.radians(elevation))
    floor[:3, 3] = 0.0, 0.0, distance
    cube = floor @ translation(0.11, 0.1, 0.03)
    solids = Solids(np.array([PLANE, BOX], np.int32), np.array([floor, cube]), np.array([[0.0] * 3, [0.06] * 3]),
                    np.array([-1, -1], np.int32), ())  # fmt: skip
    depth, _ = render_depth(solids, camera, background=10.0)
    noise = 0.002 * np.random.default_rng(seed).standard_normal(depth.shape)
    return blur(np.minimum(depth, 10.0), blurred) + noise, camera, floor


def drawn_scene(seed: int, prior: str, size: Any = None, sigma: Any = None) -> Any:
    """Return (graph, image, label, camera) of one draw from a prior, noise and blur included.

    size : (width, height) of the image where it is not the prior's; the field of view stays. sigma : metres of noise.
    """
    from derender.document import read_prior_document
    from derender.render.likelihoods import likelihoods
    from derender.render.raycast.depth import render_depth

    document = read_prior_document(prior)
    rng = np.random.default_rng([seed, 2026])
    graph = document.prior.sample(rng)
    camera, likelihood = document.camera, document.likelihood
    assert camera is not None and likelihood is not None, "the priors that scenes are made from name both"
    if size is not None:
        camera = replace(camera.downscaled(camera.width / size[0]), width=size[0], height=size[1])
    depth, label = render_depth(graph.solids(), camera)
    values = likelihood.sample(rng)
    if sigma is not None:
        values["sigma"] = sigma
    return graph, likelihoods[likelihood.type].sample(rng, depth, values), label, camera
