"""derender sample, show and types, as a person types them."""

import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from derender.camera.depth_file import read_depth
from derender.cli import main
from derender.document import built_in_priors, read_document
from derender.posterior.kernels import kernels
from derender.report.scene_json import scene_json
from derender.report.tree_text import scene_lines
from derender.results.posterior import Posterior, StructurePosterior
from derender.scene.distributions import distributions
from derender.scene.shapes import shapes


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments):
    """Return the exit status of the command line."""
    with pytest.raises(SystemExit) as ended:
        main(list(map(str, arguments)))
    return ended.value.code


def test_sample_without_an_argument(folder):
    assert run("sample") == 0
    assert sorted(path.name for path in folder.iterdir()) == ["sample_000.npz", "sample_000.yaml"]
    document, image = read_document("sample_000.yaml"), read_depth("sample_000.npz")
    assert document.is_scene and document.camera == image.camera and not image.camera_is_guess
    assert image.depth.shape == (120, 160) and 0.3 < np.nanmedian(image.depth) < 3
    assert image.meta["seed"] == 0 and image.meta["command"] == "derender sample tabletop --seed 0"
    assert document.made["version"] and document.made["seed"] == 0


def test_the_noise_is_that_of_the_likelihood(folder):
    assert run("sample", "stack", "-o", "noisy") == 0 == run("sample", "stack", "--no-noise", "-o", "clean")
    noisy, clean = (read_depth(f"{name}/sample_000.npz").depth for name in ("noisy", "clean"))
    flat = np.hypot(*np.gradient(clean)) < 0.02  # away from edges, which the blur moves
    residual = (noisy - clean)[flat]
    # A standard deviation of n normals has itself the standard deviation sigma / sqrt(2 n); 5 of them.
    assert residual.std() == pytest.approx(0.002, rel=0.02 + 5 / math.sqrt(2 * residual.size))


def test_a_seed_of_more_than_63_bits_is_told_the_most(folder, capfd):
    """It was "not in the range x>=0", in which it is."""
    assert run("sample", "--seed", 10**20) == 2 and "is not in the range 0<=x<2^63" in capfd.readouterr().err


def test_a_seed_gives_the_same_bytes_and_draws_do_not_depend_on_their_number(folder):
    assert run("sample", "stack", "--seed", 5, "-n", 3, "-o", "three") == 0
    assert run("sample", "stack", "--seed", 5, "-n", 2, "-o", "two") == 0
    assert run("sample", "stack", "--seed", 6, "-n", 2, "-o", "other") == 0
    for name in ("sample_000.npz", "sample_001.npz", "sample_001.yaml"):
        content = (folder / "three" / name).read_bytes()
        assert (folder / "two" / name).read_bytes() == content != (folder / "other" / name).read_bytes()


def test_sample_streams_into_show(folder, capfd, monkeypatch):
    assert run("sample", "grammar", "-n", 20, "-o", "-") == 0
    text = capfd.readouterr().out
    assert text.count("derender: 1\n") == 20 and list(folder.iterdir()) == []
    (folder / "stream").write_text(text)
    with open("stream") as stream:
        monkeypatch.setattr("sys.stdin", stream)
        assert run("show", "-", "--json") == 0
    scenes = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    assert len(scenes) == 20 and all(scene["objects"][0]["name"] == "floor" for scene in scenes)


@pytest.mark.parametrize("name", built_in_priors())
def test_every_built_in_prior_is_sampled_and_shown(name, capfd):
    assert run("sample", name, "--no-images") == 0 and run("show", "sample_000.yaml") == 0
    lines = capfd.readouterr().out.splitlines()
    assert lines[0].startswith("root") and "degrees of freedom" in lines[-1]
    assert run("show", name) == 0
    shown = capfd.readouterr().out  # what it is written in: a start for one's own
    Path("own.yaml").write_text(shown)
    assert run("sample", "own.yaml", "--no-images", "-q", "-o", "again") == 0
    first, again = (Path(place, "sample_000.yaml").read_text() for place in (".", "again"))
    assert first.partition("camera:")[2] == again.partition("camera:")[2]


def test_show_counts_the_freedom_of_figure_3(capfd):
    for name, count in (("stack", 15), ("free", 24)):
        assert run("sample", name, "--no-images", "-q") == 0 and run("show", "sample_000.yaml") == 0
        assert capfd.readouterr().out.splitlines()[-1].startswith(f"{count} continuous degrees of freedom")


