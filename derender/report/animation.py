"""A trajectory as a moving picture."""

from pathlib import Path

import numpy as np

from derender.camera.intrinsics import Camera
from derender.physics.simulate import Trajectory
from derender.report.pictures import colours_of
from derender.scene.solids import Solids

FRAMES_PER_SECOND = 20
WIDTH = 320


def frames(solids: Solids, names: tuple[str, ...], trajectory: Trajectory, camera: Camera) -> list[np.ndarray]:
    """Return shaded pictures of a scene as it moves, (height, width, 3) uint8 each, at 20 a second.

    Parameters
    ----------
    solids, names : the scene at the start and the names of its solids; those that the trajectory does not name stay.
    """
    from derender.render.raycast.depth import render_depth
    from derender.render.renderers.preview import draw_preview, enlarged

    eye = enlarged(camera, max(1, round(WIDTH / camera.width))) if camera.width < WIDTH else _reduced(camera)
    index = [names.index(name) for name in trajectory.names]
    duration = float(trajectory.times[-1])
    wanted = np.arange(0, duration + 0.5 / FRAMES_PER_SECOND, 1 / FRAMES_PER_SECOND)
    colours = colours_of(solids, names)
    pictures = []
    for step in np.searchsorted(trajectory.times, wanted).clip(max=len(trajectory.times) - 1):
        pose = solids.pose.copy()
        pose[index] = trajectory.poses[step]
        pictures.append(draw_preview(render_depth, solids._replace(pose=pose), eye, colours))
    return pictures


def write_animation(path: str | Path, pictures: list[np.ndarray]) -> None:
    """Write a GIF, or WebP by the suffix, that repeats after a pause at its end."""
    import imageio.v3 as imageio

    from derender.atomic import atomic_path

    pause = [1000 // FRAMES_PER_SECOND] * (len(pictures) - 1) + [1200]
    with atomic_path(path) as temporary:
        imageio.imwrite(temporary, np.stack(pictures), plugin="pillow", duration=pause, loop=0)


def _reduced(camera: Camera) -> Camera:
    factor = max(1, camera.width // WIDTH)
    return camera.downscaled(factor) if factor > 1 else camera
