"""What ships: frames that can be made again, and a wheel that works away from the checkout."""

import json
import os
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import numpy as np
import pytest

from derender import data_path
from derender.camera.camera_file import read_camera
from derender.camera.depth_file import read_depth

ROOT = Path(__file__).parent.parent
FRAMES = [("kinect_tabletop", "kinect", 1), ("kinect_breakfast", "kinect", 2), ("realsense_two_stacks", "realsense", 3)]


@pytest.mark.parametrize("name, sensor, seed", FRAMES)
def test_a_frame_is_what_its_scene_gives_under_its_sensor(name, sensor, seed, tmp_path):
    from derender.cli import main

    truth = data_path(f"frames/{name}.yaml")
    again = tmp_path / "again.png"
    with pytest.raises(SystemExit) as ended:
        main(["render", str(truth), "--sensor", sensor, "--seed", str(seed), "-q", "-o", str(again)])
    assert ended.value.code == 0
    camera = read_camera(data_path(f"frames/{sensor}_camera.json"))
    shipped, made = read_depth(data_path(f"frames/{name}.png"), camera), read_depth(again, camera)
    # Another numpy may draw other normals, and then the pixels differ by noise; the scene must be the same.
    both = np.isfinite(shipped.depth) & np.isfinite(made.depth)
    assert both.mean() > 0.9
    assert np.median(np.abs(shipped.depth - made.depth)[both]) < 0.005


def test_what_ships_is_small():
    size = sum(path.stat().st_size for path in (ROOT / "data").rglob("*") if path.is_file())
    assert size < 2_000_000


@pytest.mark.slow
def test_wheel_and_sdist_build_and_the_installed_wheel_works_elsewhere(tmp_path):
    def run(*command, **keywords):
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900, **keywords)
        assert done.returncode == 0, done.stderr[-3000:]
        return done.stdout

    run(sys.executable, "-m", "build", "--outdir", tmp_path, ROOT)
    (wheel,) = tmp_path.glob("*.whl")
    (sdist,) = tmp_path.glob("*.tar.gz")
    names = zipfile.ZipFile(wheel).namelist()
    assert "derender/_data/priors/tabletop.yaml" in names and "derender/_data/frames/kinect_tabletop.png" in names
    assert not [name for name in names if name.startswith(("tests/", "scripts/"))]
    assert sdist.stat().st_size < 5_000_000
    venv.create(tmp_path / "venv", with_pip=True)
    binaries = tmp_path / "venv" / "bin"
    run(binaries / "pip", "install", "--quiet", wheel)
    run(binaries / "pip", "check")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    run(binaries / "derender", "sample", "--seed", "1", cwd=elsewhere)
    assert (elsewhere / "sample_000.npz").is_file()
    run(binaries / "derender", "render", "sample_000.yaml", "--preview", cwd=elsewhere)
    report = json.loads(run(binaries / "derender", "doctor", "--json", cwd=elsewhere))
    assert report["renderers"]["raycast"]["works"]
