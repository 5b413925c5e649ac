"""What `import derender` offers: its names, its examples, what it takes and what it refuses in words."""

import doctest
import importlib
import itertools
import json
import subprocess
import sys
import warnings
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import derender
from derender.camera.intrinsics import Camera
from derender.document import LikelihoodPrior
from derender.errors import DerenderError
from derender.report.tree_text import ToldStructure

MODULES = ("derender", "derender.camera.intrinsics", "derender.camera.depth_file", "derender.interface.functions",
           "derender.interface.scene", "derender.interface.functions",
           pytest.param("derender.interface.posterior", marks=pytest.mark.slow))  # fmt: skip


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_docstrings_run(name):
    found = doctest.testmod(importlib.import_module(name))
    assert found.attempted > 0 and found.failed == 0


def test_ten_names_and_no_others():
    assert sorted(derender.__all__) == sorted(
        "read_depth Camera DepthImage load sample render infer simulate Scene Posterior".split()
    )
    assert set(derender.PLACES) == {*derender.__all__, "DerenderError"}
    for name in derender.__all__:
        thing = getattr(derender, name)
        assert thing.__doc__ and (thing.__name__ == name)
    with pytest.raises(AttributeError, match="no attribute 'inference'"):
        derender.inference  # noqa: B018


def test_importing_imports_nothing_of_ours():
    code = "import sys, derender; print(sorted(m for m in sys.modules if m.startswith('derender')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "['derender']"


@pytest.fixture(scope="module")
def image():
    return derender.sample("stack", seed=0).render(derender.Camera.from_field_of_view(64, 48), noise=True)


@pytest.fixture(scope="module")
def posterior(image):
    return derender.infer(image, prior="stack", seed=1, draws=100, warmup=50)


@pytest.mark.parametrize("name", ["infer", "load", "read_depth", "render", "sample", "simulate"])
def test_a_wrong_keyword_says_what_was_meant(name):
    with pytest.raises(TypeError, match=rf"{name}\(\) has no keyword 'sead'; (did you mean 'seed'|choose from)"):
        getattr(derender, name)("tabletop", sead=1)


def test_what_is_taken_for_an_image(image, tmp_path):
    metres = np.where(np.isfinite(image.depth), image.depth, 0.0)
    np.save(tmp_path / "image.npy", metres.astype(np.float32))
    camera = image.camera
    given = {
        "a path": (tmp_path / "image.npy", camera),
        "a list of rows": (metres.tolist(), camera.matrix),
        "float32": (metres.astype(np.float32), camera.to_dict()),
        "uint16 millimetres": (np.round(1000 * metres).astype(np.uint16), camera),
    }
    for words, (thing, its_camera) in given.items():
        seen = derender.read_depth(thing, camera=its_camera)
        assert np.nanmax(abs(seen.depth - image.depth)) < 6e-4 and seen.camera == camera, words
    masked = np.ma.masked_less(metres, 0.7)
    np.testing.assert_array_equal(np.isnan(derender.read_depth(masked, camera).depth), masked.mask)
    tenths = np.round(10_000 * metres).astype(np.uint16)
    assert np.nanmax(abs(derender.read_depth(tenths, camera, 0.1).depth - image.depth)) < 6e-5


@pytest.mark.parametrize(
    "thing, words",
    [
        (np.full((48, 64), 900.0), "the median depth is 900 m.*depth_scale="),
        (np.zeros((48, 64, 3)), "48 x 64 x 3; this looks like a colour image"),
        (np.ones((48, 64), np.uint8), "8 bits a pixel are too coarse"),
        ([[1.0, 2.0], [1.0]], "the rows have different lengths"),
        (np.zeros((48, 64)), "no pixel has a depth"),
        ("missing.npy", "missing.npy: cannot read the depth image"),
        (derender.DepthImage(np.ones((9, 9)), derender.Camera(9, 9, 4, 4, 8, 9)), "is 9 x 9 pixels, its camera 8 x 9"),
        (derender.DepthImage(np.ones((1, 1)), derender.Camera(9, 9, 4, 4, 9, 6)), "is 1 x 1 pixels, its camera 9 x 6"),
        (["first.npy", "second.npy"], "these are several images"),
        ([derender.DepthImage(np.ones((9, 9)), None)] * 2, "these are several images"),
    ],
)
def test_what_is_refused_for_an_image(thing, words):
    with pytest.raises(DerenderError, match=words):
        derender.infer(thing)


