"""What a second look tells of made towers: from the side, from where `derender look` says, and from anywhere.

    python scripts/evaluate.py views -n 20

A size counts as hidden where one image leaves a 90 % interval of more than HIDDEN. Told is by how many times a second
image narrows these (1 mm of noise of its own in each image); in how many towers it halves all of them; in how many of
all sizes the 90 % intervals hold the truth; and how many random views are needed where one chosen one has halved all.
"""

import time

import numpy as np

from derender.physics.next_view import next_views
from derender.report.scene_json import size_intervals
from derender.sampling.chains import SCENES, stream
from derender.scene.pose import inverse
from derender.structures.infer import infer_structure
from derender.structures.options import Frame, Options
from worlds.made_scenes import SETS, make_scene, render_floor_scene

HIDDEN = 0.004  # metres of a 90 % interval
NOISE = 0.001  # metres
MOST_RANDOM = 3  # random views that are tried, one after the other
SIDE = np.pi / 2  # radians about the scene


def image_from(rng, scene, into):
    """Return the depth image (H, W) of a made scene from another place; into (4, 4): the first camera's axes to it."""
    poses, sizes = (np.array([item[key] for item in scene["objects"]]) for key in ("pose", "size"))
    kinds = [item["type"] for item in scene["objects"]]
    depth, _ = render_floor_scene(kinds, into @ poses, sizes, into @ scene["floor"], scene["camera"])
    return depth + NOISE * rng.standard_normal(depth.shape)


def widths(posterior, scene):
    """Return (N, 3) widths of the 90 % intervals of the true objects' extents along their own axes, and (N, 3) whether
    they hold the truth; NaN and False where an object was not found."""
    graph, told = posterior.best_graph(), size_intervals(posterior)
    poses = graph.poses()
    found = [name for name in told if told[name] is not None]
    wide, holds = np.full((len(scene["objects"]), 3), np.nan), np.zeros((len(scene["objects"]), 3), bool)
    for k, item in enumerate(scene["objects"]):
        name = min(found, key=lambda name: np.linalg.norm(poses[name][:3, 3] - item["pose"][:3, 3]), default=None)
        if name is None or np.linalg.norm(poses[name][:3, 3] - item["pose"][:3, 3]) > 0.5 * min(item["size"]):
            continue
        axes = np.abs(item["pose"][:3, :3].T @ poses[name][:3, :3]).argmax(axis=1)
        low, high = np.array(told[name])[axes].T
        wide[k], holds[k] = high - low, (low <= item["size"]) & (item["size"] <= high)
    return wide, holds


class Tower:
    """A made tower, what one image tells of it, and what further ones add."""

    def __init__(self, number):
        self.number, self.scene = number, make_scene(stream(number, SCENES, SETS.index("tower")), "tower")
        self.camera, self.rng = self.scene["camera"], np.random.default_rng([number, 2026])
        self.alone = self.infer([])
        self.before, _ = widths(self.alone, self.scene)
        self.hidden = self.before > HIDDEN

    def infer(self, views):
        """Return the posterior given the first image and those of NextViews."""
        intos = [inverse(view.pose) for view in views]
        images = [image_from(self.rng, self.scene, into) for into in intos]
        frames = [Frame(image, self.camera, into, "view") for image, into in zip(images, intos, strict=True)]
        options = Options(frames=tuple(frames))
        return infer_structure(self.scene["depth"], self.camera, options, np.random.default_rng(self.number))

    def ratios(self, views):
        """Return by how much the hidden intervals are as wide with further views, (n,), and which sizes (N, 3) hold."""
        after, holds = widths(self.infer(views), self.scene)
        return np.where(np.isfinite(after), after, np.inf)[self.hidden] / self.before[self.hidden], holds


def evaluate_views(count, first=0, verbose=False):
    """Print the table of `count` made towers."""
    rows = {kind: [] for kind in ("side", "chosen", "random")}
    start, without = time.perf_counter(), 0
    for k in range(first, first + count):
        tower = Tower(k)
        if not tower.hidden.any():
            without += 1
            continue
        likelihood = tower.alone.best_part.extras["likelihood"]
        views = next_views(tower.alone, tower.camera, likelihood, np.random.default_rng(k))
        level = min(views, key=lambda view: view.moved).elevation
        side = min(views, key=lambda view: abs(view.turn - SIDE) + abs(view.elevation - level))
        drawn = [views[n] for n in tower.rng.integers(len(views), size=MOST_RANDOM)]
        for kind, chosen in (("side", [side]), ("chosen", [views[0]]), ("random", drawn)):
            ratio, holds = tower.ratios(chosen[:1])
            median, halved, needed = np.median(ratio), bool((ratio <= 0.5).all()), 1
            while not np.all(ratio <= 0.5) and needed < len(chosen):
                needed += 1
                ratio, _ = tower.ratios(chosen[:needed])
            rows[kind].append((median, halved, holds.mean(), needed + (not np.all(ratio <= 0.5))))
            if verbose:
                print(k, kind, needed, np.round(ratio, 3), round(holds.mean(), 3), flush=True)
    done = count - without
    print(f"{done} towers with hidden sizes, {without} without; {time.perf_counter() - start:.0f} s")
    print("| second view | hidden intervals, times as wide | all halved | 90 % intervals hold | views needed |")
    print("|---" * 5 + "|")
    for kind, found in rows.items():
        if found:
            ratio, halved, holds, needed = np.array(found, float).T
            print(
                f"| {kind} | {np.median(ratio):.3f} | {halved.mean():.2f} | {holds.mean():.2f} | {needed.mean():.2f} |"
            )
