"""Scenes with known truth for scripts/frontier.py: the kinds that derender finds hard, under sensors of their own.

A scene is made of items on a table, drawn point-sampled by the ray caster, and seen through one of three sensors.
None of it uses derender's own priors, samplers or noise.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import trimesh

from derender.camera.intrinsics import Camera
from derender.render.raycast.depth import render_depth
from derender.scene.pose import rotation_z
from derender.scene.solids import BOX, CYLINDER, MESH, PLANE, SPHERE, Solids
from worlds.made_scenes import settle, settled_bridge

if TYPE_CHECKING:
    from trimesh import Trimesh

FIELD_OF_VIEW = 58.0  # degrees
FARTHEST = 4.0  # metres from which nothing returns
SCALE = 0.01  # share by which a phone's depths are all too long or too short
SIGMA, SHARED = 0.0015, 2.0  # metres of noise at a metre; pixels over which neighbours share it
SOLIDS = {"box": BOX, "cube": BOX, "cylinder": CYLINDER, "sphere": SPHERE}
SUPPORT, BEHIND = -1, -2  # labels


class Kind(NamedTuple):
    """How the scenes of a kind are seen."""

    says: str
    sensor: str = "white"
    down: tuple[float, float] = (30.0, 55.0)  # degrees by which the camera looks down
    away: tuple[float, float] = (0.7, 1.0)  # metres, (low, high)
    size: tuple[int, int] = (320, 240)
    known: bool = False  # whether the first thing's size is told
    scale: float = 1.0  # times as long are all lengths, noise's too


KINDS = {
    "edge": Kind("a table that ends, the room's floor below it, a wall and clutter behind", "shared"),
    "empty": Kind("a bare table, some of them ending in no return", "shared"),
    "fills": Kind("one box that fills most of the view", "shared"),
    "free": Kind("bowls, mugs, bottles, L-shapes, wedges and cones among boxes", "shared"),
    "stereo": Kind("active stereo: quantised disparity, fattened edges, a slow bias", "stereo"),
    "phone": Kind("a phone's LiDAR, 256x192: smoothed, its noise shared by neighbours, scale off by 1 %", "phone",
                  size=(256, 192)),
    "small": Kind("things of 20 to 60 pixels", away=(1.4, 1.7)),
    "wide": Kind("eight cubes of 38 mm at 640x480", size=(640, 480)),
    "overhead": Kind("boxes, cylinders and spheres from above", down=(80.0, 90.0)),
    "rows": Kind("rows of boxes seen from 8 to 20 degrees", down=(8.0, 20.0)),
    "clutter": Kind("eight to twelve mixed solids dropped side by side", away=(0.8, 1.0)),
    "heap": Kind("solids thrown onto each other"),
    "boards": Kind("a board that leans on a box"),
    "bridges": Kind("a plank on two towers"),
    "pallets": Kind("2 x 3 x 2 to 3 x 3 x 3 equal cartons with gaps of 0 to 5 mm", away=(2.0, 2.5)),
    "cartons": Kind("such pallets where the carton's size is known", away=(2.0, 2.5), known=True),
    "heights": Kind("two tables at different heights, things on both, the room's floor below them", "shared"),
    "dice": Kind("dice of 1 cm", scale=0.12),
    "hall": Kind("boxes, cylinders and spheres of half a metre to two metres", scale=15.0),
}  # fmt: skip


class Scene(NamedTuple):
    """One scene."""

    depth: np.ndarray  # (H, W) metres, NaN where nothing returns
    camera: Camera
    label: np.ndarray  # (H, W) number of the object, SUPPORT or BEHIND
    objects: list  # as `derender show --json` has them, parents by number or a table's name
    tables: dict  # {name: pose (4, 4), table to camera}
    free: list  # numbers of free-form ones


class Item(NamedTuple):
    """A solid on the table: its kind for the ray caster, pose (4, 4) on the table, size (3,), label, mesh or None."""

    solid: int
    pose: np.ndarray
    size: np.ndarray
    what: int
    mesh: tuple | None = None


def table_pose(rng: np.random.Generator, kind: Kind) -> np.ndarray:
    """Return a pose (4, 4), table to camera."""
    down, away = np.radians(rng.uniform(*kind.down)), rng.uniform(*kind.away)
    up = np.array([0.0, -np.cos(down), -np.sin(down)])
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([[1.0, 0.0, 0.0], np.cross(up, [1.0, 0.0, 0.0]), up])
    pose[:3, 3] = 0.0, 0.02, away
    return pose @ rotation_z(rng.uniform(-0.4, 0.4))


def at(x: float, y: float, z: float, yaw: float = 0.0) -> np.ndarray:
    """Return the pose (4, 4) of an upright solid with its centre there."""
    pose = rotation_z(yaw)
    pose[:3, 3] = x, y, z
    return pose


def turned(profile: list[tuple[float, float]]) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return (vertices, triangles) of a solid of revolution, its box's extents 1, and its (diameter, height)."""
    return framed(trimesh.creation.revolve(np.array(profile), sections=40))