@pytest.mark.parametrize(
    "call",
    [
        lambda: derender.infer({"depth": 1}),
        lambda: derender.infer(
            np.ones((9, 9)), camera=1
        ),  # once read from, and closed, the file of this number: stdout
        lambda: derender.infer(np.ones((9, 9)), shapes="box"),
        lambda: derender.infer(np.ones((9, 9)), quick="no"),
        lambda: derender.infer(np.ones((9, 9)), progress=3),
        lambda: derender.infer(np.ones((9, 9)), seed=None),
        lambda: derender.load(5),
        lambda: derender.render(None),
        lambda: derender.sample(np.eye(3)),
        lambda: derender.sample("stack", seed=-1),
        lambda: derender.simulate("stack", draws=-1),
        lambda: derender.simulate("stack", tilt=10),
        lambda: derender.Camera.from_file(1),
    ],
)
def test_an_argument_of_another_type_is_told_in_a_line(call):
    with pytest.raises(TypeError, match=r"^[a-z_]+\(\): [a-z]+ is .{1,60}; give .+$"):
        call()


def test_a_warning_is_about_the_line_that_called(image):
    with pytest.warns(UserWarning) as told:
        derender.infer(np.nan_to_num(image.depth), quick=True, chains=3)
    assert {Path(each.filename).name for each in told} == {"test_interface.py"}
    words = [str(each.message) for each in told]
    assert words[0].startswith("camera= is not given") and words[1].startswith("chains= says nothing here")


def test_a_warning_from_further_inside_is_about_that_line_too(image):
    """It named a line of the package, whatever the way from the caller to what warned."""
    twice = np.kron(np.nan_to_num(image.depth), np.ones((2, 2)))
    with pytest.warns(UserWarning, match="repeat") as told:
        derender.infer(twice, camera=derender.Camera.from_field_of_view(128, 96), quick=True)
    assert {Path(each.filename).name for each in told} == {"test_interface.py"}


def test_which_way_is_up_can_be_said_of_any_image(image):
    up = -np.asarray(derender.sample("stack", seed=0).poses["floor"])[:3, 2]
    seen = derender.infer(image, quick=True, up=-up).camera
    np.testing.assert_allclose(seen.gravity, up, atol=1e-12)
    assert derender.infer(np.nan_to_num(image.depth), camera=image.camera, quick=True, up="-y").camera.gravity == (
        0,
        1,
        0,
    )


def test_known_objects_are_a_mapping_or_those_of_a_scene(image):
    scene = derender.sample("stack", seed=0)
    entries = {name: {"type": "cube", "side": f"{100 * size[0]} cm"} for name, size in scene.sizes.items()}
    listed = [{**entry, "name": name} for name, entry in entries.items()]
    for known in (entries, listed, scene):
        found = derender.infer(image, known=known, only_known=True, quick=True).objects
        assert sorted(each.name for each in found) == ["green", "red", "yellow"]
    with pytest.raises(DerenderError, match="known, line 2, known.brick.lenght: this key is unknown here; did you"):
        derender.infer(image, known={"brick": {"type": "box", "lenght": 0.2}})
    with pytest.raises(TypeError, match="known is a list of what are no objects"):
        derender.infer(image, known=["mug.obj"])


def test_a_budget_is_a_time_as_on_the_command_line(image):
    derender.infer(image, budget="90s", draws=10, chains=1)


