"""Measure the engine beside what people use today, every competitor in the same run: `make bench`.

One thread. Each row is timed in rounds that go over all rows in turn, so that a busy machine slows all alike; printed
are medians. The scene is a plane with boxes on it. "Kept scene" is pyrender at its fastest: nodes moved, depth alone.
"""

import argparse
import os
import sys
import time

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402
from arguments import at_least_one, pixels  # noqa: E402

from derender.camera.intrinsics import Camera  # noqa: E402
from derender.cli import status_of  # noqa: E402
from derender.compilation.cache import njit  # noqa: E402
from derender.errors import DerenderError  # noqa: E402
from derender.render.blur import blur  # noqa: E402
from derender.render.likelihoods import likelihoods  # noqa: E402
from derender.render.raycast.depth import render_depth  # noqa: E402
from derender.render.raycast.engine import load_state, propose_state, settle_state  # noqa: E402
from derender.render.raycast.evaluator import DepthEvaluator  # noqa: E402
from derender.render.raycast.state import CANDIDATE, CURRENT  # noqa: E402
from derender.scene.pose import rotation_x, rotation_z, translation  # noqa: E402
from derender.scene.solids import BOX, MESH, PLANE, Solids  # noqa: E402

SIGMA, BLUR = 0.005, 1.0
SCENE_SPREAD = 0.16  # metres between the boxes of the four-box scene
JITTER = 0.003  # metres, standard deviation of a proposed move in the camera's axes