def framed(mesh: "Trimesh") -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return ((vertices, triangles), size (3,)) of a mesh, centred, its box's extents 1."""
    points = mesh.vertices - 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    size = np.ptp(points, axis=0)
    return (np.ascontiguousarray(points / size), np.ascontiguousarray(mesh.faces, np.int32)), size


def free_form(rng: np.random.Generator) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return (mesh, size) of a bowl, a mug with a handle, a bottle, an L-shape, a wedge or a cone."""
    r, h = rng.uniform(0.04, 0.08), rng.uniform(0.05, 0.09)
    kind = rng.choice(["bowl", "mug", "bottle", "L", "wedge", "cone"])
    if kind == "L":
        foot = trimesh.creation.box([2.0 * r, 1.2 * r, 0.6 * r])
        post = trimesh.creation.box([0.6 * r, 1.2 * r, 1.8 * r])
        post.apply_translation([-0.7 * r, 0, 0.6 * r])
        return framed(trimesh.util.concatenate([foot, post]))
    if kind == "wedge":
        corners = [[x, y, z] for x in (-r, r) for y, z in ((-0.7 * r, 0), (0.7 * r, 0), (0.7 * r, h))]
        return framed(trimesh.Trimesh(corners).convex_hull)
    if kind == "cone":
        return turned([(0, 0), (r, 0), (rng.uniform(0.0, 0.4) * r, 1.5 * h), (0, 1.5 * h)])
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
    return framed(trimesh.util.concatenate([trimesh.Trimesh(vertices * size, faces), ring]))


def bare_room() -> list[Item]:
    """Return the Items of a room: its floor, 70 cm below the table, and a wall."""
    return [Item(PLANE, at(0, 0, -0.7), np.zeros(3), BEHIND),
            Item(BOX, at(0, 1.2, 0.8), np.array([6.0, 0.1, 3.0]), BEHIND)]  # fmt: skip


def room(rng: np.random.Generator) -> list[Item]:
    """Return the Items of a table top that ends, a floor below, a wall and clutter behind."""
    top = np.array([rng.uniform(0.7, 0.9), rng.uniform(0.5, 0.6), 0.04])
    items = [Item(BOX, at(0, 0, -0.02), top, SUPPORT), *bare_room()]
    for _ in range(rng.integers(2, 5)):
        size = rng.uniform(0.1, 0.4, 3) + [0.0, 0.0, 0.7]
        place = at(rng.uniform(-0.7, 0.7), rng.uniform(0.55, 0.9), 0.5 * size[2] - 0.7, rng.uniform(0, 1.5))
        items.append(Item(BOX, place, size, BEHIND))
    return items


def apart(rng, count, spread, shape_of, free=False):
    """Return (types, sizes, poses, meshes) of so many upright solids that do not touch.

    shape_of : function of rng that returns (type, size). free : whether every other one is free-form.
    """
    types, sizes, poses, meshes = [], [], [], []
    while len(types) < count:
        kind, size = shape_of(rng)
        mesh = None
        if free and len(types) % 2 == 0:
            kind, (mesh, size) = "thing", free_form(rng)
        place = rng.uniform(-1, 1, 2) * spread
        reach = 0.5 * np.hypot(*size[:2]) + 0.01
        if any(
            np.hypot(*(place - p[:2, 3])) < reach + 0.5 * np.hypot(*s[:2]) for p, s in zip(poses, sizes, strict=True)
        ):
            continue
        types.append(kind)
        sizes.append(np.asarray(size, float))
        poses.append(at(*place, 0.5 * size[2], rng.uniform(0, 6.2)))
        meshes.append(mesh)
    return types, sizes, poses, meshes


def some_solid(rng: np.random.Generator, low: float = 0.04, high: float = 0.13) -> tuple[str, np.ndarray]:
    """Return (type, size) of a box, a cube, a cylinder or a sphere."""
    kind = str(rng.choice(["box", "box", "cube", "cylinder", "sphere"]))
    size = rng.uniform(low, high, 3)
    return kind, size[{"box": [0, 1, 2], "cylinder": [0, 0, 1]}.get(kind, [0, 0, 0])]


def dropped(rng: np.random.Generator, low: Any, high: Any, spread: Any, upright: Any) -> Any:
    """Return (types, sizes, poses, parents) of solids that physics has put to rest."""
    while True:
        types, sizes = zip(*[some_solid(rng) for _ in range(rng.integers(low, high))], strict=True)
        rest = settle(rng, types, np.array(sizes), spread, upright)
        if rest is not None and np.abs(rest[0][:, :2, 3]).max() < 0.3:
            return types, sizes, *rest


def leaning_board(rng: np.random.Generator) -> tuple[list[list[int] | np.ndarray | str], ...]:
    """Return (types, sizes, poses, parents) of a box and a board that stands on the floor and leans on it.

    As in all made scenes an object's parent is what bears most of it; against what else it leans is not asked.
    """
    box = rng.uniform((0.06, 0.1, 0.06), (0.1, 0.16, 0.12))
    thick, wide, foot = rng.uniform(0.008, 0.02), rng.uniform(0.05, 0.1), rng.uniform(0.05, 0.1)
    long = np.hypot(foot, box[2]) * rng.uniform(1.1, 1.5)
    tilt = np.arctan2(box[2], foot)  # of its lower face, from the foot to the box's upper edge
    turn = at(0, 0, 0, rng.uniform(0, 6.2))
    along, normal = np.array([np.cos(tilt), 0, np.sin(tilt)]), np.array([-np.sin(tilt), 0, np.cos(tilt)])
    board = np.eye(4)
    board[:3, :3] = np.column_stack([along, [0, 1, 0], normal])
    board[:3, 3] = [-0.5 * box[0] - foot, 0, 0] + 0.5 * long * along + 0.5 * thick * normal
    board[1, 3] = rng.uniform(-0.02, 0.02)
    poses = [turn @ at(0, 0, 0.5 * box[2]), turn @ board]
    return ["box", "box"], [box, np.array([long, wide, thick])], poses, ["floor", "floor"]


def stacked_cartons(rng):
    """Return (types, sizes, poses, parents) of 2 x 3 x 2 to 3 x 3 x 3 equal cartons."""
    size, gap = rng.uniform((0.3, 0.2, 0.15), (0.4, 0.3, 0.3)), rng.uniform(0, 0.005)
    long, high = rng.integers(2, 4, 2)
    turn, poses, parents = at(0, 0, 0, rng.uniform(0, 6.2)), [], []
    for k in range(high):
        for i in range(long):
            for j in range(3):
                place = (np.array([i, j]) - [0.5 * (long - 1), 1.0]) * (size[:2] + gap)
                parents.append("floor" if k == 0 else len(poses) - 3 * long)
                poses.append(turn @ at(*place, (k + 0.5) * size[2]))
    return ["box"] * len(poses), [size] * len(poses), poses, parents


HEIGHTS = ((-0.32, 0.3), (0.32, 0.27))  # metres: middle and half the width of two tables side by side


def on_two_tables(rng: np.random.Generator) -> Any:
    """Return (types, sizes, poses, parents, Items of the tables and the room, height of the second in metres)."""
    rise = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.06, 0.25))
    types, sizes, poses, parents, items = [], [], [], [], bare_room()
    for (middle, half), height, name in zip(HEIGHTS, (0.0, rise), ("floor", "second"), strict=True):
        items.append(Item(BOX, at(middle, 0, height - 0.02), np.array([2.0 * half, 0.55, 0.04]), SUPPORT))
        kinds, extents, places, _ = apart(rng, rng.integers(1, 4), (half - 0.1, 0.17), some_solid)
        types, sizes = [*types, *kinds], [*sizes, *extents]
        poses += [at(middle, 0, height) @ place for place in places]
        parents += [name] * len(kinds)
    return types, sizes, poses, parents, items, rise


def arranged(rng, name):
    """Return (types, sizes, poses, parents, second supports, meshes) of what stands on the table in a kind's scene."""
    parents = supports = meshes = None
    if name == "fills":
        size = np.append(rng.uniform(0.4, 0.6, 2), rng.uniform(0.25, 0.4))
        types, sizes, poses = ["box"], [size], [at(0, 0, 0.5 * size[2], rng.uniform(0, 1.5))]
    elif name == "empty":
        types, sizes, poses = [], [], []
    elif name == "dice":
        types, sizes, poses, meshes = apart(rng, rng.integers(3, 9), (0.3, 0.2), lambda r: ("cube", np.full(3, 0.083)))
    elif name in ("edge", "free", "overhead", "stereo", "phone", "hall"):
        types, sizes, poses, meshes = apart(rng, rng.integers(2, 6), (0.27, 0.17), some_solid, name == "free")
        if name in ("stereo", "phone", "overhead"):  # something stands on the first flat top
            below = next((k for k, kind in enumerate(types) if kind in ("box", "cube")), None)
            if below is not None:
                size = rng.uniform(0.4, 0.8, 3) * sizes[below]
                top = poses[below].copy()
                top[2, 3] = sizes[below][2] + 0.5 * size[2]
                parents = ["floor"] * len(types) + [below]
                types, sizes = [*types, "box"], [*sizes, size]
                poses, meshes = [*poses, top @ rotation_z(rng.uniform(-0.4, 0.4))], [*meshes, None]
    elif name == "small":
        types, sizes, poses, meshes = apart(rng, rng.integers(3, 7), (0.3, 0.2), lambda r: some_solid(r, 0.025, 0.032))
    elif name == "wide":
        types, sizes, poses, meshes = apart(rng, 8, (0.25, 0.15), lambda r: ("cube", np.full(3, 0.038)))
    elif name == "rows":
        count = int(rng.integers(3, 6))
        types, sizes = ["box"] * count, [rng.uniform(0.04, 0.1, 3) for _ in range(count)]
        turn, poses = at(0, 0, 0, rng.uniform(-0.5, 0.5)), []
        for k, size in enumerate(sizes):
            x = 0.13 * (k - 0.5 * (count - 1))
            poses.append(turn @ at(x, rng.uniform(-0.06, 0.06), 0.5 * size[2], rng.uniform(0, 1.5)))
    elif name == "clutter":
        types, sizes, poses, parents = dropped(rng, 8, 13, 0.12, 0.7)
    elif name == "heap":
        types, sizes, poses, parents = dropped(rng, 5, 8, 0.04, 0.0)
    elif name == "boards":
        types, sizes, poses, parents = leaning_board(rng)
    elif name == "bridges":
        types, sizes, poses, parents, supports = settled_bridge(rng)
    else:
        types, sizes, poses, parents = stacked_cartons(rng)
    count = len(types)
    return types, sizes, poses, parents or ["floor"] * count, supports or [()] * count, meshes or [None] * count


