"""Input made to break things: one clear line, no traceback, no crash, and soon."""

import io
import json
import os
import re
import threading
import time
import warnings
import zipfile
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from small_scenes import TOWER, SceneWorld

from derender.atomic import make_folder
from derender.batch.frames import Order
from derender.batch.run import infer_frames
from derender.camera.camera_file import read_camera
from derender.camera.depth_file import read_depth
from derender.cli import group, status_of
from derender.cli.reading import read_explained, read_observation
from derender.document import read_prior_document
from derender.errors import LONGEST, DerenderError
from derender.evaluation.truth import read_json_scene
from derender.json_text import MOST_DEPTH, parse_json
from derender.report.scene_json import scene_json
from derender.results.posterior import Posterior, StructurePosterior, load
from derender.scene.shapes.mesh import load_mesh
from derender.structures.options import Options
from derender.workflow import infer_to_folder

MUTATIONS = int(os.environ.get("MUTATIONS", "60"))  # examples that hypothesis tries
DEEP = 100_000  # brackets
SOON = 5.0  # seconds: what was quadratic took minutes, so a busy machine cannot be mistaken for it


@pytest.mark.parametrize("opening", ["[", "{a: ", "- ", "? "])
def test_deep_yaml_is_one_line_soon(tmp_path, opening):
    path = tmp_path / "deep.yaml"
    path.write_text("derender: 1\nobjects: " + "\n"[: opening in "- ? "] + opening * DEEP)
    for read in (read_prior_document, read_camera):
        started = time.monotonic()
        with pytest.raises(DerenderError):
            read(path)
        assert time.monotonic() - started < SOON


@pytest.mark.parametrize("text", ["[" * DEEP, '{"a":' * DEEP, "[" * (MOST_DEPTH + 1) + "]" * (MOST_DEPTH + 1)])
def test_deep_json_is_one_line_everywhere(tmp_path, text):
    path = tmp_path / "deep.json"
    path.write_text(text)
    for read in (read_camera, read_json_scene):
        with pytest.raises(DerenderError):
            read(path)


def test_json_as_deep_as_allowed_is_read():
    text = "[" * MOST_DEPTH + "]" * MOST_DEPTH
    assert str(parse_json(text)).replace(" ", "") == text


def test_a_key_twice_in_json_is_told(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text('{"fx": 1, "fy": 1, "cx": 1, "cy": 1, "fx": 2}')
    with pytest.raises(DerenderError, match="'fx' stands twice"):
        read_camera(path, (4, 4))


IMPOSSIBLE = [({"fx": 1e308}, "field of view"), ({"fx": 1e-5}, "field of view"), ({"cx": 129.0}, "outside the image"),
              ({"cy": -49.0}, "outside the image")]  # fmt: skip


@pytest.mark.parametrize(("change", "told"), IMPOSSIBLE)
def test_impossible_intrinsics_are_told(tmp_path, change, told):
    path = tmp_path / "camera.json"
    numbers = {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5}
    path.write_text(json.dumps(numbers))
    assert read_camera(path, (48, 64)).cx == 31.5
    path.write_text(json.dumps(numbers | change))
    with pytest.raises(DerenderError, match=told):
        read_camera(path, (48, 64))


@pytest.mark.parametrize(("shape", "seen"), [((48, 2), 1.0), ((20, 640), 1.0), ((48, 64), 0.05)])
def test_an_image_of_few_pixels_is_inferred(tmp_path, shape, seen):
    """Narrower than any window that is searched for solids, and with no block of pixels that half returned."""
    known = np.random.default_rng(0).random(shape) < seen
    np.save(tmp_path / "image.npy", np.where(known, 0.9, np.nan).astype(np.float32))
    infer_to_folder(str(tmp_path / "image.npy"), Options(), output=str(tmp_path / "out"))
    assert (tmp_path / "out" / "summary.json").exists()


def test_thousands_of_folders_in_one_another_are_told(tmp_path):
    with pytest.raises(DerenderError, match="the folder cannot be made"):
        make_folder(tmp_path.joinpath(*"a" * 2000))


def test_a_link_to_itself_is_told(tmp_path):
    for name in ("out", "mesh.obj"):
        (tmp_path / name).symlink_to(tmp_path / name)
    np.save(tmp_path / "image.npy", np.full((24, 32), 0.9))
    with pytest.raises(DerenderError, match="the folder cannot be made"):
        infer_to_folder(str(tmp_path / "image.npy"), Options(method="map"), output=str(tmp_path / "out"))
    with pytest.raises(DerenderError, match="the folder cannot be made"):
        infer_frames([str(tmp_path)], tmp_path / "out", Order(), lambda *_: pytest.fail("begun"))
    (tmp_path / "scene.yaml").write_text("derender: 1\nobjects: {a: {shape: {type: mesh, file: mesh.obj}}}\n")
    with pytest.raises(DerenderError, match="cannot read the mesh"):
        read_prior_document(tmp_path / "scene.yaml")
    told = CliRunner().invoke(group, ["render", str(tmp_path / "out" / "scene.yaml")])
    assert isinstance(told.exception, DerenderError)


def test_standard_streams_are_no_frame_of_many_and_no_folder(tmp_path):
    (tmp_path / "frame.npy").write_bytes(b"")
    with pytest.raises(DerenderError, match="stdin is one image alone"):
        infer_frames([str(tmp_path / "frame.npy"), "-"], tmp_path / "out", Order(), lambda *_: pytest.fail("begun"))
    told = CliRunner().invoke(group, ["infer", "x.npy", "-o", "-"], prog_name="derender", standalone_mode=True)
    assert told.exit_code == 2 and "-o is a folder" in told.stderr


def test_a_camera_in_utf_16_is_read(tmp_path):
    (tmp_path / "camera.json").write_text('{"fx": 60, "fy": 60, "cx": 31, "cy": 23}', encoding="utf-16")
    assert read_camera(tmp_path / "camera.json", (48, 64)).fx == 60.0


SCENE = """derender: 1
camera: {{fx: 50, fy: 50, cx: 15.5, cy: 11.5, width: 32, height: 24}}
objects:
  floor: {{shape: plane, contact: {{type: 6dof}}}}
  red: {{shape: {shape}, {more}parent: floor, contact: {{type: face-to-face, x: 0.0, y: 0.0, theta: 0}}}}
"""


@pytest.mark.parametrize(("shape", "more", "told"), [
    ("{type: cube, side: 1.0e-300}", "", "lengths lie between"),
    ("{type: cube, side: 1.0e+300}", "", "lengths lie between"),
    ("{type: cube, side: 0}", "", r"lies in \(0, inf\)"),
    ("{type: cube, side: 0.1}", "mass: 1.0e+300, ", "out of range"),
    ('{type: mesh, file: "a\\0b.obj"}', "", "null character"),
])  # fmt: skip
def test_numbers_beyond_computation_are_told(tmp_path, shape, more, told):
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE.format(shape=shape, more=more))
    with pytest.raises(DerenderError, match=told):
        read_prior_document(path)