def test_numbers_of_other_libraries_are_numbers():
    camera = derender.Camera.from_field_of_view(np.int64(32), np.int32(24), np.float32(50.0))
    scene = derender.sample("stack", seed=np.uint8(1), camera=camera)
    assert scene.render(noise=False, seed=np.int16(2)).depth.shape == (24, 32)
    with pytest.raises(DerenderError, match="a field of view of 500 degrees"):
        derender.Camera.from_field_of_view(32, 24, 500)
    with pytest.raises(DerenderError, match="duration is 1000000000.0; give seconds, at most 3600"):
        scene.simulate(duration=1e9)


def test_a_depth_image_of_units_is_millimetres(image):
    units = derender.DepthImage(np.nan_to_num(1000 * image.depth).round().astype(np.uint16), image.camera)
    size = derender.infer(units, quick=True).objects[0].size
    assert 0.01 < size.min() <= size.max() < 0.5


def test_a_depth_image_made_of_lists_and_keys_is_one(image):
    """Its repr failed on rows, and inference on a mapping that Camera is made of, or on no camera, after the search."""
    depth = np.nan_to_num(image.depth).tolist()
    made = derender.DepthImage(depth, image.camera.to_dict())
    assert made._repr_html_().startswith('<div><img src="data:image/png;base64,') and "&lt;DepthImage: 64 x 48" in (
        made._repr_html_()
    )
    assert repr(made).startswith("<DepthImage: 64 x 48, 0")
    size = derender.infer(made, quick=True).objects[0].size
    np.testing.assert_array_equal(size, derender.infer(image, quick=True).objects[0].size)
    with pytest.warns(UserWarning, match="camera= is not given"):
        assert derender.infer(derender.DepthImage(depth, None), quick=True).camera.width == 64


def test_a_scene_is_seen_by_a_camera_or_its_file(tmp_path):
    scene, camera = derender.sample("stack", seed=0), derender.Camera.from_field_of_view(32, 24)
    (tmp_path / "camera.json").write_text(json.dumps(camera.to_dict()))
    for given in (camera, tmp_path / "camera.json", str(tmp_path / "camera.json")):
        assert scene.render(given).depth.shape == (24, 32)
    assert derender.sample("stack", seed=0, camera=tmp_path / "camera.json").camera == camera
    with pytest.raises(TypeError, match=r"render\(\): camera is 60.0; give Camera or text or Path or None"):
        scene.render(60.0)


def test_what_is_no_scene_is_told_by_what_would_be_right(tmp_path):
    scene = derender.sample("stack", seed=0)
    with pytest.raises(TypeError, match=r"render\(\) has no keyword 'nois'; did you mean 'noise'"):
        scene.render(nois=True)
    with pytest.raises(TypeError, match="has no keyword 'fov'; choose from degrees, height, width"):
        derender.Camera.from_field_of_view(32, 24, fov=50.0)
    for asked in (derender.simulate, derender.render):
        with pytest.raises(DerenderError, match="this is a prior, not a scene; draw a scene"):
            asked("tabletop")
    (tmp_path / "frame_7").mkdir()
    (tmp_path / "frame_7" / "posterior.npz").touch()
    with pytest.raises(DerenderError, match="there is no posterior here; name one, such as .*frame_7$"):
        derender.load(tmp_path)


