"""What a second process compiles ahead: that it still runs."""

import os
import subprocess
import sys


def test_what_is_compiled_ahead_still_runs():
    done = subprocess.run([sys.executable, "-m", "derender.structures.precompile"], stdin=_open_end(),
                          capture_output=True, text=True, check=False)  # fmt: skip
    assert done.returncode == 0, done.stderr


def _open_end() -> int:
    """Return the reading end of a pipe that stays open: the process leaves when its starter has gone."""
    reading, _writing = os.pipe()
    return reading
