"""scripts/batch.sh, over a folder of frames of which some are bad."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

SCRIPT = Path(__file__).parent.parent / "scripts" / "batch.sh"


def batch(folder, name="frames"):
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    command = ["sh", SCRIPT, name]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120)


def test_a_batch_bears_failures_and_goes_on_where_it_was_stopped(tmp_path):
    (tmp_path / "frames" / "more").mkdir(parents=True)
    np.save(tmp_path / "frames" / "more" / "only a floor.npy", np.full((48, 64), 0.9))
    (tmp_path / "frames" / "bad.png").write_bytes(b"")
    done = batch(tmp_path)
    assert done.returncode == 1 and "1 failed" in done.stdout and "bad.png: the file is empty" in done.stdout
    assert (tmp_path / "results" / "table.tsv").read_text() == "more/only a floor\t0\t\n"
    summary = tmp_path / "results" / "more" / "only a floor" / "summary.json"
    written = summary.stat().st_mtime_ns
    (tmp_path / "frames" / "bad.png").unlink()
    (tmp_path / "results" / "bad" / "log.txt").unlink()
    done = batch(tmp_path)
    assert done.returncode == 0 and summary.stat().st_mtime_ns == written


def test_a_batch_needs_a_folder_and_takes_no_result_for_a_frame(tmp_path):
    done = batch(tmp_path, "nowhere")
    assert done.returncode == 1 and done.stderr == "nowhere: there is no such folder\n"
    (tmp_path / "results" / "frame").mkdir(parents=True)
    (tmp_path / "results" / "frame" / "posterior.npz").write_bytes(b"")
    (tmp_path / "results" / "frame" / "summary.json").write_text('{"scene": {"objects": []}}')
    done = batch(tmp_path, ".")
    assert done.returncode == 0 and done.stdout == "wrote results/table.tsv\n"