def test_options_are_checked():
    with pytest.raises(TypeError, match=r"infer\(\): draws is 'many'; give a whole number from 0 up or None"):
        derender.infer(np.ones((48, 64)), draws="many")
    with pytest.raises(DerenderError, match="draws is 1000000000000; give a whole number from 1 to 1e"):
        derender.infer(np.ones((48, 64)), draws=10**12)
    with pytest.raises(DerenderError, match="this is no floor"):
        derender.infer(np.ones((48, 64)), floor=[0, 0, 1, "a"], camera=derender.Camera.from_field_of_view(64, 48))
    with pytest.raises(DerenderError, match="no method is called 'mcmcm'; did you mean 'mcmc'"):
        derender.infer(np.ones((48, 64)), method="mcmcm")
    with pytest.raises(DerenderError, match='method="smc" is for objects that are given; add prior=, or take method='):
        derender.infer(np.ones((48, 64)), method="smc", camera=derender.Camera.from_field_of_view(64, 48))
    with pytest.raises(DerenderError, match="budget is -1; give seconds"):
        derender.infer(np.ones((48, 64)), budget=-1)
    with pytest.raises(DerenderError, match="^budget=: '3 bananas' is no time; give one such as 30s, 2min or 1h"):
        derender.infer(np.ones((48, 64)), budget="3 bananas")
    with pytest.raises(DerenderError, match="^up=: 'above' is no direction; give x,y,z in camera axes"):
        derender.infer(np.ones((48, 64)), up="above", camera=derender.Camera.from_field_of_view(64, 48))
    with pytest.raises(TypeError, match="quick=True is method='map'"):
        derender.infer(np.ones((48, 64)), method="smc", quick=True)
    with pytest.raises(DerenderError, match="'bx' is no shape to look for; did you mean 'box'"):
        derender.infer(np.ones((48, 64)), shapes=["bx"], camera=derender.Camera.from_field_of_view(64, 48))


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("choose from stdin or --scene", "choose from stdin or prior="),
        ("nothing is known; give a library with --known FILE", "nothing is known; give a library with known="),
        ("the floor may be another: --floor=0,0.9,0.1,-1", "the floor may be another: floor=(0,0.9,0.1,-1)"),
        ("--push red:+x:0.5N@0.1s: no object", 'push="red:+x:0.5N@0.1s": no object'),
        ("--draws 400 would do", "draws=400 would do"),
        ("it may be a wall, see --up", "it may be a wall, see up="),
    ],
)
def test_options_of_commands_are_told_as_keywords(line, words):
    from derender.interface.words import in_python

    assert in_python(line) == words == in_python(words)


def test_faults_of_simulations_and_images_are_told_by_keywords(image, tmp_path):
    with pytest.raises(DerenderError, match='^tilt="10": the tilt is not'):
        derender.sample("stack", seed=0).simulate(tilt="10")
    (tmp_path / "image.yaml").write_text("derender: 1")
    with pytest.raises(DerenderError, match="prior= or camera= takes such a file"):
        derender.read_depth(tmp_path / "image.yaml")


def test_a_missing_camera_is_warned_of():
    with pytest.warns(UserWarning, match="taking 60 degrees"):
        derender.infer(np.full((48, 64), 0.9), quick=True)


def test_gravity_is_a_direction():
    camera = derender.Camera(60, 60, 31.5, 23.5, 64, 48, gravity=[0, 3, 4])
    assert camera.gravity == (0.0, 0.6, 0.8) and camera.downscaled(2).gravity == camera.gravity
    assert camera.to_dict()["gravity"] == [0.0, 0.6, 0.8]
    assert derender.read_depth(np.ones((48, 64)), camera.to_dict()).camera == camera
    for wrong in ([0, 0, 0], [1, 2], 3, [0, float("nan"), 1]):
        with pytest.raises(DerenderError):
            derender.Camera(60, 60, 31.5, 23.5, 64, 48, gravity=wrong)


def test_the_same_seed_is_the_same_posterior_as_on_the_command_line(image, tmp_path):
    from derender.camera.depth_file import write_depth
    from derender.structures.options import Options
    from derender.workflow import infer_to_folder

    write_depth(tmp_path / "image.npz", image.depth, image.camera)
    again = derender.infer(tmp_path / "image.npz", seed=1, quick=True)
    outcome = infer_to_folder(
        str(tmp_path / "image.npz"), Options(seed=1, method="map", quick=True), output=str(tmp_path / "out")
    )
    for part, other in zip(again.parts, outcome.posterior.parts, strict=True):
        np.testing.assert_array_equal(part.values, other.values)
    loaded = derender.load(tmp_path / "out")
    assert isinstance(loaded, derender.Posterior) and loaded.trusted == again.trusted is not None
    assert loaded.doubts == again.doubts
    np.testing.assert_allclose(loaded.image.depth, image.depth, atol=1e-6)


