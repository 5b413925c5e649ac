"""derender view: the page of a result, made where it is missing, and opened."""

import json
import os
import webbrowser

import numpy as np
import pytest
from click.testing import CliRunner
from on_floor import cube, on_floor

from derender.camera.depth_file import write_depth
from derender.camera.intrinsics import Camera
from derender.cli.view import command
from derender.document import LikelihoodPrior, document_text
from derender.errors import DerenderError
from derender.render.raycast.depth import render_depth
from derender.results.posterior import Posterior, StructurePosterior

CAMERA = Camera.from_field_of_view(40, 30)


@pytest.fixture
def folder(tmp_path):
    """What infer leaves, without a page; something unexplained is in the image, and a simulation was run."""
    graph = on_floor(cube(theta=0.4), elevation=50.0, distance=0.7, lower=0.05)
    depth = render_depth(graph.solids(), CAMERA, background=10.0)[0]
    depth[20:28, 2:10] = 0.4
    one = np.zeros((1, 1))
    posterior = Posterior(
        (StructurePosterior(graph, (), np.zeros((1, 1, 0)), one, one),),
        1,
        "derender infer x",
        meta={"image": "there/x.npy"},
    )
    place = tmp_path / "result"
    place.mkdir()
    posterior.save(place / "posterior.npz")
    write_depth(place / "observation.npz", depth, CAMERA)
    (place / "scene.yaml").write_text(document_text(graph, CAMERA, LikelihoodPrior(), {"seed": 1}, place))
    (place / "simulation.json").write_text(
        json.dumps({"verdict": "settles", "p_stable": 0.75, "animation": "fall.gif"})
    )
    (place / "fall.gif").write_bytes(b"GIF89a")
    return place


def view(*arguments):
    return CliRunner().invoke(command, [str(a) for a in arguments], catch_exceptions=False, standalone_mode=False)


def test_a_missing_page_is_made_and_opened(folder, monkeypatch):
    opened = []
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address) or True)
    result = view(folder)
    assert result.stdout.strip() == str(folder / "report.html")
    assert opened == [(folder / "report.html").resolve().as_uri()]
    page = (folder / "report.html").read_text()
    assert "region A below and left of the middle" in page and 'class="doubt"' in page
    assert "<h1>x.npy</h1>" in page  # as the page that infer writes
    assert "Simulated: settles, P(stable) 0.75" in page and "data:image/gif" in page
    for name in ("scene.yaml", "objects.csv", "scene.glb"):
        assert f'download="{name}"' in page
    (folder / "report.html").write_text("kept")  # newer than the posterior: not made again
    view(folder, "--no-open")
    assert (folder / "report.html").read_text() == "kept" and len(opened) == 1
    (folder / "simulation.json").write_text(json.dumps({"verdict": "falls", "command": "derender simulate <x>"}))
    os.utime(folder / "simulation.json", (2e9, 2e9))
    view(folder, "--no-open")
    page = (folder / "report.html").read_text()
    assert "Simulated: falls" in page and "derender simulate &lt;x&gt;" in page
    assert "data:image/gif" not in page  # it shows the simulation before


@pytest.mark.parametrize(
    "forces", [{"a": 1}, [{"point": [1, 2], "force": [1]}], [{"point": [0, 0, 1], "force": [1e999] * 3}], 3]
)
def test_what_is_no_simulation_is_left_out(folder, forces):
    (folder / "simulation.json").write_text(json.dumps({"verdict": "stands", "forces": forces}))
    view(folder, "--no-open")
    assert "Simulated: stands" in (folder / "report.html").read_text()


def test_the_page_of_many_frames_is_their_index(tmp_path):
    (tmp_path / "index.html").write_text("many")
    assert view(tmp_path, "--no-open").stdout.strip() == str(tmp_path / "index.html")


def test_what_is_no_result_is_said(tmp_path):
    with pytest.raises(DerenderError, match="no such folder"):
        view(tmp_path / "nowhere")
    with pytest.raises(DerenderError, match="no scene in this folder"):
        view(tmp_path)
