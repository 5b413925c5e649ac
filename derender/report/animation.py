"""A trajectory as a moving picture."""

import shutil
import subprocess
from pathlib import Path

import numpy as np

from derender.atomic import atomic_path, write_bytes
from derender.camera.intrinsics import Camera
from derender.errors import DerenderError
from derender.physics.verdict import Trajectory
from derender.render.raycast.depth import render_depth
from derender.render.renderers.preview import draw_preview
from derender.report.export import glb_bytes
from derender.report.pictures import colours_of
from derender.scene.graph import SceneGraph
from derender.scene.solids import PLANE, Solids

FRAMES_PER_SECOND = 20
WIDTH = 320
STILL = 2e-4  # metres, and sines of turns: a tenth of a pixel or less; a picture takes a fifth of a second to draw


def frames(solids: Solids, names: tuple[str, ...], trajectory: Trajectory, camera: Camera) -> list[np.ndarray]:
    """Return shaded pictures of a scene as it moves, (height, width, 3) uint8 each, at 20 a second.

    solids, names : the scene at the start and the names of its solids; those that the trajectory does not name stay.
    """
    eye = camera.downscaled(camera.width // WIDTH or 1 / round(WIDTH / camera.width))
    moving = [k for k, name in enumerate(trajectory.names) if name in names]
    index = [names.index(trajectory.names[k]) for k in moving]
    duration = float(trajectory.times[-1])
    wanted = np.arange(0, duration + 0.5 / FRAMES_PER_SECOND, 1 / FRAMES_PER_SECOND)
    colours = colours_of(solids, names)
    pictures: list[np.ndarray] = []
    drawn = np.full_like(solids.pose, np.inf)  # poses of the last picture
    for step in np.searchsorted(trajectory.times, wanted).clip(max=len(trajectory.times) - 1):
        pose = solids.pose.copy()
        pose[index] = trajectory.poses[step, moving]
        if np.abs(pose - drawn).max() < STILL:
            pictures.append(pictures[-1])
            continue
        pictures.append(draw_preview(render_depth, solids._replace(pose=pose), eye, colours))
        drawn = pose
    return pictures


def stands_still(trajectory: Trajectory) -> bool:
    """Return whether nothing moves so far that a picture shows it: a GIF of that is one picture."""
    return bool(np.ptp(trajectory.poses, axis=0).max(initial=0.0) < STILL)


def animate(path: str | Path, graph: SceneGraph, trajectory: Trajectory, camera: Camera | None) -> None:
    """Write how a scene moves, by the suffix: a picture seen by its camera (.gif, .webp, .mp4), or .glb in 3-D.

    Raises DerenderError : .mp4 where there is no ffmpeg, or one that fails.
    """
    path = Path(path)
    if path.suffix.lower() == ".glb":
        write_bytes(path, glb_bytes(graph, trajectory))
        return
    assert camera is not None
    names, solids = graph.solid_names, graph.solids()
    shown = [k for k, name in enumerate(names) if name in trajectory.names or solids.kind[k] == PLANE]
    kept = Solids(solids.kind[shown], solids.pose[shown], solids.size[shown], solids.mesh[shown], solids.meshes)
    write_animation(path, frames(kept, tuple(names[k] for k in shown), trajectory, camera))


def write_animation(path: str | Path, pictures: list[np.ndarray]) -> None:
    """Write a GIF, or WebP or MP4 by the suffix; the first two repeat after a pause at their end."""
    import imageio.v3 as imageio

    if Path(path).suffix.lower() == ".mp4":
        _write_film(Path(path), np.stack(pictures))
        return
    pause = [1000 // FRAMES_PER_SECOND] * (len(pictures) - 1) + [1200]
    with atomic_path(path) as temporary:
        shown = pause if len(pause) > 1 else pause[0]  # of one picture Pillow takes no list
        imageio.imwrite(temporary, np.stack(pictures), plugin="pillow", duration=shown, loop=0)


def film_writer(path: str | Path) -> str:
    """Return the program that writes films; DerenderError where there is none."""
    program = shutil.which("ffmpeg")
    if program is None:
        raise DerenderError("films need ffmpeg, which is not here", path, "install ffmpeg, or write .gif or .webp")
    return program


def _write_film(path: Path, pictures: np.ndarray) -> None:
    """Write pictures (T, height, width, 3) uint8 as H.264, by ffmpeg."""
    program = film_writer(path)
    pictures = pictures[:, : pictures.shape[1] // 2 * 2, : pictures.shape[2] // 2 * 2]
    size = f"{pictures.shape[2]}x{pictures.shape[1]}"
    given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", str(FRAMES_PER_SECOND), "-i", "-"]
    with atomic_path(path) as temporary:
        wanted = ["-pix_fmt", "yuv420p", "-f", "mp4", str(temporary)]
        command = [program, "-v", "error", "-y", *given, *wanted]
        run = subprocess.run(command, input=pictures.tobytes(), check=False, capture_output=True)
        if run.returncode:
            said = run.stderr.decode(errors="replace").strip().splitlines() or [f"exit status {run.returncode}"]
            remedy = "install an ffmpeg with H.264, or write .gif or .webp"
            raise DerenderError(f"ffmpeg failed: {said[-1]}", path, remedy)
