"""The page: self-contained, valid, and showing what it was given."""

import base64
import html.parser
import io
import json
import re
from types import SimpleNamespace

import numpy as np
import pytest

from derender.camera.intrinsics import Camera
from derender.render.raycast.depth import render_depth
from derender.report import pictures, svg, tables
from derender.report.contents import Report
from derender.report.html import page
from derender.report.result_folder import Outcome
from derender.report.tables import cells, parameter_rows, unit_of
from derender.report.tree_text import ToldStructure, scene_lines, structure_words
from derender.results import trust
from derender.scene.graph import Contact, SceneGraph, Vertex
from derender.scene.pose import rotation_x, rotation_z, translation
from derender.scene.solids import BOX, CYLINDER, PLANE, SPHERE, Solids

CAMERA = Camera(75, 75, 39.5, 29.5, 80, 60)
ROOT = translation(0, 0.1, 0.8) @ rotation_x(np.deg2rad(125))
NAMES = ["floor", "<box> & 1", "can", "ball", "cube"]


def demo_solids():
    poses = [
        np.eye(4),
        translation(0, 0, 0.04),
        translation(0.12, 0.05, 0.06),
        translation(-0.15, 0, 0.05),
        translation(0.01, 0, 0.11) @ rotation_z(0.7),
    ]
    sizes = np.array([[0, 0, 0], [0.1, 0.08, 0.08], [0.07, 0.07, 0.12], [0.1] * 3, [0.06] * 3])
    kind = np.array([PLANE, BOX, CYLINDER, SPHERE, BOX], np.int32)
    return Solids(kind, np.array([ROOT @ pose for pose in poses]), sizes, np.full(5, -1, np.int32))


@pytest.fixture(scope="module")
def report():
    solids = demo_solids()
    types = ["plane", "box", "cylinder", "sphere", "cube"]
    parents = ["root", "floor", "floor", "floor", NAMES[1]]
    scene = {
        "frame": "camera",
        "gravity": (ROOT[:3, :3] @ [0, 0, -1]).tolist(),
        "objects": [
            {
                "name": name,
                "type": kind,
                "size": None if kind == "plane" else solids.size[i].tolist(),
                "pose": solids.pose[i].tolist(),
                "parent": parent,
                "contact": {"type": "face-to-face", "parent_face": "+z", "child_face": "-z"},
                "probability": 0.75,
                "parent_probability": {parent: 0.5},
                "type_probability": {kind: 0.35, "thing": 0.65} if kind == "cube" else {kind: 1.0},
            }
            for i, (name, kind, parent) in enumerate(zip(NAMES, types, parents, strict=True))
        ],
    }
    rng = np.random.default_rng(0)
    depth, _ = render_depth(solids, CAMERA)
    depth += rng.normal(0, 0.002, depth.shape)
    depth[10:20, 10:20] = np.nan
    rows = tables.parameter_rows(["can.radius", "cube.contact.theta"], rng.normal(0.1, 0.01, (4, 200, 2)))
    structures = [ToldStructure(0.9, ".90", "a on b"), ToldStructure(0.1, ".10", "a floats")]
    return Report("test.npz", scene, solids, NAMES, CAMERA, depth, [solids], rows, structures, {"seed": 7})


class Checker(html.parser.HTMLParser):
    """Collects what a page opens, closes and refers to."""

    VOID = {"meta", "img", "input", "br", "link"}

    def __init__(self):
        super().__init__()
        self.stack, self.references, self.seen = [], [], []

    def handle_starttag(self, tag, attributes):
        self.seen.append(tag)
        self.references += [value for key, value in attributes if key in ("src", "href", "xlink:href", "data")]
        if tag not in self.VOID:
            self.stack.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.seen.append(tag)

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag


def test_of_a_second_structure_only_what_differs_is_told():
    vertices = [Vertex(name, "box", {}, "root", Contact("6dof")) for name in "abc"]
    graph = SceneGraph(np.eye(4), tuple(vertices))
    assert structure_words(graph) == "a (box) floats, b (box) floats, c (box) floats"
    other = graph.remove("c").replace("b", shape="cube").replace("a", contact=Contact("face-to-face", "+z", "-x"))
    assert structure_words(other, graph) == "the same, but a (box) floats, face-to-face -x on +z, b (cube) floats, no c"
    assert structure_words(graph, graph) == "the same"
    many = SceneGraph(np.eye(4), tuple(Vertex(f"box_{k}", "box", {}, "root", Contact("6dof")) for k in range(1, 13)))
    assert structure_words(many) == "box_1 ... box_12 (12 x box) floats"
    upwards = SceneGraph(np.eye(4), many.vertices[::-1])  # in no order of their names
    assert structure_words(upwards) == structure_words(many)
    assert structure_words(graph, many) == f"the same, but {structure_words(graph)}, no box_1 ... box_12 (12)"
    few = many.replace("box_3", shape="cube").remove("box_12")
    assert structure_words(few).startswith(
        "box_1 (box) floats, box_2 (box) floats, box_3 (cube) floats, box_4 ... box_11"
    )


