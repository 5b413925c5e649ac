"""The commands that judge and show: as a person types them, on scenes and on a posterior made by hand."""

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from derender.camera.depth_file import write_depth
from derender.camera.intrinsics import Camera
from derender.cli import main, simulate
from derender.document import read_document, write_document
from derender.render.raycast.depth import render_depth
from derender.report.scene_json import scene_json
from derender.results.posterior import Posterior, StructurePosterior, load

SCENE = """derender: 1
camera: {fx: 60, fy: 60, cx: 31.5, cy: 23.5, width: 64, height: 48}
root: {position: [0, 0.1, 0.8], quat_wxyz: [0.5, 0.8660254037844386, 0, 0]}
objects:
  floor: {shape: plane, contact: {type: 6dof}}
  low: {shape: {type: cube, side: 0.10}, parent: floor, contact: {type: face-to-face, x: 0.02, y: 0.0, theta: 0}}
  top: {shape: {type: cube, side: 0.08}, parent: low, contact: {type: face-to-face, u: 0.5, v: 0.5, theta: 0}}
likelihood: {type: gaussian, sigma: 5 mm, blur: 0}
"""
CAMERA = Camera(60, 60, 31.5, 23.5, 64, 48)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A scene that stands, one that does not, and DIR with a posterior of which three draws in four stand."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stands.yaml").write_text(SCENE)
    (tmp_path / "falls.yaml").write_text(SCENE.replace("u: 0.5", "u: 0.05"))
    graph = read_document("stands.yaml").graph
    rng = np.random.default_rng(0)
    values = np.stack([np.where(np.arange(400) % 4 == 3, 0.05, 0.5), rng.normal(0.08, 0.001, 400)], axis=1)
    values = np.stack([values, values[::-1]])
    density = -((values[..., 1] - 0.08) ** 2) - (values[..., 0] - 0.5) ** 2
    part = StructurePosterior(graph, ("top.contact.u", "top.side"), values, density, density)
    (tmp_path / "out").mkdir()
    Posterior((part,), seed=5, command="derender infer x.npz").save("out/posterior.npz")
    write_document("out/scene.yaml", part.best()[0], camera=CAMERA)
    write_depth("out/observation.npz", render_depth(graph.solids(), CAMERA)[0], CAMERA)
    return tmp_path


def run(capsys, *arguments):
    """Return exit status, stdout and stderr."""
    with pytest.raises(SystemExit) as ended:
        main([*map(str, arguments)])
    captured = capsys.readouterr()
    return ended.value.code, captured.out, captured.err


def test_simulate_a_scene(capsys, folder):
    status, out, _ = run(capsys, "simulate", "stands.yaml")
    assert status == 0 and out.splitlines()[0] == "stands"
    status, out, _ = run(capsys, "simulate", "falls.yaml", "--json", "-o", "t.npz", "--duration", "1")
    found = json.loads(out)
    assert status == 0 and found["stable"] is False and found["p_stable"] == 0 and found["fallen"] == ["top"]
    assert found["displacement"]["top"] > 0.05 > found["displacement"]["low"]
    with np.load("t.npz", allow_pickle=False) as file:
        assert file["times"][-1] == pytest.approx(1, abs=0.01) and file["poses"].shape[1:] == (2, 4, 4)
        assert str(file["version"]) == found["version"]