def test_a_floor_as_an_array_beside_a_scene_is_refused_in_a_line(image):
    with pytest.raises(DerenderError, match="floor= is for images without a scene; leave out floor= or prior="):
        derender.infer(image, prior="stack", floor=np.array([0.0, 1.0, 0.0, -0.5]))


def test_objects_and_structures(posterior):
    assert sum(structure.probability for structure in posterior.structures) == pytest.approx(1.0)
    assert posterior.structures[0].probability == max(structure.probability for structure in posterior.structures)
    names = [found.name for found in posterior.objects]
    assert names and names == ["green", "red", "yellow"] and "floor" not in names
    first = posterior.objects[names[0]]
    assert first.size.shape == first.size_error.shape == (3,)
    assert not first.size_error.any()  # the prior says how big they are
    assert first.pose.shape == (4, 4) and sum(first.parent_probability.values()) == pytest.approx(1.0)
    assert first.type_probability == {"cube": 1.0}
    assert first.trusted is (names[0] not in posterior.meta["in_doubt"])
    open_type = posterior.objects.__class__([first._replace(type_probability={"box": 0.65, "cube": 0.35})])
    assert "cube (p .35)" in repr(open_type) and "cube (p" not in repr(posterior.objects)
    pandas = pytest.importorskip("pandas")
    table = posterior.objects.to_pandas()
    assert isinstance(table, pandas.DataFrame) and list(table.name) == names and table.length[0] == first.size[0]
    assert table[["width_low", "width_high"]].loc[0].to_list() == first.size_interval[1].tolist()


def test_images_are_drawn_as_those_of_a_calibrated_camera(tmp_path):
    """What `calibrate` writes below `drawn:` was lost by infer: predicted images were off by ten times the noise."""
    noise = LikelihoodPrior("correlated", {"sigma": 0.001, "step": 0.0005, "white": 0.03}, {"outlier": 1e-5})
    scene = replace(derender.sample("stack", camera=Camera.from_field_of_view(64, 48)), likelihood=noise)
    (tmp_path / "prior.yaml").write_text(scene.to_yaml().replace("side: 0.1}", "side: {uniform: [0.05, 0.2]}}"))
    image = scene.render(noise=True, seed=1)
    derender.infer(image, prior=tmp_path / "prior.yaml", method="map").save(tmp_path / "posterior.npz")
    posterior = derender.load(tmp_path / "posterior.npz")
    assert posterior.best.likelihood == noise
    clean = posterior.best.render().depth
    seen, *drawn = (
        np.nanquantile(abs(each - clean), [0.5, 0.9])
        for each in (image.depth, posterior.predictive(1)[0], posterior.best.render(noise=True).depth)
    )
    np.testing.assert_allclose(drawn, [seen, seen], rtol=0.3)
    wrong = {"type": "gaussian", "sigma": 0.01, "drawn": {"outlier": 0.1}}
    with pytest.raises(DerenderError, match="a gaussian likelihood draws no field of noise"):
        replace(posterior, meta={**posterior.meta, "likelihood": wrong}).predictive(1)


def test_how_many_draws_are_simulated_is_judged_before_any(posterior):
    """Of no draws P was nan, an error below 0 was waited for without an end, and an unknown word was a trace."""
    with pytest.raises(TypeError, match=r"probability\(\) has no keyword 'engin'; did you mean 'engine'"):
        posterior.probability("stands", engin="statics")
    for wrong in ({"draws": -1}, {"draws": 2.5}, {"seed": -1}, {"until": "1%"}):
        with pytest.raises(TypeError, match=f"{next(iter(wrong))} is "):
            posterior.probability("stands", **wrong)
    for wrong, words in (
        ({"draws": 0}, "give draws from 1"),
        ({"until": -1.0}, "until is -1"),
        ({"jobs": 0}, "jobs is 0"),
    ):
        with pytest.raises(DerenderError, match=words):
            posterior.probability("stands", engine="statics", **wrong)
    with pytest.raises(DerenderError, match="jobs is 0; give a whole number from 1"):
        derender.simulate(derender.sample("stack"), jitter="2mm,1deg", engine="statics", jobs=0)


