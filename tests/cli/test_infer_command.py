"""derender infer as a person types it."""

import json
import shutil

import imageio.v3 as imageio
import numpy as np
import pytest
from click.testing import CliRunner

from derender import data_path
from derender.camera.depth_file import write_depth
from derender.cli.infer import command
from derender.errors import DerenderError
from derender.tracking.film import FPS_SPREAD

BLOCK = """derender: 1
camera: {fx: 40, fy: 40, cx: 23.5, cy: 17.5, width: 48, height: 36}
root: {distance: 0.7, elevation: 35 deg}
objects:
  floor: {shape: plane, contact: {type: 6dof}}
  block:
    shape: {type: box, length: 12 cm, width: 10 cm, height: 8 cm}
    parent: floor
    contact: {type: face-to-face, parent_face: +z, child_face: -z, x: 0.0, y: 0.0, theta: 0.5}
likelihood: {type: gaussian, sigma: 3 mm}
"""


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
    result = infer(folder / "sample_000.npz", "--scene", "figure-5", "--draws", 300, "--seed", 1, "-v", "-o", out)
    assert " s\nwrote" in result.stderr
    assert "yellow.contact.theta" in result.stdout and "R-hat" in result.stdout
    summary = json.loads((out / "summary.json").read_text())
    assert summary["seed"] == 1 and summary["version"] and summary["command"]
    assert summary["draws"] == 300
    assert set(summary["parameters"]) == {f"yellow.contact.{k}" for k in ("theta", "u", "v")}
    for name in ("scene.yaml", "posterior.npz", "report.html", "observation.npz", "explained.npy"):
        assert (out / name).stat().st_size > 100
    assert (
        (out / "labels.png").exists() and summary["explained"] > 0.9 and summary["trusted"] == (not summary["doubts"])
    )
    from derender.document import read_document

    truth = read_document(folder / "sample_000.yaml").graph.poses()["yellow"]
    found = read_document(out / "scene.yaml").graph.poses()["yellow"]
    assert np.linalg.norm(truth[:3, 3] - found[:3, 3]) < 0.01


@pytest.mark.slow
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
    quiet = infer(*arguments, "-q")
    assert quiet.return_value is None
    assert quiet.stderr.startswith("not to be trusted: ")  # whoever asks for silence is not to be misled


def test_without_a_camera_it_says_what_it_takes(tmp_path):
    image = tmp_path / "plain.npy"
    np.save(image, np.full((18, 24), 0.8, np.float32))
    arguments = (image, "--scene", data_path("priors/figure-5.yaml"), "--draws", 5, "--warmup", 5, "-o", tmp_path / "o")
    assert "60 degrees" in infer(*arguments).stderr


@pytest.mark.parametrize("image, what", [(np.zeros((8, 8)), "depth"), (np.full((8, 8), np.nan), "depth")])
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


@pytest.mark.slow
def test_an_image_with_holes_is_fine(folder, tmp_path):
    from derender.camera.depth_file import read_depth

    seen = read_depth(folder / "sample_000.npz")
    depth = seen.depth.copy()
    depth[::3, ::2] = np.nan
    write_depth(tmp_path / "holes.npz", depth, seen.camera)
    out = tmp_path / "out"
    infer(tmp_path / "holes.npz", "--scene", "figure-5", "--draws", 50, "--method", "map", "-o", out, "-q")
    assert (out / "scene.yaml").exists()