def test_simulate_asks_both_engines_settles_and_makes_a_table(capsys, folder):
    scene = ("simulate", "falls.yaml", "--engine", "both", "--margin", "--forces", "--settle", "settled.yaml")
    status, out, err = run(capsys, *scene, "--json")
    found = json.loads(out)
    assert "no forces hold this scene" in err
    assert status == 0 and found["engines"] == {"statics": "falls", "mujoco": "falls"} and found["margin"] == 0
    assert list(found["first_moved"]) == ["top"] and found["p_verdict"]["falls"] == 1
    assert json.loads(run(capsys, "simulate", "settled.yaml", "--engine", "both", "--json")[1])["verdict"] == "stands"
    soon = run(capsys, "simulate", "falls.yaml", "--settle", "falling.yaml", "--duration", "0.2")[2]
    assert "not all is at rest after 0.2 s" in soon and "at rest" not in err
    standing = json.loads(run(capsys, "simulate", "stands.yaml", "--engine", "statics", "--forces", "--json")[1])
    assert standing["verdict"] == "stands" and standing["margin"] > 0.1 and len(standing["forces"]) == 2
    assert run(capsys, "simulate", "falls.yaml", "--engine", "statics")[1].splitlines()[0] == "falls: top"
    shaken = json.loads(run(capsys, "simulate", "stands.yaml", "--jitter", "2mm,1deg", "--until", "10%", "--json")[1])
    assert shaken["draws"] >= 10 and shaken["p_stable_error"] <= 0.1
    status, out, _ = run(capsys, "simulate", "stands.yaml", "falls.yaml", "--json")
    assert [json.loads(line)["verdict"] for line in out.splitlines()] == ["stands", "falls"]
    status, _, talk = run(capsys, "simulate", "stands.yaml", "missing.yaml", "-o", "t.csv")
    rows = (folder / "t.csv").read_text().splitlines()
    assert status == 1 and rows[0].startswith("scene,verdict") and len(rows) == 3 and "no such file" in rows[2]
    run(capsys, "simulate", "stands.yaml", "falls.yaml", "--jitter", "2mm,1deg", "--draws", "6", "-o", "t.csv")
    shaken, fell = csv.DictReader((folder / "t.csv").open())
    assert fell["draws"] == "6" and float(fell["p_verdict_falls"]) > 0.8 > 0.2 > float(shaken["p_verdict_falls"])
    assert float(fell["p_stable"]) + float(fell["p_verdict_settles"]) + float(fell["p_verdict_falls"]) == pytest.approx(
        1
    )
    assert fell["p_falls"].startswith("low=0.0") and " top=0.89" in fell["p_falls"]
    assert 0.0 < float(fell["p_verdict_settles_error"]) < float(fell["p_verdict_falls_error"]) < 0.2
    assert run(capsys, "simulate", "falls.yaml", "--animate", "fall.glb", "--duration", "0.3")[0] == 0
    assert b'"animations"' in (folder / "fall.glb").read_bytes()
    assert "of 3 draws stand" in run(capsys, "simulate", "stack", "--draws", "3")[1]
    talk = run(capsys, "simulate", "stack", "-n", "2", "--seed", "1", "--engine", "statics", "--until", "1%")[2]
    assert "warning: stack/sample_001: --until says nothing here" in talk
    for name in ("settled.yaml", "t.csv", "fall.glb"):
        (folder / name).unlink()


def test_simulate_the_scenes_that_are_drawn_from_a_prior(capsys, folder):
    asked = ("--jitter", "2mm,1deg", "--draws", "4", "--engine", "statics", "--seed", "1", "--json")
    status, out, _ = run(capsys, "simulate", "stack", "-n", "3", *asked)
    drawn = [json.loads(line) for line in out.splitlines()]
    assert status == 0 and [row["scene"] for row in drawn] == [f"stack/sample_{k:03d}" for k in range(3)]
    run(capsys, "sample", "stack", "-n", "3", "--seed", "1", "--no-images", "-o", "drawn")
    files = [json.loads(line) for line in run(capsys, "simulate", "drawn", *asked)[1].splitlines()]
    assert [{**row, "scene": ""} for row in drawn] == [{**row, "scene": ""} for row in files]
    assert len({row["margin"] for row in drawn}) > 1
    alone = run(capsys, "simulate", "stack", *asked)[1]
    assert json.loads(alone)["margin"] == drawn[0]["margin"]  # the first drawn, without -n, is that of `sample` too
    status, _, talk = run(capsys, "simulate", "stands.yaml", "-n", "3")
    assert status == 1 and "this is a scene, not a prior" in talk and "leave out -n" in talk
    shutil.rmtree("drawn")


def test_an_interrupted_table_keeps_the_scenes_so_far(capsys, folder, monkeypatch):
    one, told = simulate._one, []

    def interrupted(*arguments):
        told.append(arguments)
        if len(told) == 3:
            raise KeyboardInterrupt
        return one(*arguments)

    monkeypatch.setattr(simulate, "_one", interrupted)
    status, _, talk = run(capsys, "simulate", "stack", "-n", "5", "--engine", "statics", "-o", "table.csv")
    assert status == 130 and "the first 2 of 5 scenes" in talk
    assert len(list(csv.DictReader((folder / "table.csv").open()))) == 2


