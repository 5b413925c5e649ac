"""Every block of README.md is run, in an empty folder for each section; what it prints as fact is what is so."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from derender import data_path

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
FENCE = re.compile(r"(<!-- slow -->\n)?^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(language):
    """Return (section, number, slow, text) for each block in this language."""
    found = []
    for part in re.split(r"^## ", README, flags=re.MULTILINE):
        section = part.splitlines()[0].strip().lower().replace(" ", "-")
        for number, match in enumerate(FENCE.finditer(part)):
            if match[2] == language:
                found.append((section, number, bool(match[1]), match[3]))
    return found


def parameters(language):
    """Return a pytest parameter for each block, the slow ones marked."""
    return [
        pytest.param(text, id=f"{section}-{number}", marks=[pytest.mark.slow] if slow else [])
        for section, number, slow, text in blocks(language)
    ]


@pytest.fixture
def folder(tmp_path):
    """Return a folder with what the README assumes: one's own frame and camera, and the prior that it prints."""
    shutil.copy(data_path("frames/kinect_tabletop.png"), tmp_path / "frame.png")
    shutil.copy(data_path("frames/kinect_camera.json"), tmp_path / "camera.json")
    (tmp_path / "prior.yaml").write_text(blocks("yaml")[0][3])
    return tmp_path


def test_there_are_only_blocks_that_a_test_runs():
    languages = {match[2] for match in FENCE.finditer(README)}
    assert languages <= {"sh", "python", "yaml", "json", "text"}
    assert README.count("```") == 2 * len(list(FENCE.finditer(README)))


@pytest.mark.parametrize("text", parameters("sh"))
def test_the_commands_run(text, folder):
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    if all(line.startswith("make ") for line in text.splitlines()):
        for line in text.splitlines():  # run by whoever runs this test; here only that the target exists
            done = subprocess.run([*line.split(), "-n"], cwd=ROOT, env=environment, capture_output=True, text=True)
            assert done.returncode == 0, done.stderr
        return
    if text.startswith("derender show result"):
        pytest.skip("goes on from the block before")
    done = subprocess.run(
        ["sh", "-e", "-x", "-c", text], cwd=folder, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "Traceback" not in done.stderr


def test_every_make_target_named_exists_and_the_ci_runs_the_readmes_test_command():
    help_text = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for target in re.findall(r"make ([a-z][a-z-]*)", README):
        assert re.search(rf"^{target} ", help_text, re.MULTILINE), target
    assert "make test" in blocks("sh")[0][3]
    assert (ROOT / ".ci" / "run").read_text().rstrip().endswith("make test")


def test_infer_prints_what_is_shown(folder):
    """The same best structure and addresses; the numbers are of the machine and the day that printed them."""
    command = [sys.executable, "-m", "derender"]
    subprocess.run([*command, "sample"], cwd=folder, check=True)
    told = subprocess.run([*command, "infer", "sample_000.npz"], cwd=folder, capture_output=True, text=True, check=True)
    shown = blocks("text")[0][3].splitlines()
    words = shown[0].partition("  ")[2]
    assert told.stdout.splitlines()[0].endswith(words) and shown[-1].startswith("the chains agree")
    addresses = [line.split()[0] for line in told.stdout.splitlines()]
    assert {line.split()[0] for line in shown[2:-1] if line != "..."} <= {*addresses}


@pytest.mark.parametrize("text", parameters("python"))
def test_the_python_runs(text, tmp_path):
    done = subprocess.run([sys.executable, "-c", text], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]


def test_the_example_of_a_shape_is_read_from_yaml_and_drawn(tmp_path):
    draw = """
from pathlib import Path
from derender.document import read_document
from derender.camera.intrinsics import Camera
from derender.render.renderers import find_renderer
Path("scene.yaml").write_text('''derender: 1
root: {position: [0, 0.1, 0.8], quat_wxyz: [0.5, 0.866, 0, 0]}
objects:
  floor: {shape: plane, contact: {type: 6dof}}
  ramp:
    shape: {type: wedge, length: 0.2, width: 0.1, height: 0.1}
    parent: floor
    contact: {type: face-to-face, parent_face: +z, child_face: -z, x: 0, y: 0, theta: 0.5}
''')
solids = read_document("scene.yaml").graph.solids()
depth, label = find_renderer("raycast").render_depth(solids, Camera.from_field_of_view(80, 60))
assert (label == 1).sum() > 100
"""
    text = data_path("plugins/wedge.py").read_text() + draw
    done = subprocess.run([sys.executable, "-c", text], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.parametrize("text", parameters("yaml"))
def test_the_yaml_is_a_prior(text, tmp_path):
    from derender.document import read_document

    (tmp_path / "prior.yaml").write_text(text)
    document = read_document(tmp_path / "prior.yaml")
    assert document.camera is not None and not document.is_scene


@pytest.mark.parametrize("text", parameters("json"))
def test_the_json_is_json(text):
    scene = json.loads(text)
    assert set(scene) == {"frame", "gravity", "objects", "explained", "trusted", "doubts"}


def test_the_list_of_commands_is_fresh():
    """Run scripts/list_commands.py where this fails."""
    command = [sys.executable, str(ROOT / "scripts" / "list_commands.py"), "--check"]
    assert subprocess.run(command, timeout=120).returncode == 0


def test_the_files_named_are_there():
    for name in re.findall(r"`((?:derender|data|scripts|tests)/[^`* ]*)", README):
        assert (ROOT / name).exists(), name


def test_the_pictures_are_there():
    for name in re.findall(r"!\[[^]]*\]\(([^)]+)\)", README):
        assert (ROOT / name).is_file(), name