def test_a_broad_scene_graph_lies_so_that_its_words_can_be_read():
    item = {"parent": "floor", "type": "box", "size": [0.1, 0.1, 0.1]}
    objects = [{"name": "floor", "type": "plane", "size": None}, *({"name": f"box_{n}", **item} for n in range(20))]
    picture = svg.graph_svg({"objects": objects})
    width, height = (float(word) for word in re.search(r'viewBox="0 0 (\d+) (\d+)"', picture).groups())
    assert width < 800 < height and picture.count("<rect") == 22


def test_words_fit_into_their_boxes():
    thing = {"name": "thing_1", "parent": "floor", "type": "thing", "size": [0.101, 0.102, 0.192], "probability": 0.97}
    long = {**thing, "name": "the_object_of_the_library_with_the_longest_name"}
    picture = svg.graph_svg({"objects": [{"name": "floor", "type": "plane", "size": None}, thing, long]})
    sizes = {words: float(size) for size, words in re.findall(r'font-size="([\d.]+)"[^>]*>([^<]+)<', picture)}
    assert sizes["thing_1"] == 13 and "thing 10.1 × 10.2 × 19.2 cm · p .97" in sizes
    assert all(0.56 * len(words) * size < 190 for words, size in sizes.items())  # of 196 that a box is wide


def test_what_the_posterior_predicts_is_shown_where_draws_tell_it(report):
    text = page(report)
    assert "<td class=number>.75</td>" in text and "p .75" in text and "p .50" in text
    single = tables.parameter_rows(["can.radius"], np.full((1, 1, 1), 0.1))
    text = page(report._replace(parameters=single, draws=[report.solids] * 2))
    assert "<td class=number>.75</td>" in text and "What the posterior predicts" not in text  # .75 as all others say it
    assert "Nothing speaks against this scene" in text


def test_the_picture_of_the_residual_is_of_the_misfit_beside_the_verdict(report):
    """A page said that the median misfit is 1.1 mm, and over its picture that it is 3.6 mm."""
    seen, background = report.observed, np.zeros(report.observed.shape, bool)
    background[:, :50] = True  # taken as it was seen: that fits whatever it is, and says nothing of the scene
    fit = SimpleNamespace(depth=np.where(background, seen, seen + 0.004), background=background, share=0.9,
                          noise=SimpleNamespace(sigma=0.001), predicted=seen)  # fmt: skip
    text = page(report._replace(fit=fit))
    assert "median misfit 4.0 mm" in text and "(median |r| 4.0 mm)" in text


def test_what_a_probability_counts_for_what_was_missed_is_told(report):
    told = {"verdict": "stands", "p_stable": 0.93}
    assert "P(stable) 0.930 (half of the .10 that" in page(report._replace(simulated=told | {"missed": 0.1}))
    for nothing in ({}, {"missed": 0.001}, {"missed": "x"}, {"p_stable_error": "x"}, {"p_stable_error": 0.0}):
        assert "P(stable) 0.930." in page(report._replace(simulated=told | nothing))
    drawn = told | {"p_stable": 0.9968, "p_stable_error": 0.0043}  # it was "P(stable) 1.00"
    assert "P(stable) 0.997 ± 0.004." in page(report._replace(simulated=drawn))


def test_page_is_well_formed_and_needs_no_network(report):
    text = page(report)
    checker = Checker()
    checker.feed(text)
    assert checker.stack == []
    assert all(reference.startswith("data:") for reference in checker.references)
    # No address of anything elsewhere but the name of SVG's own language.
    assert set(re.findall(r"https?://[^\"'\s)]+", text)) <= {"http://www.w3.org/2000/svg"}
    assert "url(" not in text and "import " not in re.sub(r"\s", " ", text.split("<script>")[1])