def test_a_camera_that_is_null_is_told_what_to_write(tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_text("derender: 1\ncamera: null\nobjects:\n  floor: {shape: plane, contact: {type: 6dof}}\n")
    with pytest.raises(DerenderError, match="write {fx: .* or the name of a camera file, or leave camera out"):
        read_prior_document(path)


def test_a_version_without_quotes_is_text(tmp_path):
    """As other writers of YAML leave it when they have read and written a scene."""
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE.format(shape="{type: cube, side: 0.1}", more="") + "made: {version: 0.1.0}\n")
    assert read_prior_document(path).made == {"version": "0.1.0"}


def test_a_folder_that_cannot_take_results_is_told_before_they_are_computed(tmp_path, monkeypatch):
    image = tmp_path / "image.npy"
    np.save(image, np.ones((8, 8)))
    monkeypatch.setattr("derender.workflow.answer", lambda *_: pytest.fail("it was computed"))
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=64_000, total=10**9))
    with pytest.raises(DerenderError, match="the disk is full: 0.1 of the 2 MB"):
        infer_to_folder(str(image), Options(), output=str(tmp_path))
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=64_000_000, total=10**9))
    monkeypatch.setattr("os.access", lambda path, mode: False)  # root may write to any folder but on such a disk
    with pytest.raises(DerenderError, match="cannot be written to"):
        infer_to_folder(str(image), Options(), output=str(tmp_path))


def test_a_tower_of_1500_is_shown(tmp_path):
    from derender.report.tree_text import scene_lines

    text, below = SCENE.format(shape="{type: cube, side: 0.01}", more=""), "red"
    for number in range(1500):
        contact = "{type: face-to-face, parent_face: +z, child_face: -z, u: 0.5, v: 0.5, theta: 0}"
        text += f"  c{number}: {{shape: {{type: cube, side: 0.01}}, parent: {below}, contact: {contact}}}\n"
        below = f"c{number}"
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    graph = read_prior_document(path).prior.sample(np.random.default_rng(0))
    assert sum("cube" in line for line in scene_lines(graph)) == 1501


def test_an_error_is_a_short_line_without_control_characters():
    line = str(DerenderError("a \x1b[31m \u202e\n name", "x" * 5000, "r" * 5000))
    assert line.isprintable() and len(line) < 3 * (LONGEST + 10)


