"""Ctrl-C and its kin on a bare image: the best scene so far is written, with the flags that say so."""

import json
import os
import signal
import threading
import time

import numpy as np
import pytest
from click.testing import CliRunner
from on_floor import cube, on_floor

from derender import workflow
from derender.camera.depth_file import write_depth
from derender.camera.intrinsics import Camera
from derender.cli import _end_as_ctrl_c, main
from derender.cli.infer import command
from derender.cli.options import Duration
from derender.compilation.cache import njit
from derender.detection.search import searches
from derender.render.raycast.depth import render_depth
from derender.report.result_folder import write_results
from derender.structures import graph_posterior

CAMERA = Camera.from_field_of_view(80, 60)


@pytest.fixture
def image(tmp_path):
    graph = on_floor(cube(theta=0.4), elevation=50.0, distance=0.7, lower=0.05)
    depth = render_depth(graph.solids(), CAMERA, background=10.0)[0]
    depth += np.random.default_rng(0).normal(0.0, 0.002, depth.shape)
    write_depth(tmp_path / "image.npz", depth, CAMERA)
    return tmp_path / "image.npz"


@pytest.mark.parametrize("place, name", [(graph_posterior, "weighed_structures"), (searches, "repair")])
def test_the_best_scene_so_far_is_written(image, tmp_path, monkeypatch, place, name):
    """Interrupted among the draws, and in the search."""

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(place, name, interrupted)
    out = tmp_path / "out"
    result = CliRunner().invoke(command, [str(image), "-o", str(out)], catch_exceptions=False, standalone_mode=False)
    assert result.return_value == 130 and "not to be trusted: it was interrupted" in result.stderr
    summary = json.loads((out / "summary.json").read_text())
    assert summary["interrupted"] is True and summary["trusted"] is False
    assert any("interrupted" in doubt for doubt in summary["doubts"])
    sizes = [item["size"] for item in summary["scene"]["objects"] if item["size"]]
    assert len(sizes) == 1 and np.allclose(sizes[0], 0.1, atol=0.01)
    assert (out / "labels.png").exists() and (out / "report.html").exists()


def test_what_was_inferred_is_written_though_someone_interrupts_the_writing(image, tmp_path, monkeypatch):
    def interrupted(*arguments):
        signal.raise_signal(signal.SIGINT)
        return write_results(*arguments)

    monkeypatch.setattr(workflow, "write_results", interrupted)
    out = tmp_path / "out"
    result = CliRunner().invoke(command, [str(image), "--quick", "-o", str(out)], standalone_mode=False)
    assert result.return_value == 130
    assert json.loads((out / "summary.json").read_text())["interrupted"] is False and (out / "report.html").exists()


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="this system has no SIGHUP")
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
@pytest.mark.parametrize(
    "interrupts", [signal.default_int_handler, signal.SIG_IGN], ids=["in front", "in the background"]
)
def test_being_told_to_end_is_as_ctrl_c(name, interrupts):
    number = getattr(signal, name)
    before, keyboard = signal.getsignal(number), signal.signal(signal.SIGINT, interrupts)
    assert threading.current_thread() is threading.main_thread()
    try:
        signal.signal(number, signal.SIG_DFL)
        _end_as_ctrl_c()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
            for _ in range(1000):  # another thread may take the signal, which would not end one long wait
                time.sleep(0.01)
        child = os.fork()
        if child == 0:
            os.kill(os.getpid(), number)
            os._exit(3)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -number  # what it forks dies of it
        signal.signal(number, signal.SIG_IGN)  # as under nohup
        _end_as_ctrl_c()
        assert signal.getsignal(number) is signal.SIG_IGN
    finally:
        signal.signal(number, before)
        signal.signal(signal.SIGINT, keyboard)


def test_ctrl_c_waits_for_a_kernel_that_is_compiled():
    """In one of LLVM's callbacks it would be lost: here it comes while numba looks at the types."""

    @njit
    def half(x):
        return 0.5 * x

    def interrupted(kinds):
        signal.raise_signal(signal.SIGINT)
        return compiled(kinds)

    compiled = half.dispatcher.compile
    half.dispatcher.compile = interrupted
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # it is ignored where tests run in the background
    try:
        with pytest.raises(KeyboardInterrupt):
            half(1.0)
    finally:
        signal.signal(signal.SIGINT, before)
    assert half.dispatcher.overloads  # it was compiled all the same


def test_nothing_of_ctrl_c_is_left_when_a_command_leaves():
    """What comes after all is done would be a traceback."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        with pytest.raises(SystemExit):
            main(["types", "box"])
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize("text, seconds", [("30s", 30.0), ("30", 30.0), ("2min", 120.0), ("1.5h", 5400.0)])
def test_times_have_units(text, seconds):
    assert Duration().convert(text, None, None) == seconds


@pytest.mark.parametrize("text", ["", "0s", "-3s", "3 days", "nan", "s"])
def test_no_time_is_refused(text):
    from click import BadParameter

    with pytest.raises(BadParameter):
        Duration().convert(text, None, None)
