"""derender infer over many frames, as a person runs it."""

import json
import os
import signal
import subprocess
import sys
import time
from multiprocessing import active_children
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

import derender
from derender.batch.frames import Done, Frame, Order, failure, infer_frame, is_done
from derender.batch.run import Processes, infer_frames
from derender.cli import group
from derender.compilation.threads import LIBRARIES, THREADS_VARIABLE
from derender.errors import DerenderError
from derender.structures.options import Options


def infer(*arguments, folder, **more):
    command = [sys.executable, "-m", "derender", "infer", *map(str, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300, check=False, **more)


def files(folder):
    """Return the bytes of all files below a folder, by name."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Return a folder with frames: three floors, one of them in a folder of its own, and a file that is no image."""
    folder = tmp_path_factory.mktemp("many")
    (folder / "frames" / "more").mkdir(parents=True)
    for number, name in enumerate(("a", "b", "more/c")):
        np.save(folder / "frames" / f"{name}.npy", np.full((48, 64), 0.9 + 0.01 * number, np.float32))
    (folder / "frames" / "bad.npz").write_bytes(b"no archive")
    return folder


def test_a_bad_frame_does_not_stop_the_others_and_jobs_change_no_byte(frames):
    one = infer("frames", "-o", "one", "--quick", "-j", 1, folder=frames)
    assert one.returncode == 1 and "Traceback" not in one.stderr, one.stderr
    assert "derender: bad: frames/bad.npz: not a depth image" in one.stderr
    assert one.stderr.count("--camera is not given") == 1  # of all frames alike
    assert one.stdout.splitlines() == ["a\ttrusted", "b\ttrusted", "bad\tfailed", "more/c\ttrusted"]
    two = infer("frames", "-o", "two", "--quick", "-j", 2, folder=frames)
    assert two.returncode == 1 and two.stdout == one.stdout
    first, second = files(frames / "one"), files(frames / "two")
    assert first == second
    wanted = {f"{name}/{file}" for name in ("a", "b", "more/c") for file in ("summary.json", "posterior.npz")}
    assert wanted | {"index.html", "results.csv", "results.jsonl"} <= set(first)
    assert "a/report.html" not in first
    assert json.loads(first["more/c/summary.json"])["command"] == "derender infer frames/more/c.npy --quick"
    (frames / "one" / "b" / "summary.json").unlink()  # as a killed run leaves it
    kept = (frames / "one" / "a" / "posterior.npz").stat().st_mtime_ns
    again = infer("frames", "-o", "one", "--quick", folder=frames)
    assert again.stdout.splitlines() == ["b\ttrusted", "bad\tfailed"] and "2 were done before" in again.stderr
    assert (frames / "one" / "a" / "posterior.npz").stat().st_mtime_ns == kept and files(frames / "one") == second
    other = infer("frames", "-o", "one", folder=frames)
    assert other.returncode == 1 and "were made with other options (--quick)" in other.stderr
    shown = CliRunner().invoke(group, ["show", str(frames / "one")])
    assert str(shown.exception).endswith(f"one: this folder holds 3 results; name one, such as {frames / 'one' / 'a'}")


def test_results_of_other_images_and_cameras_are_made_again(tmp_path):
    """They were told as done: whoever had mended camera.json got the sizes of the wrong one once more."""
    for number, name in enumerate("abc"):
        np.save(tmp_path / f"{name}.npy", np.full((48, 64), 0.9 + 0.01 * number, np.float32))
    camera = {"fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5}
    (tmp_path / "b_camera.json").write_text(json.dumps(camera))
    infer("a.npy", "b.npy", "c.npy", "-o", "out", "--quick", folder=tmp_path)
    assert "3 were done before" in infer("a.npy", "b.npy", "c.npy", "-o", "out", "--quick", folder=tmp_path).stderr
    np.save(tmp_path / "a.npy", np.full((48, 64), 1.1, np.float32))
    (tmp_path / "b_camera.json").write_text(json.dumps(camera | {"fx": 70, "fy": 70}))
    again = infer("a.npy", "b.npy", "c.npy", "-o", "out", "--quick", folder=tmp_path)
    assert again.stdout.splitlines() == ["a\ttrusted", "b\ttrusted"], again.stderr
    assert "2 of the results are broken, or of other images or cameras: they are made again" in again.stderr


def test_a_frame_whose_folder_cannot_be_made_fails_alone(frames, tmp_path, monkeypatch):
    place = Frame("a", str(frames / "frames" / "a.npy"))
    (tmp_path / "a").write_text("in the way")
    assert "the folder cannot be" in infer_frame(place, Order(), str(tmp_path)).error
    monkeypatch.setattr("derender.workflow.ask", lambda *_: 1 / 0)
    assert infer_frame(place, Order(), str(tmp_path)).error == "ZeroDivisionError: division by zero"


@pytest.mark.slow
def test_frames_that_come_are_done_until_ctrl_c(frames, tmp_path):
    command = [
        sys.executable,
        "-m",
        "derender",
        "infer",
        str(tmp_path),
        "--watch",
        "--quick",
        "-o",
        str(tmp_path / "out"),
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        (tmp_path / "late.npy").write_bytes((frames / "frames" / "a.npy").read_bytes())
        deadline = time.monotonic() + 120
        while not (tmp_path / "out" / "late" / "thumbnail.png").exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0 and out == "late\ttrusted\n", err
    assert "late,done" in (tmp_path / "out" / "results.csv").read_text()


@pytest.mark.slow
def test_a_signal_to_the_whole_group_finishes_what_is_in_work_and_fails_no_frame(frames, tmp_path):
    for name in "abcdefgh":
        (tmp_path / f"{name}.npy").write_bytes((frames / "frames" / "a.npy").read_bytes())
    command = [sys.executable, "-m", "derender", "infer", str(tmp_path), "-j", "2", "-o", str(tmp_path / "out")]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        first = process.stdout.readline()
        os.killpg(process.pid, signal.SIGTERM)  # as a Slurm job that ends is told
        out, err = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == 130 and "the same command does the frames that are missing" in err, err
    assert first == "a\ttrusted\n" and "failed" not in out + err
    rows = [json.loads(line) for line in (tmp_path / "out" / "results.jsonl").read_text().splitlines()]
    assert 1 <= len(rows) < 8 and {row["status"] for row in rows} == {"done"}
    again = infer(str(tmp_path), "-o", tmp_path / "out", folder=tmp_path)
    assert again.returncode == 0 and again.stdout.count("trusted") == 8 - len(rows)


def test_a_frame_that_dies_with_a_stopped_run_is_told_by_nobody(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((4, 4)))

    class Stopped:
        """A crew whose process dies of the signal that stops the run."""

        size, busy = 1, 0

        def submit(self, frame):
            self.busy = 1
            self.frame = frame

        def finished(self, timeout):
            signal.raise_signal(signal.SIGINT)
            self.busy = 0
            return [failure(self.frame, "died")._replace(died=True)]

        def close(self):
            pass

    tally = infer_frames([str(tmp_path / "a.npy")], tmp_path / "out", Order(), lambda order, output: Stopped())
    assert tally.interrupted and tally.failed == 0
    assert (tmp_path / "out" / "results.jsonl").read_text() == ""


@pytest.mark.parametrize("option", [("--known", "no.yaml"), ("--scene", "no.yaml"), ("--shapes", "ball")])
def test_a_fault_in_what_is_asked_of_all_is_told_once_and_leaves_nothing(frames, option):
    done = CliRunner().invoke(group, ["infer", str(frames / "frames"), "-o", str(frames / "none"), *option])
    assert isinstance(done.exception, DerenderError) and option[1] in str(done.exception)
    assert not (frames / "none").exists()


def test_tables_that_take_long_are_written_seldom_and_nobody_waits_for_them(tmp_path, monkeypatch):
    for k in range(60):
        np.save(tmp_path / f"{k}.npy", np.ones((4, 4)))
    clock, told = SimpleNamespace(now=0.0), []

    class Crew:
        """One who takes a second for a frame."""

        size, busy = 1, 0

        def submit(self, frame):
            self.busy, self.frame = 1, frame
            told.append("begun")

        def finished(self, timeout):
            clock.now += 1.0
            self.busy = 0
            return [failure(self.frame, "no floor")]

        def close(self):
            pass

    def write_tables(ledger, ended=False):
        clock.now += 0.5
        told.append("written")

    monkeypatch.setattr("derender.batch.run.time.monotonic", lambda: clock.now)
    monkeypatch.setattr("derender.batch.run.Ledger.write_tables", write_tables)
    monkeypatch.setattr("derender.batch.run.Ledger.record", lambda ledger, done: told.append("recorded"))
    infer_frames([str(tmp_path)], tmp_path / "out", Order(), lambda order, output: Crew())
    assert told.count("recorded") == 60 and told.count("written") <= 4  # before: 21
    assert told[:4] == ["begun", "begun", "recorded", "begun"]


def test_a_full_disk_stops_a_run_before_the_rest_is_inferred_in_vain(tmp_path, monkeypatch):
    """It was found out by each frame, when its files were written."""
    for k in range(5):
        np.save(tmp_path / f"{k}.npy", np.ones((4, 4)))
    begun = []

    class Crew:
        size, busy = 1, 0

        def submit(self, frame):
            self.busy = 1
            begun.append(frame)
            if len(begun) == 2:
                monkeypatch.setattr(
                    "derender.atomic.shutil.disk_usage", lambda path: SimpleNamespace(free=64_000, total=10**9)
                )

        def finished(self, timeout):
            self.busy = 0
            return [failure(begun[-1], "no floor")]

        def close(self):
            pass

    with pytest.raises(DerenderError, match="out: the disk is full: 0.1 of the 2 MB that are needed; make room"):
        infer_frames([str(tmp_path)], tmp_path / "out", Order(), lambda order, output: Crew())
    assert len(begun) == 2
    assert (tmp_path / "out" / "results.csv").read_text().count("failed") == 1  # the other was in work


def test_a_frame_that_failed_while_its_copy_stalled_is_done_when_it_is_whole(tmp_path, monkeypatch):
    """A folder is watched; the frame's copy goes on after it has failed, and again while it is worked on."""
    path, begun = tmp_path / "a.npy", []
    path.write_bytes(b"half")

    class Crew:
        size, busy = 1, 0

        def submit(self, frame):
            self.busy, self.frame = 1, frame
            begun.append(path.read_bytes())

        def finished(self, timeout):
            if not self.busy:
                time.sleep(timeout)
                return []
            self.busy = 0
            if begun[-1] == b"half":
                path.write_bytes(b"whole")
                return [failure(self.frame, "cut off")]
            signal.raise_signal(signal.SIGINT)
            return [Done(self.frame, [{**failure(self.frame, "")[1][0], "status": "done", "trusted": True}])]

        def close(self):
            pass

    monkeypatch.setattr("derender.batch.frames.SETTLED", 0.1)
    told = []
    tally = infer_frames([str(tmp_path)], tmp_path / "out", Order(), lambda order, out: Crew(), True, told.append)
    assert begun == [b"half", b"whole"] and [bool(done.error) for done in told] == [True, False]
    assert (tally.done, tally.failed, tally.before) == (1, 0, 0)


def test_what_is_watched_and_is_not_there_is_told(tmp_path):
    """A folder whose name was mistyped was waited for in silence."""

    class Crew:
        size, busy = 1, 0

        def finished(self, timeout):
            signal.raise_signal(signal.SIGINT)
            return []

        def close(self):
            pass

    told, (there, typed) = [], (tmp_path / "frames", tmp_path / "framse")
    there.mkdir()
    watched = [str(there), str(typed), str(tmp_path / "*.npz")]
    infer_frames(watched, tmp_path / "out", Order(), lambda order, out: Crew(), True, warn=told.append)
    assert told == [f"{typed} is not there yet: it is waited for"]


def test_a_frame_counts_as_done_only_once_its_thumbnail_is_there(tmp_path):
    (tmp_path / "summary.json").write_text("{}")
    assert not is_done(tmp_path)  # killed between the two
    (tmp_path / "thumbnail.png").write_bytes(b"")
    assert is_done(tmp_path)
    (tmp_path / "summary.json").unlink()
    assert not is_done(tmp_path)


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="signals that are held back need POSIX")
def test_signals_to_a_process_that_is_starting_are_its_parent_s_business(tmp_path):
    crew = Processes(1, Order(Options(seed=0, method="map")), str(tmp_path / "out"))
    former = {child.pid for child in active_children()}
    try:
        crew.submit(Frame("missing", str(tmp_path / "missing.npy")))
        for child in active_children():
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP) if child.pid not in former else ():
                os.kill(child.pid, number)
        (done,) = wait_for(crew)
        assert "cannot read the depth image" in done.error
    finally:
        crew.close()


class Tells:
    """Stands for a frame: whoever is to infer it writes down the environment in which that process was started."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return exec, (f"import shutil; shutil.copyfile('/proc/self/environ', {str(self.path)!r})",)


@pytest.mark.skipif(not os.path.exists("/proc/self/environ"), reason="this system does not tell environments")
def test_a_process_has_one_thread_from_its_start_unless_the_user_says_how_many(tmp_path, monkeypatch):
    for name in (*LIBRARIES, THREADS_VARIABLE, "PYTHONSAFEPATH"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    before = dict(os.environ)
    crew = Processes(1, Order(Options(seed=0, method="map")), str(tmp_path / "out"))
    try:
        crew.submit(Frame("telling", Tells(tmp_path / "environment")))
        wait_for(crew)
    finally:
        crew.close()
    told = dict(pair.split("=", 1) for pair in (tmp_path / "environment").read_text().split("\0") if "=" in pair)
    wanted = {**dict.fromkeys((*LIBRARIES, THREADS_VARIABLE, "PYTHONSAFEPATH"), "1"), "OMP_NUM_THREADS": "3"}
    assert {name: told.get(name) for name in wanted} == wanted
    assert dict(os.environ) == before


STARTED = (
    "from multiprocessing import resource_tracker; from derender.batch.run import Processes; "
    "crew = Processes(1, None, 'out'); crew.close(); resource_tracker._resource_tracker._stop()"
)


@pytest.mark.parametrize("code", [STARTED, "import derender.physics.mujoco_model"])
def test_what_libraries_start_does_not_run_what_lies_in_the_current_folder(tmp_path, code):
    """A file types.py beside the scene ended `simulate` with a traceback: MuJoCo's GLFW had started a Python."""
    here, script = tmp_path / "here", tmp_path / "script.py"  # whose folder Python looks into, as into `derender`'s
    here.mkdir()
    (here / "types.py").write_text("open('it-was-run', 'w')\n")
    script.write_text(code)
    environment = {**os.environ, "PYTHONPATH": str(Path(derender.__file__).parents[1])}
    environment.pop("PYTHONSAFEPATH", None)
    subprocess.run([sys.executable, script], cwd=here, env=environment, check=True, timeout=60)
    assert not (here / "it-was-run").exists()


class Dies:
    """Stands for a frame whose inference ends its process, as one that needs too much memory does."""

    def __reduce__(self):
        return os._exit, (1,)


def test_a_process_that_dies_takes_one_frame_with_it(tmp_path):
    crew = Processes(1, Order(Options(seed=0, method="map")), str(tmp_path / "out"))
    try:
        crew.submit(Frame("deadly", Dies()))
        (done,) = wait_for(crew)
        assert done.error.startswith("the process that worked on it died")
        crew.submit(Frame("missing", str(tmp_path / "missing.npy")))
        (done,) = wait_for(crew)
        assert isinstance(done, Done) and "cannot read the depth image" in done.error
    finally:
        crew.close()


def wait_for(crew):
    done = []
    for _ in range(600):
        done = done or crew.finished(0.1)
    return done