def test_show_json_is_the_contract(capfd):
    assert run("sample", "stack", "--no-images", "-q") == 0 and run("show", "sample_000.yaml", "--json") == 0
    scene = json.loads(capfd.readouterr().out)
    assert scene["frame"] == "camera" and np.linalg.norm(scene["gravity"]) == pytest.approx(9.81)
    assert scene["gravity"][1] > 0, "down is down in the image"
    floor, green, red, yellow = scene["objects"]
    assert floor["size"] is None and red["size"] == [0.1, 0.1, 0.1] and red["parent"] == "green"
    for item in scene["objects"]:
        pose = np.array(item["pose"])
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    # The green cube's centre is half its side above the floor.
    up = np.array(floor["pose"])[:3, 2]
    assert up @ (np.array(green["pose"])[:3, 3] - np.array(floor["pose"])[:3, 3]) == pytest.approx(0.06, abs=1e-12)
    assert set(yellow["contact"]) == {"type", "parent_face", "child_face", "theta", "u", "v"}
    assert "probability" not in yellow


class TwoParents(Posterior):
    """A posterior that doubts where things stand."""

    def object_probability(self, name):
        return 0.75

    def parent_probability(self, name):
        return {"floor": 0.9, "green": 0.1}

    def support_probability(self, name):
        return {"green": 0.3} if name == "yellow" else {}

    def shape_probability(self, name):
        return {"cube": 0.6, "box": 0.4} if name == "red" else super().shape_probability(name)


def test_a_posterior_adds_its_probabilities():
    assert run("sample", "stack", "--no-images", "-q") == 0
    graph = read_document("sample_000.yaml").graph
    one = np.zeros((1, 1))
    doubtful = TwoParents((StructurePosterior(graph, (), np.zeros((1, 1, 0)), one, one),))
    entry = scene_json(graph, doubtful)["objects"][1]
    assert entry["size_interval"] == [[side, side] for side in entry["size"]]
    assert entry["probability"] == 0.75 and entry["parent_probability"] == {"floor": 0.9, "green": 0.1}
    assert "support_probability" not in entry
    assert scene_json(graph, doubtful)["objects"][3]["support_probability"] == {"green": 0.3}
    assert entry["type_probability"] == {"cube": 1.0}
    assert scene_json(graph, doubtful)["objects"][2]["type_probability"] == {"cube": 0.6, "box": 0.4}
    assert "p .75 (on floor .90, green .10; cube .60, box .40)" in "\n".join(scene_lines(graph, doubtful))
    assert "p .75 (on floor .90, green .10, also green .30)" in "\n".join(scene_lines(graph, doubtful))
    assert "p .75 (on floor .90, green .10)" in "\n".join(scene_lines(graph, doubtful))


def test_types_lists_and_explains_what_is_registered(capfd):
    assert run("types") == 0
    listing = capfd.readouterr().out
    for name in [*shapes, *distributions, "face-to-face", "gaussian", "grammar", "no-overlap", *kernels]:
        assert name in listing
    assert run("types", "face-to-face") == 0
    text = capfd.readouterr().out
    assert "theta" in text and "slack" in text and "period" in text
    assert run("types", "drift") == 0
    assert re.search(r"^scale +1$", capfd.readouterr().out, re.MULTILINE)
    assert run("types", "robust") == 0  # a name of 16 letters: the columns stay columns
    lines = capfd.readouterr().out.partition("parameter ")[2].splitlines()
    assert len(lines) > 9 and len({len(line) for line in lines[1:]}) == 1
    assert run("types", "--json") == 0
    assert {entry["kind"] for entry in json.loads(capfd.readouterr().out)} >= {"shape", "contact", "distribution"}


@pytest.mark.parametrize(
    "arguments,says",
    [
        (("sample", "tabeltop"), "did you mean 'tabletop'?"),
        (("sample", "missing.yaml"), "missing.yaml"),
        (("sample", "--camera", "missing.json"), "missing.json"),
        (("sample", "--renderer", "povray"), "no renderer is called 'povray'"),
        (("sample", "-o", "file"), "file"),
        (("show", "missing.yaml"), "there is no such file"),
        (("show", "tabletop", "--json"), "this is a prior, not a scene"),
        (("show", "empty"), "there is no scene in this folder"),
        (("show", "film"), "this folder holds a film, not a scene; derender view shows it"),
        (("export", "tabletop", "-o", "x.glb"), "this is a prior, not a scene; draw a scene: derender sample tabletop"),
        (("types", "cubus"), "did you mean 'cube'?"),
    ],
)
def test_faults_are_one_line(folder, capfd, arguments, says):
    (folder / "file").write_text("")
    (folder / "empty").mkdir()
    (folder / "film").mkdir()
    (folder / "film" / "track.json").write_text("{}")
    assert run(*arguments) == 1
    out, err = capfd.readouterr()
    assert says in err and len(err.splitlines()) == 1 and not out
    assert sorted(path.name for path in folder.iterdir()) == ["empty", "file", "film"]


def test_usage_is_two():
    assert run("sample", "-n", "0") == 2 == run("sample", "--no-such")


def test_a_prior_is_shown_without_compiling(tmp_path):
    """Its kernels are those of what samples it: its text needs none."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run([sys.executable, "-m", "derender", "show", "relations"], capture_output=True, env=environment)
    assert done.returncode == 0 and b"supports:" in done.stdout and not done.stderr