def make(rng: np.random.Generator, name: str) -> Scene:
    """Return one Scene of the kind of this name."""
    kind = KINDS[name]
    camera = Camera.from_field_of_view(*kind.size, FIELD_OF_VIEW)
    table = table_pose(rng, kind)
    items = room(rng) if name == "edge" else [Item(PLANE, np.eye(4), np.zeros(3), SUPPORT)]
    tables = {"floor": table}
    if name == "heights":
        types, sizes, poses, parents, items, rise = on_two_tables(rng)
        supports, meshes = [()] * len(types), [None] * len(types)
        tables["second"] = table @ at(0, 0, rise)
    else:
        types, sizes, poses, parents, supports, meshes = arranged(rng, name)
    for k, (kind_of, size, pose, mesh) in enumerate(zip(types, sizes, poses, meshes, strict=True)):
        items.append(Item(SOLIDS.get(kind_of, MESH), pose, size, k, mesh))
    with_mesh = np.array([item.mesh is not None for item in items])
    solids = Solids(np.array([item.solid for item in items], np.int32), np.array([table @ item.pose for item in items]),
                    np.array([item.size for item in items], float),
                    np.where(with_mesh, np.cumsum(with_mesh) - 1, -1).astype(np.int32),
                    tuple(item.mesh for item in items if item.mesh is not None))  # fmt: skip
    depth, which = render_depth(solids, camera)
    label = np.array([*(item.what for item in items), BEHIND])[which]
    if name == "empty" and rng.random() < 0.5:
        depth[: camera.height // 4] = np.nan
    depth = np.where(np.isfinite(depth) & (depth < FARTHEST), depth, np.nan)
    depth = SENSORS[kind.sensor](rng, depth)
    objects = [{"type": t, "size": kind.scale * s, "pose": enlarged(table @ p, kind.scale), "parent": on,
                "supports": others}
               for t, s, p, on, others in zip(types, sizes, poses, parents, supports, strict=True)]  # fmt: skip
    free = [k for k, mesh in enumerate(meshes) if mesh is not None]
    tables = {name: enlarged(pose, kind.scale) for name, pose in tables.items()}
    return Scene(kind.scale * depth, camera, label, objects, tables, free)


def enlarged(pose: np.ndarray, scale: float) -> np.ndarray:
    """Return a pose (4, 4) so many times as far away."""
    pose = pose.copy()
    pose[:3, 3] *= scale
    return pose


def smooth_noise(rng: np.random.Generator, shape: tuple[int, int], reach: float) -> np.ndarray:
    """Return (H, W) noise of standard deviation 1 that neighbours within about `reach` pixels share."""
    from scipy import ndimage

    noise = ndimage.gaussian_filter(rng.standard_normal(shape), reach, mode="wrap")
    return noise / noise.std()


def white(rng: np.random.Generator, depth: np.ndarray) -> np.ndarray:
    """Return the depth with noise of single pixels, 1 mm at a metre."""
    return depth + 0.001 * depth**2 * rng.standard_normal(depth.shape)


def shared(rng: np.random.Generator, depth: np.ndarray) -> np.ndarray:
    """Return the depth with noise that grows with depth and is shared by neighbours."""
    return depth + SIGMA * depth**2 * smooth_noise(rng, depth.shape, SHARED)


def stereo(rng: np.random.Generator, depth: np.ndarray) -> np.ndarray:
    """Return the depth as active stereo gives it: what is near is fattened by about a pixel, what only one eye sees is
    lost, disparities (in the sensor's pixels: 600 of focal length, 50 mm of baseline) are off by what neighbours share,
    slowly bent, and quantised."""
    from scipy import ndimage

    baseline_focal, step, error, bias = 30.0, 1 / 32, 0.05, 0.08  # metres times pixels; the others pixels
    disparity = baseline_focal / np.nan_to_num(depth, nan=np.inf)
    fat = ndimage.maximum_filter(disparity, 3)
    reach = smooth_noise(rng, depth.shape, 3.0) > -0.7  # blocks match at their centres here and there
    jump = fat - disparity > 0.5
    disparity = np.where(jump & reach, fat, disparity)
    disparity += error * smooth_noise(rng, depth.shape, 1.5) + bias * smooth_noise(rng, depth.shape, 40.0)
    disparity = np.round(disparity / step) * step
    lost = rng.random(depth.shape) < 0.01
    ahead = np.roll(disparity, -1, axis=1)
    for shift in range(4):  # beside a near thing, on its left, the other eye sees the thing in place of what is behind
        lost |= np.roll(ahead, -shift, axis=1) - disparity > 2.0 * (shift + 1)
    with np.errstate(divide="ignore"):
        return np.where(lost | (disparity < baseline_focal / FARTHEST), np.nan, baseline_focal / disparity)


def phone(rng: np.random.Generator, depth: np.ndarray) -> np.ndarray:
    """Return the depth as a phone's software makes it of a few hundred LiDAR points: smooth even over edges, its noise
    shared by neighbours, all of it too long or too short by 1 %."""
    from scipy import ndimage

    depth = ndimage.gaussian_filter(np.nan_to_num(depth, nan=FARTHEST), 1.0)
    depth = depth * (1.0 + rng.choice([-SCALE, SCALE]))
    depth += (0.001 + 0.002 * depth**2) * smooth_noise(rng, depth.shape, 4.0)
    return np.where(depth < 0.95 * FARTHEST, depth, np.nan)


SENSORS = {"white": white, "shared": shared, "stereo": stereo, "phone": phone}
