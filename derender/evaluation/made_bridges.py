"""Scenes of a plank that rests on two boxes of equal height: settled by MuJoCo, which also says who bears weight."""

import numpy as np

from derender.physics.settling import DENSITY, come_to_rest

BEARS = 0.1  # share of a body's weight from which another one counts as carrying it
GRAVITY = 9.81


def turned(yaw, x, y, z):
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


def let_rest(sizes, poses, seconds=2.0):
    """Let upright boxes come to rest where they stand; see `come_to_rest`."""
    bodies = []
    for size, pose in zip(sizes, poses, strict=True):
        yaw = np.arctan2(pose[1, 0], pose[0, 0])
        bodies.append(
            f'<body pos="{" ".join(map(str, pose[:3, 3]))}" quat="{np.cos(yaw / 2)} 0 0 {np.sin(yaw / 2)}"><freejoint/>'
            f'<geom type="box" size="{" ".join(str(s / 2) for s in size)}"/></body>'
        )
    return come_to_rest(bodies, seconds)


def settled_bridge(rng):
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
