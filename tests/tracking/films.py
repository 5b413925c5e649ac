"""Small films with known truth, made by moving solids by hand: no physics engine, no inference of the first frame."""

import numpy as np

from derender.camera.intrinsics import Camera
from derender.scene.pose import from_rotation_vector, inverse
from derender.scene.solids import BOX, SPHERE
from derender.tracking.thing import TIES, Start, Thing
from worlds.made_scenes import render_floor_scene

CAMERA = Camera.from_field_of_view(96, 72)
NOISE = 0.0015
FPS = 30.0


def view(elevation=35.0, distance=0.7):
    """Return the floor's pose (4, 4), z up, before a camera that looks down at its origin."""
    a = np.radians(elevation)
    forward = np.array([0.0, np.cos(a), -np.sin(a)])
    right = np.array([1.0, 0.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[2, 3] = distance
    return pose


def at(x, y, z, turn=(0.0, 0.0, 0.0)):
    """Return a pose (4, 4) on the floor."""
    pose = from_rotation_vector(turn)
    pose[:3, 3] = x, y, z
    return pose


def film(rng, types, sizes, paths, views=None):
    """Return (frames (T, H, W), poses (T, N, 4, 4) to camera); paths : (T, N, 4, 4) to the floor."""
    frames, poses = [], []
    for t, row in enumerate(paths):
        floor = view() if views is None else views[t]
        posed = floor @ np.reshape(row, (-1, 4, 4))
        depth, _ = render_floor_scene(types, posed, sizes, floor, CAMERA)
        frames.append(depth + NOISE * rng.standard_normal(depth.shape))
        poses.append(posed)
    return np.array(frames), np.array(poses)


def start(types, sizes, poses, off=0.0):
    """Return the beginning of a film whose first frame is known, but for `off` metres."""
    things = []
    for k, (kind, size) in enumerate(zip(types, sizes, strict=True)):
        pose = np.array(poses[k])
        pose[0, 3] += off
        spread = np.repeat([0.002, 0.02, 0.002], [3, 3, len(TIES[kind])])
        code = SPHERE if kind == "sphere" else BOX
        things.append(Thing(f"{kind}_{k + 1}", kind, code, np.array(size, float), pose, np.diag(spread**2)))
    return Start(things, view(), -view()[:3, 2], NOISE, 0.0, 0.0, 1.0)


def errors(track, truth):
    """Return (T, N) distances of the centres, metres."""
    return np.linalg.norm(track.poses[..., :3, 3] - truth[..., :3, 3], axis=-1)


def still_view_of(views):
    """Return (T, 4, 4) the motion of a camera since its first frame."""
    return np.array([v @ inverse(views[0]) for v in views])
