"""derender infer as a person types it."""

import json
import shutil

import numpy as np
import pytest
from click.testing import CliRunner

from derender import data_path
from derender.cli.infer import command
from derender.errors import DerenderError
from derender.vision.depth_file import write_depth


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    from derender.cli.sample import command as sample

    place = tmp_path_factory.mktemp("infer")
    result = CliRunner().invoke(sample, ["figure-5", "--seed", "3", "-o", str(place)], catch_exceptions=False)
    assert result.exit_code == 0
    return place


def infer(*arguments):
    return CliRunner().invoke(command, [str(a) for a in arguments], catch_exceptions=False, standalone_mode=False)


def test_writes_everything(folder, tmp_path):
    out = tmp_path / "out"
    result = infer(folder / "sample_000.npz", "--scene", "figure-5", "--draws", 300, "--seed", 1, "-o", out)
    assert "yellow.contact.theta" in result.stdout and "R-hat" in result.stdout
    summary = json.loads((out / "summary.json").read_text())
    assert summary["seed"] == 1 and summary["version"] and summary["command"]
    assert summary["draws"] == 300
    assert set(summary["parameters"]) == {f"yellow.contact.{k}" for k in ("theta", "u", "v")}
    for name in ("scene.yaml", "posterior.npz", "report.html", "observation.npz"):
        assert (out / name).stat().st_size > 100
    from derender.document import read_document

    truth = read_document(folder / "sample_000.yaml").graph.poses()["yellow"]
    found = read_document(out / "scene.yaml").graph.poses()["yellow"]
    assert np.linalg.norm(truth[:3, 3] - found[:3, 3]) < 0.01


def test_the_truth_beside_the_image_is_not_read(folder, tmp_path):
    """The same image alone in a folder gives the same draws."""
    alone = tmp_path / "sample_000.npz"
    shutil.copy(folder / "sample_000.npz", alone)
    values = []
    for number, image in enumerate((folder / "sample_000.npz", alone)):
        out = tmp_path / str(number)
        infer(image, "--scene", "figure-5", "--draws", 50, "--warmup", 50, "-o", out, "-q")
        with np.load(out / "posterior.npz") as file:
            values.append(file["values_0"])
    np.testing.assert_array_equal(*values)


def test_strict_doubts_too_few_draws(folder, tmp_path):
    arguments = [folder / "sample_000.npz", "--scene", "figure-5", "--draws", 5, "--warmup", 0, "-o", tmp_path / "o"]
    assert infer(*arguments, "--strict").return_value == 3
    assert infer(*arguments).return_value is None


def test_without_a_camera_it_says_what_it_takes(tmp_path):
    image = tmp_path / "plain.npy"
    np.save(image, np.full((18, 24), 0.8, np.float32))
    arguments = (image, "--scene", data_path("priors/figure-5.yaml"), "--draws", 5, "--warmup", 5, "-o", tmp_path / "o")
    assert "60 degrees" in infer(*arguments).stderr


@pytest.mark.parametrize(
    "image, what",
    [(np.zeros((8, 8)), "depth"), (np.full((8, 8), np.nan), "depth")],
)
def test_an_empty_image_is_told_and_leaves_nothing(tmp_path, image, what):
    np.save(tmp_path / "image.npy", image.astype(np.float32))
    with pytest.raises(DerenderError, match=what):
        infer(tmp_path / "image.npy", "--scene", "figure-5", "-o", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_camera_of_another_size_is_told(folder, tmp_path):
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps({"fx": 50, "fy": 50, "cx": 3, "cy": 3, "width": 7, "height": 7}))
    with pytest.raises(DerenderError, match="64 x 64"):
        infer(folder / "sample_000.npz", "--scene", "figure-5", "--camera", camera, "-o", tmp_path / "out")


def test_an_image_with_holes_is_fine(folder, tmp_path):
    from derender.vision.depth_file import read_depth

    seen = read_depth(folder / "sample_000.npz")
    depth = seen.depth.copy()
    depth[::3, ::2] = np.nan
    write_depth(tmp_path / "holes.npz", depth, seen.camera)
    out = tmp_path / "out"
    infer(tmp_path / "holes.npz", "--scene", "figure-5", "--draws", 50, "--method", "map", "-o", out, "-q")
    assert (out / "scene.yaml").exists()