def test_a_settled_scene_keeps_how_its_images_come_about(capsys, folder):
    """It lost its noise and blur: an image of it was 22,800 nats less likely after settling."""
    run(capsys, "sample", "stack", "--seed", "1", "-o", "drawn")
    for scene in ("drawn/sample_000.yaml", "stack"):
        run(capsys, "simulate", scene, "--seed", "1", "--settle", "settled.yaml")
        kept = read_document("settled.yaml").likelihood
        assert kept is not None and kept == read_document("drawn/sample_000.yaml").likelihood
    shutil.rmtree("drawn")


def test_simulate_a_posterior(capsys, folder):
    found = json.loads(run(capsys, "simulate", "out", "--json", "--draws", "80", "--seed", "1")[1])
    # Three draws in four stand: of 80, 60 with a standard deviation of 3.9.
    assert found["stable"] is True and abs(found["p_stable"] - 0.75) < 4 * 3.9 / 80 and found["draws"] == 80
    assert json.loads((folder / "out" / "simulation.json").read_text())["p_stable"] == found["p_stable"]
    again = json.loads(run(capsys, "simulate", "out", "--json", "--draws", "80", "--seed", "1", "--jobs", "1")[1])
    assert again["p_stable"] == found["p_stable"]
    told = run(capsys, "simulate", "out", "--draws", "8")[1]
    k = json.loads((folder / "out" / "simulation.json").read_text())["draws_stable"]
    assert (
        f"P(stable) = {(k + 0.5) / 9:.3f} ± " in told and f": {k} of 8 draws stand, told as (k + 1/2) / (n + 1)" in told
    )
    for path, told in (("out/moves.gif", "moves.gif"), ("moves.gif", None)):  # the page shows its own only
        run(capsys, "simulate", "out", "--draws", "0", "--duration", "0.2", "--animate", path)
        assert json.loads((folder / "out" / "simulation.json").read_text())["animation"] == told


@pytest.mark.slow
def test_simulate_draws_an_animation(capsys, folder):
    from PIL import Image

    assert "nothing moves" in run(capsys, "simulate", "stands.yaml", "--animate", "x.gif", "--duration", "0.5")[2]
    status, _, talk = run(capsys, "simulate", "falls.yaml", "--animate", "fall.gif", "--duration", "0.5")
    assert "nothing moves" not in talk
    assert status == 0 and "wrote fall.gif" in talk
    with Image.open("fall.gif") as picture:
        assert picture.n_frames > 5 and picture.size[0] >= 320
        first = np.asarray(picture.convert("RGB"), float)
        picture.seek(picture.n_frames - 1)
        assert np.abs(np.asarray(picture.convert("RGB"), float) - first).mean() > 1


@pytest.mark.parametrize(
    "arguments",
    [
        ("simulate", "missing.yaml"),
        ("simulate", "stands.yaml", "--animate", "x.txt"),
        ("simulate", "stands.yaml", "-o", "x.txt"),
        ("simulate", "empty"),
        ("simulate", "stands.yaml", "--push", "top:+x"),
        ("simulate", "stands.yaml", "--remove", "nobody"),
        ("simulate", "stands.yaml", "--engine", "statics", "--settle", "x.yaml"),
        ("simulate", "stands.yaml", "falls.yaml", "--animate", "x.gif"),
        ("simulate", "stands.yaml", "--animate", "x.mp4"),
        ("export", "stands.yaml", "-o", "x.fbx"),
        ("report", "missing"),
        ("report", "stands.yaml", "-o", "page.txt"),
        ("report", "stands.yaml", "falls.yaml"),
        ("eval", "stands.yaml", "missing.yaml"),
        ("eval", ".", "stands.yaml"),
        ("eval", "out", "stands.yaml", "--frame", "3"),
        ("eval", "out", "stands.yaml", "--divisor", "10"),
        ("export", "stands.yaml", "-o", "stands.yaml/scene.glb"),
    ],
)
def test_faults_are_one_line_and_leave_nothing(arguments, capsys, folder, monkeypatch):
    monkeypatch.setattr("shutil.which", lambda name: None)  # no ffmpeg
    (folder / "empty").mkdir(exist_ok=True)
    before = sorted(folder.rglob("*"))
    status, out, talk = run(capsys, *arguments)
    assert status == 1 and out == "" and len(talk.strip().splitlines()) == 1 and "Traceback" not in talk
    assert sorted(folder.rglob("*")) == before