def test_page_shows_what_it_was_given(report):
    text = page(report)
    assert "&lt;box&gt; &amp; 1" in text and "<box>" not in text.split('id="scene-data"')[0]
    assert "seed 7" in text and "4 objects" in text and "p .75" in text and ".90<" in text
    assert text.count('aria-label="Trace of each chain"') == 2
    assert "can.radius (mm)" in text and "cube.contact.theta (°)" in text
    data = json.loads(re.search(r'id="scene-data">(.*?)</script>', text, re.S).group(1))
    assert len(data["solids"]) == 5
    points = np.frombuffer(base64.b64decode(data["points"]["positions"]), "<f4").reshape(-1, 3)
    # Every pixel with a return is a point, in the camera's frame: its z is its depth.
    valid = np.isfinite(report.observed)
    np.testing.assert_allclose(points[:, 2], report.observed[valid], rtol=1e-6)
    box = np.frombuffer(base64.b64decode(data["solids"][1]["vertices"]), "<f4").reshape(-1, 3)
    np.testing.assert_allclose(box.mean(axis=0), report.solids.pose[1, :3, 3], atol=1e-6)
    up = np.array(data["up"])
    assert up @ (ROOT[:3, 2]) == pytest.approx(1)


def test_a_type_that_is_open_is_told_with_its_probability(report):
    text = page(report)
    assert "<td>cube (p .35)</td>" in text and "<td>box</td>" in text
    assert svg.graph_svg(report.scene).count("cube (p .35)") == 1


def test_page_without_image_or_posterior(report):
    bare = report._replace(observed=None, draws=(), parameters=(), structures=())
    text = page(bare)
    checker = Checker()
    checker.feed(text)
    assert checker.stack == [] and "residual" not in text and "Trace" not in text
    no_camera = page(bare._replace(camera=None))
    assert "explained" not in no_camera and "scene-data" in no_camera
    assert page(bare._replace(scene=report.scene | {"objects": []}, solids=_none(), solid_names=[]))


def _none():
    return Solids(np.zeros(0, np.int32), np.zeros((0, 4, 4)), np.zeros((0, 3)), np.zeros(0, np.int32))


def test_paint_puts_ends_at_ends_and_holes_in_grey():
    values = np.array([[0.0, 1.0, 2.0, np.nan]])
    pixels = pictures.paint(values, 0.0, 2.0)
    ends = pictures.colour_table(pictures.DEPTH_ANCHORS)
    np.testing.assert_array_equal(pixels[0, 0], ends[0])
    np.testing.assert_array_equal(pixels[0, 2], ends[254])
    np.testing.assert_array_equal(pixels[0, 3], pictures.MISSING)
    middle = pictures.paint(np.array([[0.0]]), -1, 1, pictures.RESIDUAL_ANCHORS)[0, 0]
    assert middle.min() > 240, "no residual is white"


def test_a_painted_uri_holds_the_pixels_that_paint_returns():
    from PIL import Image

    values = np.linspace(-0.2, 2.2, 60).reshape(6, 10)
    values[2, 3] = np.nan
    data = base64.b64decode(pictures.painted_uri(values, 0.0, 2.0).partition(",")[2])
    read = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
    np.testing.assert_array_equal(read, pictures.paint(values, 0.0, 2.0))


def test_depth_limits_follow_the_objects():
    depth = np.full((10, 10), 5.0)
    depth[2:8, 2:8] = np.linspace(1.0, 1.3, 36).reshape(6, 6)
    objects = depth < 2
    low, high = pictures.depth_limits(depth, objects)
    assert low <= 1.02 and 1.28 <= high < 2
    assert pictures.depth_limits(np.full((2, 2), np.nan)) == (0.0, 1.0)


def test_graph_stands_on_its_root(report):
    text = svg.graph_svg(report.scene)
    heights = {
        name: float(y)
        for y, name in re.findall(r'y="([\d.]+)" text-anchor="middle" font-size="13"[^>]*>([^<]+)<', text)
    }
    assert heights["root"] > heights["floor"] > heights["can"] > heights["cube"]
    assert "sphere 10.0 cm" in text and "p .50" in text


def test_doubtful_chains_are_marked():
    rng = np.random.default_rng(2)
    good = rng.normal(size=(4, 400, 1))
    apart = good + np.arange(4)[:, None, None]
    assert not trust.doubtful(tables.parameter_rows(["a.x"], good)[0])
    assert trust.doubtful(tables.parameter_rows(["a.x"], apart)[0])
    lines = tables.parameter_table(
        tables.parameter_rows(["a.x", "b.contact.theta"], np.concatenate([good] * 2, axis=2))
    )
    assert len(lines.splitlines()) == 3 and "b.contact.theta (°)" in lines
    rows = tables.parameter_rows(["a.x", "b.x"], np.concatenate([good, apart], axis=2))
    outcome = SimpleNamespace(structures=lambda: ["p .93  a on floor"], report=SimpleNamespace(parameters=rows))
    told = Outcome.lines(outcome)  # type: ignore[arg-type]
    assert [(line.split()[0], doubt) for line, doubt in told] == [
        ("p", False), ("address", False), ("a.x", False), ("b.x", True)]  # fmt: skip