def test_scenes_and_images_are_drawn_from_the_posterior(posterior, image):
    scenes = posterior.sample_scenes(3, seed=5)
    assert [scene.names for scene in scenes] == [scene.names for scene in posterior.sample_scenes(3, seed=5)]
    drawn = posterior.predictive(4, seed=2)
    assert drawn.shape == (4, 48, 64)
    np.testing.assert_array_equal(drawn, posterior.predictive(4, seed=2))
    off = abs(drawn - image.depth)
    assert np.nanmedian(off) < 0.02 and np.nanmedian(abs(drawn[0] - drawn[1])) > 0.0  # noise is drawn too


def test_a_scene_goes_elsewhere(posterior, tmp_path):
    scene = derender.sample("stack", seed=0)
    mesh = scene.to_trimesh()
    bounds = mesh.geometry["yellow"].extents
    np.testing.assert_allclose(np.sort(bounds), np.sort(scene.sizes["yellow"]), rtol=1e-6)
    np.testing.assert_allclose(mesh.graph.get("yellow")[0], scene.poses["yellow"])
    assert ElementTree.fromstring(scene.to_mjcf()).tag == "mujoco"
    scene.save(tmp_path / "scene.yaml")
    scene.save(tmp_path / "scene.glb")
    with pytest.raises(DerenderError, match="choose from .*yaml"):
        scene.save(tmp_path / "scene.txt")
    assert derender.load(tmp_path / "scene.yaml").graph == scene.graph
    posterior.save(tmp_path / "kept")  # no suffix tells what it is
    assert derender.load(tmp_path / "kept").structures[0].words == posterior.structures[0].words
    assert scene.simulate(duration=0.1).poses.shape[1:] == (3, 4, 4)
    told = derender.simulate(posterior, duration=0.1, draws=4)
    assert scene.simulate(0.1, remove="yellow").names == ("green", "red")
    assert 0.0 <= told.p_stable <= 1.0 and set(told.displacement) == {found.name for found in posterior.objects}


def test_interventions_act_on_scenes_and_posteriors(posterior):
    scene = derender.sample("stack", seed=1)
    still, pushed = scene.simulate(0.5), scene.simulate(0.5, push=["green:+x:500N@0.3s"])
    assert still.verdict == "stands" and pushed.verdict == "falls" and "green" in pushed.fallen
    added = derender.simulate(scene, duration=0.1, add="lid:box:4x4x1cm@yellow", margin=True, engine="both")
    assert "lid" in added.names and 0.0 < added.margin < 1.0
    assert scene.simulate(0.5, tilt="60deg:+x").verdict == "falls"
    loose = derender.simulate(scene, duration=0.2, jitter="30mm,20deg", draws=6)
    assert loose.verdict == "stands" and loose.p_stable < 1.0 and loose.p_stable_error > 0.0
    chance = posterior.probability("green", push="green:+x:500N@0.3s", duration=0.3, draws=5)
    assert chance.draws == 5 and chance.probability == pytest.approx(5.5 / 6) and 0.0 < chance.error < 0.2
    assert posterior.probability(lambda outcome: outcome.stable, duration=0.2, until=0.2).draws == 10
    at_rest = derender.simulate(scene, engine="statics")
    assert at_rest.verdict == "stands" and at_rest.poses.shape[0] == 0
    with pytest.raises(DerenderError, match="no object is called 'gren'"):
        posterior.probability("falls", remove="gren", draws=1)
    with pytest.raises(TypeError, match="did you mean 'push'"):
        scene.simulate(0.1, pusch="green:+x:5N@0.3s")


