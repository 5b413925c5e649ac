"""Logs for rerun, read back by rerun's own command."""

import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from on_floor import cube, on_floor

from derender.camera.depth_file import write_depth
from derender.camera.intrinsics import Camera
from derender.cli.export import command
from derender.document import write_document
from derender.errors import DerenderError
from derender.report.export import write_rrd
from derender.results.posterior import Posterior, StructurePosterior

CAMERA = Camera.from_field_of_view(32, 24)
GRAPH = on_floor(cube("red", side=0.1))


def test_image_scene_and_chains_are_logged(tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install 'derender[rerun]'")
    values = np.random.default_rng(0).uniform(0.09, 0.11, (2, 30, 1))
    part = StructurePosterior(GRAPH, ("red.side",), values, np.zeros((2, 30)), np.zeros((2, 30)))
    Posterior((part,), meta={}).save(tmp_path / "posterior.npz")
    write_document(tmp_path / "scene.yaml", GRAPH, CAMERA)
    write_depth(tmp_path / "observation.npz", np.ones((24, 32)), CAMERA, {})
    log = tmp_path / "chains.rrd"
    CliRunner().invoke(command, [str(tmp_path), "-o", str(log)], standalone_mode=False, catch_exceptions=False)
    printed = subprocess.run([sys.executable, "-m", "rerun", "rrd", "print", str(log)], capture_output=True, text=True,
                             check=True)  # fmt: skip
    for place in ("/world/camera/depth", "/world/best/floor", "/world/best/red", "/world/chain_1/red",
                  "/world/chain_2/red", "/numbers/red/side/chain_2", "/numbers/log_density/chain_1"):  # fmt: skip
        assert place in printed.stdout
    assert "/world/chain_1/floor" not in printed.stdout


def test_without_rerun_it_is_told_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(DerenderError, match=r"pip install 'derender\[rerun\]'"):
        write_rrd(tmp_path / "scene.rrd", GRAPH)
