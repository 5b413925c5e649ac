"""What a second process compiles ahead: that it still runs."""

import os
import subprocess
import sys

import pytest

from derender.structures.precompile import PARTS


@pytest.mark.parametrize("part", PARTS)
def test_what_is_compiled_ahead_still_runs(part):
    done = subprocess.run([sys.executable, "-m", "derender.structures.precompile", part], stdin=_open_end(),
                          capture_output=True, text=True, check=False)  # fmt: skip
    assert done.returncode == 0, done.stderr


def _open_end() -> int:
    """Return the reading end of a pipe that stays open: the process leaves when its starter has gone."""
    reading, _writing = os.pipe()
    return reading