def table_scene(count: int, spread: float = SCENE_SPREAD, distance: float = 0.8, scale: float = 1.0) -> Solids:
    """Return a plane and `count` boxes of 6-12 cm (times scale) standing on it in a grid, 55 degrees from above."""
    rng = np.random.default_rng(3)
    root = translation(0.0, 0.03, distance) @ rotation_x(np.radians(125.0))
    side = int(np.ceil(np.sqrt(count)))
    poses, sizes = [root], [np.zeros(3)]
    for k in range(count):
        size = rng.uniform(0.06, 0.12, 3) * scale
        x, y = (k % side - (side - 1) / 2) * spread, (k // side - (side - 1) / 2) * spread
        poses.append(root @ translation(x, y, size[2] / 2) @ rotation_z(rng.uniform(0.0, 6.0)))
        sizes.append(size)
    kinds = np.array([PLANE] + [BOX] * count, np.int32)
    return Solids(kinds, np.array(poses), np.array(sizes), np.full(count + 1, -1, np.int32))


def square_camera(width: int, height: int) -> Camera:
    """Return a camera with about 55 degrees across."""
    return Camera(0.95 * width, 0.95 * width, (width - 1) / 2, (height - 1) / 2, width, height)


@njit(cache=True)
def evaluate_in_full(state, poses, sizes, count):
    """Evaluate `count` scenes that differ in every pose; return the last log likelihood."""
    value, moved = 0.0, poses.copy()
    for n in range(count):
        for k in range(1, len(poses)):
            moved[k, 0, 3] = poses[k, 0, 3] + 1e-6 * n
        value = load_state(state, moved, sizes)
    return value


@njit(cache=True)
def evaluate_moves(state, poses, sizes, jitter, count):
    """Propose `count` moves of one solid after the other about its pose in `poses`; accept every other one."""
    value = 0.0
    index, pose, size = np.zeros(1, np.int64), np.empty((1, 4, 4)), np.empty((1, 3))
    for n in range(count):
        k = 1 + n % (len(poses) - 1)
        index[0], pose[0], size[0] = k, poses[k], sizes[k]
        for axis in range(3):
            pose[0, axis, 3] += jitter[n % len(jitter), axis]
        value = propose_state(state, 1, index, pose, size)
        settle_state(state, CANDIDATE if n % 2 else CURRENT)
    return value


class Engine:
    """Rows of our own engine for one scene and camera."""

    def __init__(self, solids: Solids, camera: Camera, observed: np.ndarray, likelihood: str = "gaussian") -> None:
        self.solids = solids
        self.evaluator = DepthEvaluator(camera, observed, likelihood, {"sigma": SIGMA, "blur": BLUR})
        self.evaluator.load(solids)
        self.jitter = np.random.default_rng(0).normal(scale=JITTER, size=(1024, 3))

    def full(self, count: int) -> None:
        evaluate_in_full(self.evaluator.state, self.solids.pose, self.solids.size, count)

    def moves(self, count: int) -> None:
        evaluate_moves(self.evaluator.state, self.solids.pose, self.solids.size, self.jitter, count)

    def full_from_python(self, count: int) -> None:
        for _ in range(count):
            self.evaluator.log_likelihood(self.solids)

    def moves_from_python(self, count: int) -> None:
        for n in range(count):
            k = 1 + n % (len(self.solids.kind) - 1)
            pose = self.solids.pose[k : k + 1].copy()
            pose[0, :3, 3] += self.jitter[n % 1024]
            state = self.evaluator.state
            propose_state(state, 1, np.array([k]), pose, self.solids.size[k : k + 1].copy())
            settle_state(state, CANDIDATE if n % 2 else CURRENT)


class Pyrender:
    """pyrender with a kept scene: nodes are moved, depth alone is drawn, scipy blurs."""

    def __init__(self, solids: Solids, camera: Camera, observed: np.ndarray) -> None:
        from derender.render.renderers.opengl import OpenGLRenderer, _shared_renderer

        self.renderer: OpenGLRenderer = _shared_renderer(os.getpid())
        self.solids, self.camera, self.observed = solids, camera, observed
        self.moved = list(range(len(solids.kind)))

    def start(self) -> None:
        """Bring the shared renderer to this row's scene and image size."""
        self.renderer.draw_depth(self.solids, self.camera)
        self.matrices = [self.renderer.scene.get_pose(node).copy() for node in self.renderer.nodes]

    def draw(self) -> np.ndarray:
        for node, matrix in zip(self.renderer.nodes, self.matrices, strict=True):
            self.renderer.scene.set_pose(node, matrix)
        flags = self.renderer.pyrender.RenderFlags.DEPTH_ONLY
        return self.renderer.offscreen.render(self.renderer.scene, flags)

    def full(self, count: int) -> None:
        self.start()
        for _ in range(count):
            depth = self.draw()
            residual = self.observed - blur(np.where(depth > 0, depth, 10.0), BLUR)
            float(-0.5 * np.sum(np.square(residual)) / SIGMA**2)


class MeshRow:
    """A mesh of 10,000 triangles at 160 x 120: our rasteriser, and Embree with the same rays."""

    def __init__(self, camera: Camera) -> None:
        import trimesh

        ball = trimesh.creation.uv_sphere(radius=0.5, count=[51, 50])
        vertices = ball.vertices * (1.0 + 0.05 * np.sin(9.0 * ball.vertices[:, :1]))
        vertices -= (vertices.max(axis=0) + vertices.min(axis=0)) / 2
        self.triangles = len(ball.faces)
        pose, size = translation(0.0, 0.0, 0.8), np.ptp(vertices, axis=0) * 0.6
        mesh = (np.ascontiguousarray(vertices), np.ascontiguousarray(ball.faces, np.int32))
        self.solids = Solids(
            np.array([PLANE, MESH], np.int32),
            np.array([table_scene(1).pose[0], pose]),
            np.array([np.zeros(3), size]),
            np.array([-1, 0], np.int32),
            (mesh,),
        )
        drawn = vertices * (size / np.ptp(vertices, axis=0)) @ pose[:3, :3].T + pose[:3, 3]
        columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        self.rays = (
            np.stack(
                [(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(columns.shape)], axis=-1
            )
            .reshape(-1, 3)
            .astype(np.float32)
        )
        self.origins = np.zeros_like(self.rays)
        depth, _ = render_depth(self.solids, camera)
        self.engine = Engine(self.solids, camera, depth)
        try:
            from embreex import rtcore_scene
            from embreex.mesh_construction import TriangleMesh
        except ImportError:
            self.embree = None
        else:
            self.embree = rtcore_scene.EmbreeScene()
            TriangleMesh(self.embree, drawn[ball.faces].astype(np.float32))
            self.embree.run(self.origins, self.rays, query="DISTANCE")

    def embree_rays(self, count: int) -> None:
        """Cast the rays against a scene built beforehand (moving the mesh would cost Embree a new tree on top)."""
        assert self.embree is not None, "who asks has seen that Embree is there"
        for _ in range(count):
            self.embree.run(self.origins, self.rays, query="DISTANCE")


def time_rows(rows: dict, rounds: int, seconds: float) -> dict[str, float]:
    """Return the median seconds per call of each row {name: function(count)}, in interleaved rounds."""
    counts = {}
    for name, function in rows.items():
        function(2)
        count = 2
        while True:
            start = time.perf_counter()
            function(count)
            taken = time.perf_counter() - start
            if taken > seconds / 4:
                break
            count *= 2
        counts[name] = max(2, int(count * seconds / taken))
    times = {name: [] for name in rows}
    for _ in range(rounds):
        for name, function in rows.items():
            start = time.perf_counter()
            function(counts[name])
            times[name].append((time.perf_counter() - start) / counts[name])
    return {name: float(np.median(values)) for name, values in times.items()}


def make_rows(width: int, height: int) -> tuple[dict, str | None]:
    """Return {name: function(count)} for one image size, and the name of the baseline where it works."""
    camera, solids = square_camera(width, height), table_scene(4)
    rng = np.random.default_rng(0)
    values = {"sigma": SIGMA, "blur": BLUR}
    clean, _ = render_depth(solids, camera)
    observed = likelihoods["gaussian"].sample(rng, clean, values)
    rows, baseline = {}, None
    try:
        pyrender = Pyrender(solids, camera, observed)
        pyrender.full(2)
        baseline = "pyrender, kept scene, scipy blur"
        rows[baseline] = pyrender.full
    except DerenderError as error:
        print(f"pyrender is left out: {error}")
    engine = Engine(solids, camera, observed)
    rows["full"] = engine.full
    rows["full, called from Python"] = engine.full_from_python
    rows["one of 4 boxes moved"] = Engine(solids, camera, observed).moves
    rows["one of 4 boxes moved, called from Python"] = Engine(solids, camera, observed).moves_from_python
    # small boxes well apart, so that a move redraws about the same pixels in both scenes
    for count in (4, 40):
        scene = table_scene(count, spread=0.11, distance=1.0, scale=0.6)
        depth, _ = render_depth(scene, camera)
        rows[f"one of {count} small boxes moved"] = Engine(scene, camera, np.fmin(depth, 10.0)).moves
    lost = likelihoods["robust"].sample(rng, clean, values)
    rows["full, robust likelihood"] = Engine(solids, camera, lost, "robust").full
    rows["one of 4 boxes moved, robust likelihood"] = Engine(solids, camera, lost, "robust").moves
    shared = likelihoods["correlated"].sample(rng, clean, values)
    rows["full, correlated likelihood"] = Engine(solids, camera, shared, "correlated").full
    rows["one of 4 boxes moved, correlated likelihood"] = Engine(solids, camera, shared, "correlated").moves

    def render(count):
        for _ in range(count):
            render_depth(solids, camera)

    rows["depth and labels alone, float64, called from Python"] = render
    if (width, height) == (160, 120):
        mesh = MeshRow(camera)
        rows[f"mesh of {mesh.triangles} triangles moved"] = mesh.engine.moves
        rows[f"mesh of {mesh.triangles} triangles, full"] = mesh.engine.full
        if mesh.embree is not None:
            rows["Embree, rays alone, tree kept"] = mesh.embree_rays
    return rows, baseline


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--sizes", type=pixels, nargs="+", default=[(64, 64), (160, 120)], help="image sizes, such as 640x480"
    )
    parser.add_argument("--rounds", type=at_least_one, default=15)
    parser.add_argument("--seconds", type=float, default=0.05, help="for each row in each round")
    arguments = parser.parse_args()
    for width, height in arguments.sizes:
        rows, baseline = make_rows(width, height)
        medians = time_rows(rows, arguments.rounds, arguments.seconds)
        print(
            f"\n{width}x{height}, log likelihoods a second, one thread"
            + (", and times the speed of the first row" if baseline else "")
        )
        for name, seconds in medians.items():
            speed = f"{medians[baseline] / seconds:8.1f} x" if baseline else ""
            print(f"  {name:54s} {1.0 / seconds:12,.0f} {speed}")
        for what in ("full", "one of 4 boxes moved"):
            ratio = medians[f"{what}, correlated likelihood"] / medians[f"{what}, robust likelihood"]
            print(f"  {what}: the correlated likelihood takes {ratio:.2f} times as long as the robust one (goal 1.5)")


if __name__ == "__main__":
    sys.exit(status_of(main))