@pytest.mark.parametrize(
    "options, message",
    [
        (["--shapes", "bx"], "--shapes: 'bx' is no shape to look for; did you mean 'box'?"),
        (["--track", "--shapes", "bx"], "--shapes: 'bx' is no shape to look for; did you mean 'box'?"),
        (["--shapes", ""], "--shapes: '' is no shape to look for; choose from"),
        (["--floor", "1,2"], "--floor: this is no floor; give auto, none, or four numbers"),
        (["--only-known"], "--only-known: nothing is known; give a library"),
        (["--known", "no.yaml"], "no.yaml: there is no such file"),
        (["--known", "sizes.yaml", "--method", "mcmc"], "--known: --method mcmc does not know of libraries"),
        (["--scene", "figure-5", "--known", "sizes.yaml"], "figure-5: --known is for images without a scene"),
        (["--scene", "figure-5", "--allow-floating"], "leave out --allow-floating or --scene"),
        (["--scene", "fixed.yaml"], "fixed.yaml: nothing is unknown: every number is fixed; give some number a"),
    ],
)
def test_wrong_options_are_one_line_with_the_remedy(folder, tmp_path, options, message, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sizes.yaml").write_text("known:\n  brick: {type: box, length: 0.1, width: 0.1, height: 0.1}\n")
    shutil.copy(folder / "sample_000.yaml", tmp_path / "fixed.yaml")
    with pytest.raises(DerenderError) as caught:
        infer(folder / "sample_000.npz", *options, "-o", "out")
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_too_few_pixels_names_the_image(tmp_path):
    depth = np.full((20, 20), np.nan)
    depth[:5, :5] = 0.8
    np.save(tmp_path / "few.npy", depth)
    for floor in ([], ["--floor", "none"]):
        with pytest.raises(DerenderError, match=r"few\.npy: the image has .*25"):
            infer(tmp_path / "few.npy", *floor, "-o", tmp_path / "out")


def test_options_that_say_nothing_here_are_told(tmp_path):
    np.save(tmp_path / "only_a_floor.npy", np.full((24, 32), 0.9))
    words = ("--resume", "--warmup", 3, "--draws", 9, "--chains", 3, "--budget", "2s", "--gradient",
             "finite-difference", "--least-confidence", 2, "--topic", "depth")  # fmt: skip
    result = infer(tmp_path / "only_a_floor.npy", "--method", "map", *words, "-o", tmp_path / "out")
    told = {line.split()[1] for line in result.stderr.splitlines() if "says nothing here: " in line}
    assert told == {word for word in words if str(word).startswith("--")}
    many = infer(tmp_path / "only_a_floor.npy", tmp_path / "only_a_floor.npy", "--quick", "--draws", 9, "-j", 1,
                 "-o", tmp_path / "many")  # fmt: skip
    assert many.stderr.count("--draws says nothing here") == 1


@pytest.mark.slow
def test_an_older_result_is_replaced_as_a_whole_or_not_at_all(folder, tmp_path, monkeypatch):
    from derender.report import result_folder

    out = tmp_path / "out"
    arguments = (folder / "sample_000.npz", "--scene", "figure-5", "--draws", 20, "--warmup", 20, "-o", out, "-q")
    infer(*arguments)
    (out / "notes.txt").write_text("mine")
    first = {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}

    def full_disk(*_):
        raise DerenderError("No space left", out)

    monkeypatch.setattr(result_folder, "write_depth", full_disk)
    with pytest.raises(DerenderError, match="No space left"):
        infer(*arguments, "--seed", 2)
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()} == first
    monkeypatch.undo()
    (out / "posterior.nc").write_text("of an older run")
    monkeypatch.setattr("derender.results.predictive.write_netcdf", lambda *_: False)  # as where h5netcdf is missing
    infer(*arguments, "--seed", 2)
    assert not (out / "posterior.nc").exists() and (out / "notes.txt").read_text() == "mine"
    seeds = [json.loads((out / "summary.json").read_text())["seed"], read_made(out / "scene.yaml")["seed"]]
    assert seeds == [2, 2]


def read_made(path):
    from derender.document import read_document

    return read_document(path).made


def test_depths_out_of_a_camera_s_range_are_told(folder, tmp_path):
    depth = np.full((24, 32), 12000, np.uint16)  # tenths of millimetres, which no camera file says
    imageio.imwrite(tmp_path / "tenths.png", depth)
    arguments = (tmp_path / "tenths.png", "-o", tmp_path / "out")
    assert "12 m away" in infer(*arguments).stderr
    assert "m away" not in infer(*arguments, "--depth-scale", 0.1).stderr