def test_probabilities_of_the_three_verdicts_sum_to_one_and_are_those_of_simulate(posterior):
    """They summed to 1.06, and a scene without draws was counted as twenty of them."""
    words = ("stands", "settles", "falls")
    drawn = [posterior.probability(word, engine="statics", draws=8) for word in words]
    assert sum(chance.probability for chance in drawn) == pytest.approx(1.0) and drawn[0].draws == 8
    alone = derender.Posterior.of(replace(posterior, parts=(posterior.best_part.best_only(),)), posterior.image)
    assert not alone.uncertain
    said = derender.simulate(alone, engine="statics")
    once = [alone.probability(word, engine="statics") for word in words]
    assert sum(chance.probability for chance in once) == pytest.approx(1.0)
    assert once[0] == (said.p_stable, said.p_stable_error, 1)
    assert alone.probability("stands", engine="statics", jitter="5mm,2deg", draws=8).draws == 8


def test_what_could_not_stand_is_ruled_out(image):
    few = {"prior": "stack", "draws": 20, "warmup": 10, "assume_stable": True}
    stands = derender.sample("stack", seed=1).render(derender.Camera.from_field_of_view(64, 48), noise=True)
    stable = derender.infer(stands, **few)
    assert stable.probability("stands", engine="statics", draws=20).probability > 0.95
    assert 0 < stable.meta["p_stands_before"] <= 1
    with pytest.raises(DerenderError, match="assume_stable=: no draw of the posterior stands"):
        derender.infer(image, **few)


def test_notebooks_show_pictures_that_need_no_network(posterior):
    for thing in (posterior, posterior.best):
        page = thing._repr_html_()
        assert "data:image/png;base64," in page and "http" not in page
        assert all(found.name in page for found in posterior.objects)
    for trusted, words in ((True, "<b>trusted"), (False, "<b>not to be trusted")):
        judged = replace(posterior, meta={**posterior.meta, "trusted": trusted, "doubts": ["a < b"]})
        assert words in judged._repr_html_() and "<li>a &lt; b</li>" in judged._repr_html_()
    shown = repr(posterior.objects).splitlines()
    assert shown[0].startswith("object") and [line.split()[0] for line in shown[1:]] == [
        o.name for o in posterior.objects
    ]
    height, width = posterior.image.depth.shape
    assert repr(posterior.image).startswith(f"<DepthImage: {width} x {height}, ") and len(repr(posterior.image)) < 80


def test_plots_go_into_ones_own_axes(posterior):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3)
    for method, ax in zip(("plot_depth", "plot_sizes", "plot_structures"), axes, strict=True):
        assert getattr(posterior, method)(ax) is ax and ax.has_data()
    assert len(axes[1].get_xticklabels()) == len(posterior.objects)
    drawn = [bar.get_width() for bar in axes[2].patches]
    assert drawn == pytest.approx([each.probability for each in posterior.structures][: len(drawn)])
    assert posterior.best.plot_depth().has_data()
    largest = max(1000 * (found.size + found.size_error).max() for found in posterior.objects)
    assert axes[1].get_ylim() == (0, pytest.approx(1.1 * largest))  # no marker lies on the frame
    quick = replace(posterior, parts=(best_alone(posterior),))
    assert axes[1].get_ylabel() == "mm, 90 % range"
    assert quick.plot_sizes().get_ylabel() == "mm"  # a lone draw has no range
    plt.close("all")


def best_alone(posterior):
    """Return the best draw as a part whose sizes are unknown, as a quick look has it."""
    part = posterior.best_part.best_only()
    sides = tuple(f"{name}.side" for name in ("green", "red", "yellow"))
    return replace(part, addresses=sides, values=np.full((1, 1, 3), 0.1), periods=(None,) * 3)


@pytest.mark.parametrize(("wide", "high", "count"), [(6.4, 4.8, 1), (6.4, 4.8, 12), (3.0, 3.0, 2)])
def test_a_plot_of_structures_cuts_no_label(posterior, monkeypatch, wide, high, count):
    import matplotlib.pyplot as plt

    words = "a_box_with_a_long_name (box) on another_box, cylinder_12 (cylinder) on floor, thing_3 (thing) on floor"
    told = ToldStructure(0.93, ".93 (.88-.96)", words)
    monkeypatch.setattr("derender.interface.posterior.told_structures", lambda p: [told] * count)
    figure, axes = plt.subplots(figsize=(wide, high))
    posterior.plot_structures(axes)
    figure.canvas.draw()
    room, drawn = axes.get_window_extent(), [text.get_window_extent() for text in axes.texts]
    assert len(drawn) == count and all(" ".join(text.get_text().split()).endswith(words) for text in axes.texts)
    for above, below in itertools.pairwise(drawn):
        assert above.y0 > below.y1  # no two lie on each other
    for box in drawn:
        assert room.x0 <= box.x0 and box.x1 <= room.x1 and room.y0 <= box.y0 and box.y1 <= room.y1
    plt.close(figure)