def test_eval_of_files(capsys):
    found = json.loads(run(capsys, "eval", "stands.yaml", "stands.yaml", "--json")[1])
    assert found["total"]["f1@0.9"] == 1 and found["total"]["graph_exact"] == 1 and found["total"]["stable"] == 1
    status, out, _ = run(capsys, "eval", "out", "falls.yaml")
    # The lower cube is as in the truth, the upper one 8 cm away: half of the objects at every overlap.
    assert status == 0 and "missed: top" in out and "F1 @ 0.75" in out and "0.500" in out


def test_eval_of_folders_json_and_label_images(capsys, folder):
    from PIL import Image

    for name in ("predicted", "truth"):
        (folder / name).mkdir()
    graph = read_document("stands.yaml").graph
    (folder / "predicted" / "a.json").write_text(json.dumps(scene_json(graph)))
    (folder / "predicted" / "b.yaml").write_text(SCENE)
    (folder / "truth" / "a.yaml").write_text(SCENE)
    label = render_depth(graph.solids(), CAMERA)[1]
    Image.fromarray(((label + 1) * 10).astype(np.uint8)).save("truth/b.png")
    options = ("--divisor", "10", "--background", "0,1", "--json")
    found = json.loads(run(capsys, "eval", "predicted", "truth", *options)[1])
    assert [scene["name"] for scene in found["scenes"]] == ["a", "b"]
    assert found["total"]["mask_f1"] == 1 and found["total"]["edge_f1"] == 1
    # The floor counts as an object in the label image unless it is said to be background.
    found = json.loads(run(capsys, "eval", "predicted", "truth", "--divisor", "10", "--json")[1])
    assert found["total"]["mask_f1"] == pytest.approx(2 * 2 / (2 + 3))


def test_report_of_one_and_of_several(capsys, folder):
    status, out, talk = run(capsys, "report", "out")
    assert status == 0 and "wrote out/report.html" in talk and "top.contact.u" in out
    text = (folder / "out" / "report.html").read_text()
    assert "residual" in text and "seed 5" in text and "2 chains of 400 draws" in text
    again = ("report", "out", "again", "-o", "pages/both.html")
    shutil.copytree("out", "again")
    status, _, talk = run(capsys, *again)  # as two runs with the same seed: their chains counted twice
    assert status == 1 and "again: its chains are those of out again: the seed is the same" in talk
    posterior = load("out")
    part = posterior.best_part
    replace(posterior, parts=(replace(part, values=part.values[:, ::-1] + 1e-6),)).save("again/posterior.npz")
    run(capsys, *again)
    assert "4 chains of 400 draws" in (folder / "pages" / "both.html").read_text()
    _, _, talk = run(capsys, "report", "out", "again")  # which overwrote the page about the first
    assert "wrote out/report_together.html" in talk and (folder / "out" / "report.html").read_text() == text
    write_depth("again/observation.npz", np.ones((48, 64)), CAMERA)
    status, _, talk = run(capsys, *again)  # whose chains were told to disagree
    assert status == 1 and "out, again: these were not inferred from the same image" in talk
    status, out, _ = run(capsys, "report", "stands.yaml")
    assert status == 0 and out == "" and "explained depth" in (folder / "stands.html").read_text()


def test_export_without_a_file_is_misused(capsys, folder):
    status, _, talk = run(capsys, "export", "stands.yaml")
    assert status == 2 and "Missing option '-o'" in talk


def test_export_from_scene_and_folder(capsys, folder):
    for source in ("stands.yaml", "out"):
        status, _, talk = run(capsys, "export", source, "-o", "x.xml")
        assert status == 0 and "wrote x.xml" in talk and "<mujoco" in (folder / "x.xml").read_text()
