"""derender score: the numbers it prints add up, and a worse scene scores worse."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from derender.cli.infer import command as infer
from derender.cli.sample import command as sample
from derender.cli.score import command as score
from derender.document import read_document
from derender.errors import DerenderError
from derender.render.likelihoods import likelihoods
from derender.report.scores import BACKGROUND
from derender.results.posterior import load


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(sample, ["stack", "--seed", "4", "--noise"])
    assert result.exit_code == 0, result.output
    return tmp_path


def run(*arguments):
    result = CliRunner().invoke(score, list(arguments), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result


def test_shares_sum_to_the_whole_and_every_object_helps(scene):
    data = json.loads(run("sample_000.yaml", "sample_000.npz", "--prior", "stack", "--json").stdout)
    assert sum(share["log_likelihood"] for share in data["objects"]) == pytest.approx(data["log_likelihood"], rel=1e-5)
    assert data["log_prior"] is not None
    for share in data["objects"]:
        if share["name"] != BACKGROUND and share["pixels"] > 20:
            assert share["gain"] > 0


def test_a_scene_that_is_moved_scores_worse(scene):
    text = (scene / "sample_000.yaml").read_text()
    before = json.loads(run("sample_000.yaml", "sample_000.npz", "--json").stdout)
    start = text.index("root: {position: [") + len("root: {position: [")
    x, rest = text[start:].split(",", 1)
    (scene / "moved.yaml").write_text(text[:start] + str(float(x) + 0.01) + "," + rest)
    after = json.loads(run("moved.yaml", "sample_000.npz", "--json").stdout)
    assert after["log_likelihood"] < before["log_likelihood"] - 100


def test_the_table_has_a_row_for_each_object(scene):
    lines = run("sample_000.yaml", "sample_000.npz").stdout.splitlines()
    assert lines[0].startswith("log prior")
    assert lines[1].startswith("log likelihood")
    assert lines[3].startswith("floor") and lines[3].split()[3] == ">1e9"  # it was 1.14e+11 nats, which say nothing


@pytest.mark.slow
def test_an_inferred_scene_is_scored_under_the_prior_and_the_sensor_that_inference_had(scene):
    drawn = np.load("sample_000.npz")
    assert CliRunner().invoke(infer, ["sample_000.npz", "-o", "out", "--draws", "20", "-q"]).exit_code == 0
    fitted = read_document("out/scene.yaml").likelihood
    assert fitted.values["sigma"] == pytest.approx(0.002, rel=0.1)  # `stack` says 2 mm and half a pixel
    assert fitted.values["blur"] == pytest.approx(0.5, abs=0.15)
    data = json.loads(run("out", "--json").stdout)
    posterior = load("out")
    part = posterior.best_part
    best = np.argmax(part.log_density)
    assert data["prior"] == "bare-image" and data["why"] == ""
    assert data["log_prior"] == pytest.approx(part.log_prior.flat[best], abs=1e-6)
    depth = drawn["depth"]
    likely = likelihoods["gaussian"].complete({"sigma": 0.002, "blur": 0.5})
    # the explanation is about as good as the truth: noise, not edges, is what is left
    assert data["log_likelihood"] > -0.5 * depth.size * (1 + np.log(2 * np.pi * likely["sigma"] ** 2)) - 200


def test_a_prior_that_cannot_make_a_scene_says_why(scene):
    for prior, why in [
        ("tabletop", "red.contact."), ("figure-4", "it has no "), ("algorithm-1", "the root"), ("stack", ""),
    ]:  # fmt: skip
        data = json.loads(run("sample_000.yaml", "sample_000.npz", "--prior", prior, "--json").stdout)
        assert why in data["why"] and (data["log_prior"] is None) == bool(why), prior
    assert "stack)" in run("sample_000.yaml", "sample_000.npz").stdout  # the file says what it was made with
    (scene / "lost.yaml").write_text((scene / "sample_000.yaml").read_text().replace("prior: stack", "prior: no.yaml"))
    first = run("lost.yaml", "sample_000.npz").stdout.splitlines()[0]
    assert "nan  (no.yaml: there is no such file; give another with --prior)" in first


def test_a_scene_without_an_image_is_a_fault_and_a_result_brings_its_own(scene):
    result = CliRunner().invoke(score, ["sample_000.yaml"])
    assert isinstance(result.exception, DerenderError)
    assert "derender score SCENE IMAGE" in str(result.exception)