def test_of_a_single_draw_there_is_its_value_alone(report):
    rows = tables.parameter_rows(["a.x"], np.full((1, 1, 1), 0.5))
    assert tables.parameter_table(rows).split() == ["address", "value", "a.x", "0.5000"]
    text = page(report._replace(parameters=rows))
    assert "R-hat" not in text and "ranks" not in text and "Numbers of the most probable scene" in text


EMPTY = SimpleNamespace(vertices=())


def test_chains_that_died_are_told_of_what_is_read_again_too():
    posterior = SimpleNamespace(meta={"lost_chains": [1]}, best_part=SimpleNamespace(
        values=np.zeros((1, 2, 1)), extras={}, graph=EMPTY))  # fmt: skip
    assert trust.chain_doubts(posterior, []) == (trust.Doubt("1 of the chains died"),)


def test_populations_that_disagree_are_told():
    """However few draws the likeliest structure has."""
    part = SimpleNamespace(values=np.zeros((1, 2, 1)), extras={"log_evidence": [1.0, 9.0]}, graph=EMPTY)
    posterior = SimpleNamespace(meta={}, best_part=part)
    assert trust.chain_doubts(posterior, []) == (trust.Doubt("the populations' log evidences are 8.0 apart"),)


def test_chains_that_stay_with_different_structures_are_told():
    meta = {"structure_chains": {"shares": [1.0, 0.0], "r_hat": None}}
    posterior = SimpleNamespace(
        meta=meta, best_part=SimpleNamespace(values=np.zeros((2, 50, 1)), extras={}, graph=EMPTY)
    )
    (doubt,) = trust.chain_doubts(posterior, [])
    assert "the likeliest has 0.00 in one, 1.00 in another" in str(doubt)


def test_numbers_are_read_in_their_own_units():
    for address, unit in {
        "can.contact.lean": "°", "can.contact.roll": "°", "can.contact.theta": "°", "can.contact.gap": "mm",
        "can.contact.u": "", "can.contact.x": "mm", "can.contact.qw": "", "can.radius": "mm", "carton.scale": "",
        "root.distance": "mm", "root.elevation": "°", "root.qx": "", "likelihood.sigma": "mm", "likelihood.blur": "",
        "likelihood.sigma_growth": "1/m", "likelihood.outlier": "",
    }.items():  # fmt: skip
        assert unit_of(address)[0] == unit, address
    assert unit_of("can.contact.lean")[1] == pytest.approx(180 / np.pi) and unit_of("can.radius")[1] == 1000.0


def test_angles_are_shown_as_the_table_has_them():
    """As a prior has them, from 0 to 90 degrees or from -45; else on the first turn: a cube at 348 is one at 78."""
    floor = Vertex("floor", "plane", {}, "root", Contact("6dof"))

    def theta(shape, parameters, degrees):
        values = {"theta": np.radians(degrees), "x": 0.0, "y": 0.0}
        thing = Vertex("thing", shape, parameters, "floor", Contact("face-to-face", "+z", "-z", values))
        graph = SceneGraph(np.eye(4), (floor, thing))
        return next(line for line in scene_lines(graph) if "thing" in line)

    cube, box = ("cube", {"side": 0.1}), ("box", {"length": 0.1, "width": 0.2, "height": 0.1})
    address = "thing.contact.theta"
    for (shape, period), degrees, told in (((cube, 90), 78, 78), ((cube, 90), 348, 78), ((cube, 90), -12, -12),
                                           ((box, 180), 100, 100), ((box, 180), 348, 168)):  # fmt: skip
        assert f"theta {told:.1f} deg" in theta(*shape, degrees)
        rows = parameter_rows([address], np.full((1, 4, 1), np.radians(degrees)), {address: np.radians(period)})
        assert cells(rows[0])[1] == f"{told:.2f}"


def test_the_tree_of_a_stack_can_be_typed_in_again():
    """A quarter turn of the lower cube less is not seen, but what stands on it would stand elsewhere."""
    on = Contact("face-to-face", "+z", "-z", {"theta": np.radians(100), "x": 0.0, "y": 0.0})
    top = Contact("face-to-face", "+z", "-z", {"theta": np.radians(100), "u": 0.7, "v": 0.2})
    floor = Vertex("floor", "plane", {}, "root", Contact("6dof"))
    graph = SceneGraph(np.eye(4), (floor, Vertex("low", "cube", {"side": 0.1}, "floor", on),
                                   Vertex("top", "cube", {"side": 0.05}, "low", top)))  # fmt: skip
    told = {name: line for line in scene_lines(graph) for name in ("low", "top") if f"{name}  " in line}
    assert "theta 100.0 deg" in told["low"] and "theta 10.0 deg" in told["top"]