def test_a_bare_image_by_jumps_ends_with_a_scene(tmp_path):
    """The whole command, few rounds: a folder that `show` reads, and the block where it stands."""
    from derender.cli.sample import command as sample
    from derender.cli.show import command as show

    (tmp_path / "block.yaml").write_text(BLOCK)
    assert CliRunner().invoke(sample, [str(tmp_path / "block.yaml"), "--seed", "1", "-o", str(tmp_path)]).exit_code == 0
    few = ["--method", "mcmc", "--warmup", 20, "--draws", 6, "--chains", 2, "-j", 1, "--seed", 1]
    result = infer(tmp_path / "sample_000.npz", *few, "-o", tmp_path / "out")
    assert "Traceback" not in result.stderr and "not to be trusted" in result.stderr  # six draws are too few
    shown = CliRunner().invoke(show, [str(tmp_path / "out"), "--json"], catch_exceptions=False)
    floor, block = json.loads(shown.stdout)["objects"]
    assert floor["type"] == "plane" and block["parent"] == floor["name"]
    np.testing.assert_allclose(sorted(block["size"]), [0.08, 0.1, 0.12], atol=0.02)  # sd 6 to 12 mm between draws
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["draws"] == 6 and not summary["trusted"] and (tmp_path / "out" / "report.html").exists()


def test_a_prior_of_materials_goes_with_a_film(tmp_path):
    """It is read before the film is followed, and is no prior of the scene."""
    np.save(tmp_path / "only_a_floor.npy", np.full((24, 32), 0.9))
    film = [tmp_path / "only_a_floor.npy", "--track", "--dynamics", "--prior", tmp_path / "prior.yaml", "-q"]
    (tmp_path / "prior.yaml").write_text("dynamics: {frction: {uniform: [0.1, 0.3]}}\n")
    with pytest.raises(DerenderError, match="prior.yaml, line 1, dynamics.frction: this key is unknown here"):
        infer(*film, "-o", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (tmp_path / "prior.yaml").write_text("dynamics: {friction: {uniform: [0.1, 0.3]}}\n")
    with pytest.raises(DerenderError, match="one frame shows no motion"):
        infer(*film, "-o", tmp_path / "out")
    np.save(tmp_path / "still_only.npy", np.full((24, 32), 0.9))
    with pytest.raises(DerenderError, match="nothing moves by itself"):
        infer(tmp_path / "still_only.npy", *film, "-o", tmp_path / "out")
    for given, spread in (([], FPS_SPREAD), (["--fps", 30], 0.0)):
        infer(tmp_path / "still_only.npy", film[0], "--track", "-q", *given, "-o", tmp_path / "out")
        assert json.loads((tmp_path / "out" / "track.json").read_text())["rate_spread"] == spread


def test_a_film_that_is_doubted_is_told_and_under_strict_no_success(tmp_path):
    """Its camera comes nearer to the floor, and nobody said that it moves."""
    (tmp_path / "film").mkdir()
    for t in range(3):
        np.save(tmp_path / "film" / f"frame_{t}.npy", np.full((24, 32), 0.9 - 0.05 * (t == 2)))
    arguments = [tmp_path / "film", "--track", "--fps", 30, "-q", "-o", tmp_path / "out"]
    told = infer(*arguments)
    assert told.return_value is None and "not to be trusted" in told.stderr and "--moving-camera" in told.stderr
    assert infer(*arguments, "--strict").return_value == 3
    said = json.loads((tmp_path / "out" / "track.json").read_text())
    assert not said["trusted"] and any("--moving-camera" in doubt for doubt in said["doubts"])
    assert "Not to be trusted" in (tmp_path / "out" / "report.html").read_text()


def test_one_image_together_with_itself_is_told(tmp_path):
    np.save(tmp_path / "only_a_floor.npy", np.full((24, 32), 0.9))
    twice = [tmp_path / "only_a_floor.npy"] * 2
    result = infer(*twice, "--together", "--poses", tmp_path / "none.json", "--quick", "-o", tmp_path / "out")
    assert "--together says nothing here: there is one image" in result.stderr
