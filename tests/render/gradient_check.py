"""The derivative of the antialiased image against differences of images made in other ways: scenes, motions, errors."""

import numpy as np
from smooth_image import antialiased_depth, derivative_image

from derender.camera.intrinsics import Camera
from derender.render.blur import blur
from derender.render.raycast.depth import render_depth
from derender.render.raycast.normal_equations import MOTION
from derender.scene.pose import rotation_x, rotation_z, translation, twist_exp
from derender.scene.solids import BOX, PLANE, SPHERE, Solids

CAMERA = Camera.from_field_of_view(64, 64)
BACKGROUND, BLUR = 10.0, 1.0
RAYS, PLACES = 16, 64  # a pixel each way, and places of their grid
RAYS_STEP = 0.014  # pixels
LINES_STEP = 0.01  # pixels: edges nearly along the lines are then met by some line in spite of their number
STEPS = (1e-5, 1e-4, 5e-4, 2e-3)  # pixels


def random_scene(seed: int, kind: int, stacked: bool = False) -> Solids:
    """Return a plane and four solids, scattered or in a stack; the camera looks down, so no horizon is seen.

    No two of them enter each other.
    """
    rng = np.random.default_rng(seed)
    root = translation(0, 0.05, 0.9) @ rotation_x(np.pi / 2 + rng.uniform(0.7, 1.1))
    poses, sizes, places = [root], [np.zeros(3)], []
    for i in range(4):
        size = rng.uniform(0.06, 0.14, 3)
        size[1] = size[0] if kind != BOX else size[1]
        size[2] = size[0] if kind == SPHERE else size[2]
        on_top = stacked and i > 0
        base, lift = (poses[-1], sizes[-1][2] / 2) if on_top else (root, 0.0)
        x, y = rng.uniform(-0.3, 0.3, 2) * sizes[-1][:2] if on_top else rng.uniform(-0.2, 0.2, 2)
        reach = np.linalg.norm(size[:2]) / 2 if kind == BOX else size[0] / 2
        while not stacked and any(np.hypot(x - a, y - b) < reach + far for a, b, far in places):
            x, y = rng.uniform(-0.2, 0.2, 2)
        places.append((x, y, reach))
        poses.append(base @ translation(x, y, lift + size[2] / 2) @ rotation_z(rng.uniform(0, 7)))
        sizes.append(size)
    kinds = np.array([PLANE, *[kind] * 4], np.int32)
    return Solids(kinds, np.array(poses), np.array(sizes), np.full(5, -1, np.int32))


def random_motion(solids: Solids, k: int, seed: int) -> np.ndarray:
    """Return a motion of solid k with turns about its own centre and, keeping it what it is, growth."""
    rng = np.random.default_rng([seed, 7])
    motion = rng.normal(size=MOTION)
    motion[3:6] /= 0.08  # as much movement at a surface from turning as from shifting
    motion[:3] -= np.cross(motion[3:6], solids.pose[k, :3, 3])
    if solids.kind[k] != BOX:
        motion[7] = motion[6]
    if solids.kind[k] == SPHERE:
        motion[8] = motion[6]
    return motion


def moved(solids: Solids, k: int, motion: np.ndarray, step: float) -> Solids:
    """Return the solids with solid k moved by `step` units of a motion."""
    pose, size = solids.pose.copy(), solids.size.copy()
    pose[k] = twist_exp(step * motion[:3], step * motion[3:6]) @ pose[k]
    size[k] += step * motion[6:]
    return solids._replace(pose=pose, size=size)


def central(image, step: float, orders: int = 1) -> np.ndarray:
    """Return central differences of image(step); with more orders, extrapolated from steps 1, 2, 4 ... times as long.

    Terms of the first `orders - 1` powers of the step vanish, odd ones too: a scene in contact has them.
    """
    found = [(image(step * 2**n) - image(-step * 2**n)) / (2 * step * 2**n) for n in range(orders)]
    for order in range(1, orders):
        found = [(2**order * a - b) / (2**order - 1) for a, b in zip(found[:-1], found[1:], strict=True)]
    return found[0]


def cast(solids: Solids, rays: int, place=(0.0, 0.0)) -> np.ndarray:
    """Return the blurred image by rays x rays a pixel, their grid shifted by a share of the rays' distance."""
    x, y = np.asarray(place) / rays
    camera = Camera(CAMERA.fx, CAMERA.fy, CAMERA.cx - x, CAMERA.cy - y, CAMERA.width, CAMERA.height)
    return blur(render_depth(solids, camera, antialias=rays, background=BACKGROUND)[0], BLUR)


def cast_differences(scene, step: float, places: int = PLACES) -> tuple[np.ndarray, float]:
    """Return central differences of images of RAYS x RAYS rays, their mean over places of the grid, and its error.

    scene(h) : Solids at a place h of some motion. The places lie in as many rows and columns, one in each, so that
    together an edge along the rays is told to 1 / (RAYS * places) pixels. The error, a share of the mean, is half the
    difference between every other place and the rest.
    """
    number, halves = np.arange(places), [np.zeros((CAMERA.height, CAMERA.width)) for _ in range(2)]
    shifts = (np.stack([number, number * (round(places * 0.2964) | 1) % places], axis=1) + 0.5) / places - 0.5
    for n, shift in enumerate(shifts):
        halves[n % 2] += central(lambda h, shift=shift: cast(scene(h), RAYS, shift), step) * 2.0 / places
    mean = 0.5 * (halves[0] + halves[1])
    return mean, 0.5 * share(halves[0], halves[1])


def share(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.linalg.norm(first - second) / np.linalg.norm(second))


def own_error(kind: int, seed: int, edges: bool = True) -> float:
    """Return how far the derivative is from differences of the antialiased image itself, the best of four steps."""
    solids = random_scene(seed, kind, stacked=seed % 2 == 1 and kind == BOX)
    k = 1 + seed % 4
    motion = random_motion(solids, k, seed)
    pixel = solids.pose[k, 2, 3] / CAMERA.fx
    exact = derivative_image(solids, CAMERA, k, motion, BACKGROUND, BLUR, edges)

    def image(step):
        return antialiased_depth(moved(solids, k, motion, step), CAMERA, BACKGROUND, BLUR)

    return min(share(exact, central(image, step * pixel, 2)) for step in STEPS)