def test_meshes_beyond_limits_are_told(tmp_path, monkeypatch):
    path = tmp_path / "mesh.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n")
    assert len(load_mesh(path).triangles) == 4
    path.write_text("v nan 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n")
    with pytest.raises(DerenderError, match="finite|flat"):
        load_mesh(path)
    for far in ("1e22", "1e305"):
        path.write_text(f"v {far} 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n")
        with pytest.raises(DerenderError, match="too far away"), warnings.catch_warnings(action="error"):
            load_mesh(path)
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(DerenderError, match="flat"):
        load_mesh(path)
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n# again\n")
    monkeypatch.setattr("derender.scene.shapes.mesh.MOST_TRIANGLES", 3)
    with pytest.raises(DerenderError, match="triangles"):
        load_mesh(path)
    with pytest.raises(DerenderError, match="null"):
        load_mesh("a\0b.obj")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes have names here")
@pytest.mark.parametrize("name", ["scene.yaml", "posterior.npz", "observation.npz", "simulation.json"])
def test_a_pipe_among_results_is_told(tmp_path, saved, name):
    (tmp_path / "posterior.npz").write_bytes(saved[0])
    (tmp_path / "scene.yaml").write_text(TOWER)
    (tmp_path / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / name)
    writer = threading.Thread(target=lambda: (tmp_path / name).open("wb").close(), daemon=True)
    writer.start()  # so that who opens it does not wait for ever
    done = CliRunner().invoke(group, ["view", str(tmp_path), "--no-open"])
    assert str(done.exception).startswith(f"{tmp_path / name}: this is no file"), done.exception


def test_a_tiff_of_several_pages_is_told(tmp_path):
    path = tmp_path / "pages.tiff"
    page = Image.fromarray(np.ones((4, 6), np.float32))
    page.save(path, save_all=True, append_images=[page])
    with pytest.raises(DerenderError, match="2 pages"):
        read_depth(path)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """The bytes of a small posterior.npz, and its members."""
    world, rng = SceneWorld(TOWER), np.random.default_rng(0)
    values = np.array([[world.space.sample(rng) for _ in range(3)] for _ in range(2)])
    density = rng.standard_normal((2, 3))
    part = StructurePosterior(world.template, world.space.addresses, values, density, density, 1.0, world.space.periods)
    path = tmp_path_factory.mktemp("posterior") / "posterior.npz"
    Posterior((part,), 3, "derender infer x").save(path)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    return path.read_bytes(), members


def is_told(folder, data):
    (folder / "posterior.npz").write_bytes(data)
    try:
        load(folder)
    except DerenderError as error:
        return "not a posterior" in str(error)
    return False


def with_header(members, change):
    header = json.loads(bytes(np.load(io.BytesIO(members["header.npy"]))))
    change(header)
    stream = io.BytesIO()
    arrays = {name.removesuffix(".npy"): np.load(io.BytesIO(data)) for name, data in members.items()}
    np.savez(stream, **(arrays | {"header": np.frombuffer(json.dumps(header).encode(), np.uint8)}))
    return stream.getvalue()


def rewritten(old, new):
    """Return a change of the first structure's scene."""

    def change(header):
        part = header["parts"][0]
        part["scene"], count = re.subn(old, new, part["scene"], count=1)
        assert count

    return change


HEADERS = {
    "format": lambda h: h.update(format=99),
    "no parts": lambda h: h.update(parts=[]),
    "meta": lambda h: h.update(meta=3),
    "seed": lambda h: h.update(seed="x"),
    "a number of the likelihood": lambda h: h["parts"][0]["extras"].update(likelihood={"sigma": {}}),
    "views": lambda h: h["meta"].update(views=[{"image": "x"}]),
    "existence": lambda h: h["meta"].update(existence={"red": [0.5, float("inf")]}),
    "an error": lambda h: h["parts"][0].update(weight_interval=[None, 1.0]),
    "weight nan": lambda h: h["parts"][0].update(weight=float("nan")),
    "weight above one": lambda h: h["parts"][0].update(weight=1.5),
    "address": lambda h: h["parts"][0]["addresses"].__setitem__(0, "nobody.side"),
    "address twice": lambda h: h["parts"][0]["addresses"].__setitem__(0, h["parts"][0]["addresses"][1]),
    "periods": lambda h: h["parts"][0].update(periods=[1.0]),
    "names": lambda h: h["parts"][0]["objects"].__setitem__(0, "\u202e\x1b[31m"),
    "no text": lambda h: h["parts"][0].update(scene=3),
    "depth": lambda h: h["parts"][0].update(scene="[" * 100_000),
    "shape": rewritten("shape: plane", "shape: teapot"),
    "parent": rewritten(r"parent: \w+", "parent: nobody"),
    "contact": rewritten("type: 6dof", "type: glue"),
    "gravity": rewritten("objects:", "gravity: [0, 0]\nobjects:"),
    "root": rewritten("root: .*", "root: {pose: [[1]]}"),
    "open": rewritten(r"side: [\d.]+", "side: {uniform: [0.1, 0.2]}"),
}  # fmt: skip