def test_arviz_has_what_it_asks_for(posterior):
    """Leave-one-out, predictive plot and summary run on posterior.nc, of old ArviZ and of new."""
    arviz = pytest.importorskip("arviz")
    data = posterior.to_arviz()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        loo = arviz.loo(data)
        summary = arviz.summary(data)
        import matplotlib

        matplotlib.use("Agg")
        arviz.plot_ppc(data) if hasattr(arviz, "plot_ppc") else arviz.plot_ppc_dist(data)
    blocks = data["observed_data"]["depth"].shape[0]
    assert getattr(loo, "n_data_points", blocks) == blocks == 48
    assert np.isfinite(float(loo.elpd_loo if hasattr(loo, "elpd_loo") else loo.elpd))
    assert len(summary) == len(posterior.best_part.addresses)
    observed, predicted = data["observed_data"]["depth"].values, data["posterior_predictive"]["depth"].values
    assert predicted.shape[2:] == observed.shape and abs(predicted.mean((0, 1)) - observed).max() < 0.05


def test_the_netcdf_library_gives_each_group_its_own_dimensions(posterior, image, tmp_path):
    """ArviZ 1 opens the whole file with it: a dimension's number that two groups share is then the first one's."""
    netcdf = pytest.importorskip("netCDF4")
    from derender.results.predictive import blocks_of, write_netcdf

    blocks = blocks_of(posterior, image.depth, image.camera, np.random.default_rng(0))
    assert write_netcdf(tmp_path / "posterior.nc", posterior, blocks)
    chains, draws, _ = posterior.best_part.values.shape
    with netcdf.Dataset(tmp_path / "posterior.nc") as file:
        draw = file["posterior"].variables[posterior.best_part.addresses[0]].shape
        assert draw == file["sample_stats"]["lp"].shape == (chains, draws)
        assert file["observed_data"]["depth"].shape == (48,)
        assert file["log_likelihood"]["depth"].shape == (chains, len(blocks.scored), 48)


def test_blocks_of_a_bare_image_sum_to_what_was_drawn_under_or_are_left_out(tmp_path):
    """Faces are drawn about where the image shows them: blocks of those scenes were off by 80 nats and more."""
    from derender.results.predictive import MOST_APART, blocks_of

    image = derender.render(derender.sample("tabletop", seed=0), noise=True)
    found = derender.infer(image, seed=0)
    part = found.best_part

    def apart(posterior):
        blocks = blocks_of(posterior, image.depth, image.camera, np.random.default_rng(0))
        if blocks.log_likelihood is None:
            return None
        return np.std(blocks.log_likelihood.sum(-1) - part.log_likelihood[:, blocks.scored])

    assert apart(found) < MOST_APART
    found.save(tmp_path / "posterior.npz")
    np.testing.assert_array_equal(derender.load(tmp_path / "posterior.npz").best_part.apparent, part.apparent)
    lost = replace(found, parts=(replace(part, apparent=None), *found.parts[1:]))
    assert apart(lost) is None


def test_blocks_of_pixels_sum_to_the_log_likelihood_of_the_draws(posterior, image):
    """Every block's pixels are scored once: in an image without holes the blocks add up to what the chains saw."""
    from derender.results.predictive import blocks_of

    blocks = blocks_of(posterior, image.depth, image.camera, np.random.default_rng(0))
    part = posterior.best_part
    np.testing.assert_allclose(blocks.log_likelihood.sum(-1), part.log_likelihood[:, blocks.scored], rtol=1e-6)
