"""Films: what does not move is drawn once; those that ffmpeg cannot write are one line, and leave nothing."""

import shutil

import numpy as np
import pytest
from on_floor import cube, on_floor
from PIL import Image

from derender.camera.intrinsics import Camera
from derender.errors import DerenderError
from derender.physics.verdict import Trajectory
from derender.report import animation
from derender.report.animation import frames, write_animation


def test_what_does_not_move_is_drawn_once(monkeypatch):
    drawn = []
    monkeypatch.setattr(animation, "draw_preview", lambda *_: drawn.append(0) or np.zeros((2, 2, 3), np.uint8))
    graph = on_floor(cube("red", side=0.1))
    solids, times = graph.solids(), np.arange(0.0, 1.001, 0.05)
    poses = np.repeat(solids.pose[None, [graph.solid_names.index("red")]], len(times), axis=0)
    poses[5:8, 0, 0, 3] += [0.01, 0.02, 0.03]  # it slides for three pictures, and then lies
    poses[8:, 0, 0, 3] += 0.03
    trajectory = Trajectory(("red",), np.full((1, 3), 0.1), times, poses)
    pictures = frames(solids, graph.solid_names, trajectory, Camera.from_field_of_view(320, 240))
    assert len(pictures) == 21 and len(drawn) == 4


def test_an_ffmpeg_that_fails_is_one_line(tmp_path, monkeypatch):
    broken = shutil.which("false")
    if broken is None:
        pytest.skip("there is no program that fails here")
    monkeypatch.setattr("shutil.which", lambda name: broken)
    with pytest.raises(DerenderError, match="ffmpeg failed: exit status 1"):
        write_animation(tmp_path / "x.mp4", [np.zeros((4, 4, 3), np.uint8)] * 2)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
@pytest.mark.parametrize("count", [1, 3])
def test_a_film_of_one_picture_is_one(tmp_path, suffix, count):
    """simulate --animate with a --duration of less than a picture's ended in a traceback."""
    write_animation(tmp_path / f"film{suffix}", [np.full((8, 8, 3), 60 * k, np.uint8) for k in range(count)])
    with Image.open(tmp_path / f"film{suffix}") as film:
        assert film.n_frames == count and film.size == (8, 8)
