"""derender render: formats by suffix, streams, noise, sensors, pictures, and faults."""

import io

import numpy as np
import pytest
from PIL import Image

from derender.camera.depth_file import read_depth
from derender.cli import main

SCENE = """derender: 1
camera: {fx: 60, fy: 60, cx: 31.5, cy: 23.5, width: 64, height: 48}
root: {position: [0, 0.1, 0.8], quat_wxyz: [0.5, 0.8660254037844386, 0, 0]}
objects:
  floor: {shape: plane, contact: {type: 6dof}}
  red:
    shape: {type: cube, side: 0.10}
    parent: floor
    contact: {type: face-to-face, parent_face: +z, child_face: -z, x: 0.02, y: 0.0, theta: 20 deg}
likelihood: {type: gaussian, sigma: 5 mm, blur: 0}
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene_a.yaml").write_text(SCENE)
    (tmp_path / "scene_b.yaml").write_text(SCENE.replace("x: 0.02", "x: -0.05"))
    return tmp_path


def run(*arguments):
    """Return the exit status of the command line."""
    with pytest.raises(SystemExit) as ended:
        main(["render", *map(str, arguments)])
    return ended.value.code


@pytest.mark.parametrize("suffix", [".npz", ".npy", ".tiff", ".exr", ".png"])
def test_every_suffix_holds_the_same_depth(suffix, folder):
    assert run("scene_a.yaml", "-o", f"d{suffix}") == 0
    assert run("scene_a.yaml", "-o", "reference.npz") == 0
    depth, reference = read_depth(f"d{suffix}").depth, read_depth("reference.npz").depth
    assert depth.shape == (48, 64)
    assert np.allclose(depth, reference, atol=0.0005001 if suffix == ".png" else 1e-6, equal_nan=True)


def test_of_a_file_that_holds_no_camera_it_says_where_that_is(folder, capsys):
    assert run("scene_a.yaml", "-o", "d.png") == 0 and run("scene_a.yaml", "-o", "d.npz") == 0
    assert capsys.readouterr().err == "wrote d.png (infer needs its camera: --camera scene_a.yaml)\nwrote d.npz\n"
    # Read with the scene's camera alone, each depth came back twice as large; and floats had no use for a scale.
    run("scene_a.yaml", "-o", "d.png", "--depth-scale", "0.5")
    assert "--camera scene_a.yaml --depth-scale 0.5)" in capsys.readouterr().err
    run("scene_a.yaml", "-o", "d.tiff", "--depth-scale", "0.5")
    assert "warning: --depth-scale says nothing here: depth is in metres" in capsys.readouterr().err


def test_several_scenes_go_to_several_files(folder):
    assert run("scene_a.yaml", "scene_b.yaml") == 0
    assert run("scene_a.yaml", "scene_b.yaml", "-o", "images/") == 0
    assert run("scene_a.yaml", "scene_b.yaml", "-o", "{}.npy") == 0
    names = {str(path.relative_to(folder)) for path in folder.rglob("*.np?")}
    assert names == {f"{name}.depth.npz" for name in ("scene_a", "scene_b", "images/scene_a", "images/scene_b")} | {
        "scene_a.npy",
        "scene_b.npy",
    }
    assert not np.array_equal(np.load("scene_a.npy"), np.load("scene_b.npy"))


def test_a_folder_of_results_is_a_scene(folder):
    (folder / "result").mkdir()
    (folder / "scene_a.yaml").rename(folder / "result" / "scene.yaml")
    assert run("result") == 0
    assert run("result/scene.yaml", "-o", "x/") == 0
    assert (folder / "result.depth.npz").is_file() and (folder / "x" / "result.depth.npz").is_file()


def test_the_stream_is_the_file(folder, capfdbinary):
    assert run("scene_a.yaml", "-o", "d.npz") == 0
    capfdbinary.readouterr()
    assert run("scene_a.yaml", "-o", "-") == 0
    streamed = np.load(io.BytesIO(capfdbinary.readouterr().out))
    assert np.array_equal(streamed["depth"], np.load("d.npz")["depth"])


def test_noise_comes_from_the_files_likelihood_and_the_seed(folder):
    for name, options in {
        "clean": (),
        "one": ("--noise", "--seed", 1),
        "same": ("--noise", "--seed", 1),
        "two": ("--noise", "--seed", 2),
    }.items():
        assert run("scene_a.yaml", "-o", f"{name}.npy", *options) == 0
    clean, one, same, two = (np.load(f"{name}.npy") for name in ("clean", "one", "same", "two"))
    assert np.array_equal(one, same) and not np.array_equal(one, two)
    # 5 mm; 3,072 pixels give its standard deviation to 1.3 %.
    assert np.std((one - clean)[clean > 0]) == pytest.approx(0.005, rel=0.06)


def test_a_sensor_may_be_a_scene_s_likelihood(folder):
    other = SCENE.replace("sigma: 5 mm", "sigma: 1 mm")
    (folder / "other.yaml").write_text(other)
    (folder / "bare.yaml").write_text(SCENE.split("likelihood")[0])
    assert run("bare.yaml", "-o", "clean.npz") == 0
    assert run("bare.yaml", "-o", "noisy.npz", "--sensor", "other.yaml") == 0
    difference = read_depth("noisy.npz").depth[24:] - read_depth("clean.npz").depth[24:]
    assert np.std(difference) == pytest.approx(0.001, rel=0.1)


def test_a_sensor_loses_pixels(folder):
    assert run("scene_a.yaml", "-o", "d.npz", "--sensor", "kinect") == 0
    assert 0 < np.isnan(read_depth("d.npz").depth).mean() < 0.3


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_picture_is_in_colour_and_large_enough_to_look_at(suffix, folder):
    assert run("scene_a.yaml", "--preview", "-o", f"p{suffix}") == 0
    with Image.open(f"p{suffix}") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    assert pixels.shape == (480, 640, 3)
    assert (pixels[..., 0] - pixels[..., 2] > 40).sum() > 500  # the red cube


def test_the_camera_on_the_command_line_wins(folder):
    (folder / "camera.json").write_text('{"fx": 30, "fy": 30, "cx": 15.5, "cy": 11.5, "width": 32, "height": 24}')
    assert run("scene_a.yaml", "--camera", "camera.json", "-o", "d.npz") == 0
    assert read_depth("d.npz").camera.fx == 30


def test_without_a_camera_it_says_what_it_takes(folder, capsys):
    (folder / "bare.yaml").write_text("\n".join(line for line in SCENE.splitlines() if not line.startswith("camera")))
    assert run("bare.yaml", "-o", "d.npz") == 0
    assert "60 degrees" in capsys.readouterr().err
    assert read_depth("d.npz").camera.field_of_view == pytest.approx(60)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("missing.yaml",), "missing.yaml"),
        (("scene_a.yaml", "-o", "d.jpg"), "no depth format"),
        (("scene_a.yaml", "-o", "d.npz", "--preview"), "not the name of a picture"),
        (("scene_a.yaml", "scene_b.yaml", "-o", "d.npz"), "the same file"),
        (("scene_a.yaml", "--renderer", "raycats"), "did you mean 'raycast'"),
        (("scene_a.yaml", "--sensor", "kinekt"), "did you mean 'kinect'"),
        (("scene_a.yaml", "--sensor", "no.yaml"), "no.yaml: there is no such file"),
        (("scene_a.yaml", "--sensor", "plain.yaml"), "plain.yaml: this scene has no likelihood"),
        (("scene_a.yaml", "--camera", "scene_c.json"), "scene_c.json"),
        (("prior.yaml",), "prior.yaml"),
    ],
)
def test_a_fault_is_one_line_and_leaves_nothing(arguments, message, folder, capsys):
    (folder / "prior.yaml").write_text(SCENE.replace("side: 0.10", "side: {uniform: [0.1, 0.2]}"))
    (folder / "plain.yaml").write_text(SCENE.split("likelihood")[0])
    before = set(folder.iterdir())
    assert run(*arguments) == 1
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert set(folder.iterdir()) == before


def test_a_folder_that_cannot_be_written_is_named(folder, capsys):
    (folder / "file").write_text("")
    assert run("scene_a.yaml", "-o", "file/d.npz") == 1
    error = capsys.readouterr().err
    assert "file" in error and error.count("\n") == 1


@pytest.mark.parametrize(
    "words, told",
    [
        ("render scene_a.yaml --preview --noise --antialias 2 -o picture.png", ["--noise", "--antialias"]),
        ("render scene_a.yaml --noise -o depth.npy", []),
        ("sample --no-images --no-noise", ["--no-noise"]),
        ("sample -o - --no-noise", ["--no-noise"]),
        ("simulate scene_a.yaml --engine statics --duration 1 --until 1%", ["--duration", "--until"]),
        ("simulate scene_a.yaml scene_b.yaml --engine statics --forces", ["--forces"]),
    ],
)
def test_options_that_say_nothing_here_are_told(words, told, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    lines = [line for line in capsys.readouterr().err.splitlines() if "says nothing here: " in line]
    assert not ended.value.code and sorted(line.split()[1] for line in lines) == sorted(told)