@pytest.mark.parametrize("change", HEADERS.values(), ids=HEADERS)
def test_a_posterior_with_a_wrong_header_is_told(tmp_path, saved, change):
    assert not is_told(tmp_path, with_header(saved[1], lambda header: None))
    assert is_told(tmp_path, with_header(saved[1], change))


@pytest.mark.parametrize("bad", [np.zeros((2, 3)), np.full((2, 3), np.nan), np.zeros((2, 3), "U1"), np.zeros(0)])
def test_a_posterior_with_wrong_arrays_is_told(tmp_path, saved, bad):
    stream = io.BytesIO()
    arrays = {name.removesuffix(".npy"): np.load(io.BytesIO(data)) for name, data in saved[1].items()}
    np.savez(stream, **(arrays | {"values_0": bad}))
    assert is_told(tmp_path, stream.getvalue())


@pytest.mark.parametrize("factor", [0.0, -1.0, 1e-200, 1e200])
def test_a_posterior_of_solids_without_a_size_is_told(tmp_path, saved, factor):
    """A draw whose side is 0 has no mass, by which `look` divided."""
    arrays = {name.removesuffix(".npy"): np.load(io.BytesIO(data)) for name, data in saved[1].items()}
    stream = io.BytesIO()
    np.savez(stream, **(arrays | {"values_0": factor * arrays["values_0"]}))
    assert is_told(tmp_path, stream.getvalue())


JUNK = st.one_of(st.none(), st.booleans(), st.integers(-3, 3), st.sampled_from([1e300, -1e-300, 10**400, float("nan")]),
                 st.sampled_from(["", "a.b", "floor", "box", "\x00", "x" * 300]),
                 st.sampled_from([[], [[]], {}, [1, 2, 3], {"a": 1}, [None], [["a"]]]))  # fmt: skip


def places_of(node):
    """Yield (collection, key) of every value of a tree."""
    for key in list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ():
        yield node, key
        yield from places_of(node[key])


def test_an_observation_of_another_tool_is_told(tmp_path):
    np.savez(tmp_path / "observation.npz", depth=np.ones((3, 3)))
    with pytest.raises(DerenderError, match="holds no camera"):
        read_observation(tmp_path)
    np.save(tmp_path / "explained.npy", np.ones((3, 4), np.float32))
    assert read_explained(tmp_path, (3, 3)) is None and read_explained(tmp_path, (3, 4)) is not None
    with open(tmp_path / "explained.npy", "wb") as file:  # of which only the header is there
        np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": (400_000,) * 2})
    assert read_explained(tmp_path, (400_000, 400_000)) is None


@settings(max_examples=MUTATIONS, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(which=st.floats(0, 1, exclude_max=True), junk=JUNK, gone=st.booleans())
def test_a_posterior_with_anything_in_its_header_is_read_or_told(tmp_path, saved, which, junk, gone):
    def change(header):
        places = list(places_of(header))
        node, key = places[int(which * len(places))]
        if gone:
            del node[key]
        else:
            node[key] = junk

    (tmp_path / "posterior.npz").write_bytes(with_header(saved[1], change))
    try:
        posterior = load(tmp_path)
    except DerenderError as error:
        assert "posterior" in str(error)
        return
    scene_json(posterior.best_graph(), posterior)  # what was read can be shown


@settings(max_examples=MUTATIONS, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=st.floats(0, 1, exclude_max=True), byte=st.integers(0, 255), cut=st.booleans())
def test_a_damaged_posterior_is_read_or_told(tmp_path, saved, place, byte, cut):
    data = bytearray(saved[0])
    at = int(place * len(data))
    damaged = bytes(data[:at]) if cut else bytes(data[:at] + bytes([byte]) + data[at + 1 :])
    (tmp_path / "posterior.npz").write_bytes(damaged)
    try:
        load(tmp_path)
    except DerenderError as error:
        assert "posterior" in str(error)


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["infer", "image.npy", "--depth-scale", "nan"], "nan is no finite number"),
        (["infer", "film", "--track", "--fps", "inf"], "inf is no finite number"),
        (["infer", "image.npy", "--fps", "30"], "--fps goes with --track"),
        (["simulate", "scene.yaml", "--duration", "nan"], "nan is no finite number"),
    ],
)
def test_numbers_that_are_none_and_options_that_would_do_nothing(arguments, words, capsys):
    assert status_of(lambda: group.main(arguments, standalone_mode=False)) == 2
    assert words in capsys.readouterr().err
