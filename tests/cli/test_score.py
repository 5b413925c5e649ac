"""derender score: the numbers it prints add up, and a worse scene scores worse."""

import json

import pytest
from click.testing import CliRunner

from derender.cli.sample import command as sample
from derender.cli.score import command as score
from derender.report.scores import BACKGROUND


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
    assert lines[3].startswith("floor")
