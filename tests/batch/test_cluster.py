"""Frames on a real Dask cluster on this machine, one of whose two workers is killed midway."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from derender.batch.frames import Order, is_done
from derender.batch.run import PATIENCE, Cluster, write_files
from derender.errors import DerenderError

FRAMES = 12


def test_files_come_as_one_set_and_the_thumbnail_last(tmp_path):
    write_files(tmp_path, {"thumbnail.png": b"t", "summary.json": b"s", "labels.png": b"l"})
    assert is_done(tmp_path) and (tmp_path / "labels.png").read_bytes() == b"l"


def files(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def derender(folder, *arguments):
    command = [sys.executable, "-m", "derender", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=500, check=False)


@pytest.mark.slow
def test_a_worker_that_is_killed_loses_no_frame(tmp_path):
    """No frame is lost, none told twice, and every byte is that of a run on this machine."""
    pytest.importorskip("distributed")
    assert derender(tmp_path, "sample", "-n", str(FRAMES), "--seed", "3", "-o", "frames").returncode == 0
    np.save(tmp_path / "frames" / "bad.npy", np.zeros((4, 4)))
    here = derender(tmp_path, "infer", "frames", "--draws", "20", "-o", "here", "-j", "2")
    assert here.returncode == 1, here.stderr
    place = tmp_path / "scheduler.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": tmp_path}
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--dashboard-address", "127.0.0.1:0",
            "--host", "127.0.0.1", "--scheduler-file", str(place)]  # fmt: skip
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(place), "--nthreads", "1",
              "--no-nanny", "--no-dashboard"]  # fmt: skip
    started = [subprocess.Popen(dask, **quiet)]
    try:
        deadline = time.monotonic() + 60
        while not place.exists() and time.monotonic() < deadline:
            time.sleep(0.2)
        started += [subprocess.Popen(worker, **quiet) for _ in range(2)]
        command = [sys.executable, "-m", "derender", "infer", "frames", "--draws", "20", "-o", "there", "--scheduler"]
        run = subprocess.Popen([*command, str(place)], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                               text=True)  # fmt: skip
        started.append(run)
        lines = tmp_path / "there" / "results.jsonl"
        deadline = time.monotonic() + 300
        while time.monotonic() < deadline and (not lines.exists() or len(told(lines)) < 3):
            time.sleep(0.05)
        os.kill(started[1].pid, signal.SIGKILL)
        assert run.poll() is None  # it was midway
        out, err = run.communicate(timeout=400)
    finally:
        for process in started[::-1]:
            process.kill()
            process.wait()
    assert run.returncode == 1 and "Traceback" not in err, err
    assert out == here.stdout
    assert files(tmp_path / "there") == files(tmp_path / "here")
    frames = [json.loads(line)["frame"] for line in lines.read_text().splitlines()]
    assert len(set(frames)) == FRAMES + 1


def told(lines):
    """Return the frames that have lines."""
    return {json.loads(line)["frame"] for line in lines.read_text().splitlines(keepends=True) if line.endswith("\n")}


@pytest.fixture
def stranger():
    """A server of another kind: it greets as a web server might."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def greet():
            with server.accept()[0] as connection:
                connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

        threading.Thread(target=greet, daemon=True).start()
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"


def test_a_scheduler_that_does_not_answer_is_told_at_once(tmp_path, stranger):
    pytest.importorskip("distributed")
    (tmp_path / "list.json").write_text("[1]")
    nobody, no_port = "no scheduler answers.*give tcp://HOST:PORT", "no such port"
    cases = {"tcp://127.0.0.1:9": nobody, "tcp://127.0.0.1": no_port, "tcp://127.0.0.1:x": no_port,
             stranger: "no Dask scheduler", str(tmp_path / "list.json"): "no scheduler file"}  # fmt: skip
    for scheduler, told in cases.items():
        started = time.monotonic()
        with pytest.raises(DerenderError, match=told):
            Cluster(scheduler, Order(), str(tmp_path))
        assert time.monotonic() - started < PATIENCE
