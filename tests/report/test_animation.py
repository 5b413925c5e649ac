"""Films that ffmpeg cannot write are one line, and leave nothing."""

import shutil

import numpy as np
import pytest

from derender.errors import DerenderError
from derender.report.animation import write_animation


def test_an_ffmpeg_that_fails_is_one_line(tmp_path, monkeypatch):
    broken = shutil.which("false")
    if broken is None:
        pytest.skip("there is no program that fails here")
    monkeypatch.setattr("shutil.which", lambda name: broken)
    with pytest.raises(DerenderError, match="ffmpeg failed: exit status 1"):
        write_animation(tmp_path / "x.mp4", [np.zeros((4, 4, 3), np.uint8)] * 2)
    assert not list(tmp_path.iterdir())
