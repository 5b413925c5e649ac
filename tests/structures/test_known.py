"""Known objects: the library's faults, identities and poses in made images, and on a real frame."""

import json
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from derender.camera.depth_file import read_depth
from derender.camera.intrinsics import Camera
from derender.detection.search.greedy import Settings
from derender.detection.solids.beliefs import bare_image
from derender.detection.solids.image import make_row
from derender.detection.solids.polish import FREE
from derender.detection.solids.state import Solid
from derender.errors import DerenderError
from derender.interface.functions import sample
from derender.render.blur import blur
from derender.report.tables import parameter_rows
from derender.results.trust import misleads
from derender.scene.pose import rotation_x, rotation_z, translation
from derender.scene.solids import BOX
from derender.structures.infer import infer_structure
from derender.structures.known.identities import Placed, Placement, identity_probabilities
from derender.structures.known.library import read_library
from derender.structures.known.posterior import enough, likeliest, names_of
from derender.structures.options import Options
from worlds.made_scenes import render_floor_scene

LIBRARY = """
known:
  brick: {type: box, length: 12 cm, width: 8 cm, height: 5 cm}
  die: {type: cube, side: 6 cm}
  tin: {type: cylinder, radius: 3.5 cm, height: 10 cm, count: 1}
"""
REAL = Path(os.environ.get("DERENDER_REAL", Path(__file__).resolve().parents[3] / "shared" / "real")) / "ycbv"


def library(tmp_path, text=LIBRARY):
    (tmp_path / "known.yaml").write_text(text)
    return tmp_path / "known.yaml"


def test_identities_and_ways_of_lying(tmp_path):
    floor = rotation_x(np.pi / 2 + np.radians(35))
    floor[:3, 3] = [0.0, 0.0, 0.8]
    camera = Camera(140.0, 140.0, 79.5, 59.5, 160, 120)
    on_edge = translation(-0.1, 0.0, 0.06) @ rotation_z(0.4) @ np.array(
        [[0, 1.0, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # fmt: skip
    poses = floor @ np.stack([on_edge, translation(0.08, 0.02, 0.05)])
    sizes = np.array([[0.12, 0.08, 0.05], [0.07, 0.07, 0.10]])
    depth, _ = render_floor_scene(["box", "cylinder"], poses, sizes, floor, camera)
    depth = depth + 0.001 * np.random.default_rng(0).normal(size=depth.shape)
    options = Options(known=library(tmp_path), draws=10, chains=1)
    posterior = infer_structure(depth, camera, options, np.random.default_rng(0))
    graph = posterior.best_graph()
    assert set(graph.names) == {"floor", "brick", "tin"}
    assert posterior.object_probability("brick") > 0.9 and posterior.object_probability("tin") > 0.9
    found = graph.poses()
    assert np.linalg.norm(found["brick"][:3, 3] - poses[0][:3, 3]) < 0.004
    assert np.linalg.norm(found["tin"][:3, 3] - poses[1][:3, 3]) < 0.004
    # the brick stands on its end: its length is upright
    assert abs(found["brick"][:3, 0] @ floor[:3, 2]) > 0.999
    assert not any(a.startswith("brick.") and "contact" not in a for a in posterior.best_part.addresses)
    assert "brick.contact.theta" in posterior.best_part.addresses
    assert "tin.contact.theta" not in posterior.best_part.addresses  # nothing tells how it is turned about itself
    part = posterior.best_part
    turns = part.values[..., part.addresses.index("brick.contact.theta")]
    assert 0.0 < turns.std() < np.radians(1.0) and np.isfinite(part.log_likelihood).all()


@pytest.mark.parametrize(("bigger", "name"), [(0.0, "brick"), (0.012, "box_1")])
def test_a_known_object_is_itself_in_a_reduced_image_that_is_blurred(tmp_path, bigger, name):
    """Blocks of a blurred image fit a box of any size tens of nats better than the known one that is there."""
    floor = rotation_x(np.pi / 2 + np.radians(40))
    floor[:3, 3] = [0.0, 0.0, 0.9]
    camera = Camera(280.0, 280.0, 159.5, 119.5, 320, 240)
    brick, other = np.array([0.12, 0.08, 0.05]) + bigger, np.array([0.07, 0.06, 0.08])
    poses = floor @ np.stack([translation(-0.1, 0.0, 0.5 * brick[2]) @ rotation_z(0.4), translation(0.1, 0.02, 0.04)])
    depth, _ = render_floor_scene(["box", "box"], poses, np.array([brick, other]), floor, camera)
    depth = blur(depth, 1.0) + 0.001 * np.random.default_rng(0).normal(size=depth.shape)
    options = Options(known=library(tmp_path), method="map", quick=True)
    posterior = infer_structure(depth, camera, options, np.random.default_rng(0))
    assert set(posterior.best_graph().names) == {"floor", name, "box_1" if name == "brick" else "box_2"}
    assert posterior.object_probability(name) > 0.9


@pytest.mark.parametrize("strange", [False, True])
def test_what_no_solid_beside_a_known_one_explains_is_told(tmp_path, strange):
    """A smooth heap was told as a cylinder and some boxes, and nothing spoke against them."""
    floor = rotation_x(np.pi / 2 + np.radians(40))
    floor[:3, 3] = [0.0, 0.0, 0.8]
    camera = Camera(140.0, 140.0, 79.5, 59.5, 160, 120)
    pose, size = floor @ translation(-0.1, 0.0, 0.025) @ rotation_z(0.4), np.array([[0.12, 0.08, 0.05]])
    depth, _ = render_floor_scene(["box"], pose[None], size, floor, camera)
    if strange:
        row, column = np.mgrid[:120, :160]
        depth -= 0.07 * np.exp(-0.5 * ((row - 70) ** 2 + (column - 115) ** 2) / 6.0**2)
    depth = depth + 0.001 * np.random.default_rng(0).normal(size=depth.shape)
    options = Options(known=library(tmp_path), draws=20, chains=1, quick=True)
    posterior = infer_structure(depth, camera, options, np.random.default_rng(0))
    assert "brick" in posterior.best_graph().names and bool(posterior.meta["spots"]) == strange


def test_a_stranger_is_turned_in_one_way_only(tmp_path):
    """Its length and width are no others after a quarter turn: chains that swap them disagree about all."""
    floor = rotation_x(np.pi / 2 + np.radians(40))
    floor[:3, 3] = [0.0, 0.0, 0.8]
    camera = Camera(140.0, 140.0, 79.5, 59.5, 160, 120)
    sizes = np.array([[0.09, 0.07, 0.08]])
    depth, _ = render_floor_scene(
        ["box"], floor[None] @ translation(0.0, 0.0, 0.04) @ rotation_z(0.4), sizes, floor, camera
    )
    depth = depth + 0.001 * np.random.default_rng(0).normal(size=depth.shape)
    options = Options(known=library(tmp_path), draws=60, chains=2)
    part = infer_structure(depth, camera, options, np.random.default_rng(0)).best_part
    drawn = part.values[..., part.addresses.index("box_1.length")]
    assert drawn.std() < 0.003 and min(abs(drawn.mean() - size) for size in sizes[0, :2]) < 0.003


def test_a_stranger_is_as_rare_as_the_file_says():
    """Odds of "none of these" against an object of the library go with those of the file, whatever pixels share."""
    solid = Solid(make_row(BOX, np.eye(3), np.array([0.0, 0.0, 0.05]), np.full(3, 0.1)), FREE, bottom=0.0)
    item, beliefs, odds = Placed(None, solid, 0), bare_image(), []
    for stranger in (0.05, 0.2):
        own = beliefs._replace(loose=replace(beliefs.loose, stranger=stranger))
        settings = Settings(beliefs=own).for_pixels(4.0)
        price = Placement.price_of_unknown(SimpleNamespace(settings=settings), solid)
        share = identity_probabilities([(settings.price, item), (price - 5.0, item)], settings.temper)
        odds.append(share[1] / share[0])
    assert odds[1] / odds[0] == pytest.approx((0.2 / 0.8) / (0.05 / 0.95))


def test_identities_of_several_objects_weigh_as_their_product():
    """Three objects that are what they seem at .9, .8 and .6: the sum over structures gives these again."""
    shares = [np.array([0.9, 0.1]), np.array([0.2, 0.8]), np.array([0.6, 0.3, 0.1])]
    found = likeliest(shares)
    total = sum(weight for _, weight in found)
    assert found[0] == ((0, 1, 0), 1.0) and len(found) == 12 and 1.0 / total == pytest.approx(0.9 * 0.8 * 0.6)
    for k, share in enumerate(shares):
        for number, p in enumerate(share):
            told = sum(weight for chosen, weight in found if chosen[k] == number) / total
            assert told == pytest.approx(p)
    many = likeliest([np.array([0.9, 0.1])] * 10)
    assert [weight for _, weight in many] == pytest.approx([1.0, *[1 / 9] * 10, *[1 / 81] * 13])


def test_what_stands_there_instead_has_a_name_of_its_own(tmp_path):
    brick, die, tin = read_library(library(tmp_path))
    solid = Solid(make_row(BOX, np.eye(3), np.zeros(3), np.ones(3)), FREE)
    of = [Placed(known, solid, 0) for known in (brick, brick, tin, None)]
    names = names_of(of)
    assert names == ["brick", "brick_2", "tin", "box_1"]
    assert names_of([of[2], *of[1:]], ["", *names[1:]]) == ["tin_2", "brick_2", "tin", "box_1"]
    assert names_of([of[0], of[3], *of[2:]], ["brick", "", *names[2:]]) == ["brick", "box_2", "tin", "box_1"]
    assert enough(of) and not enough([of[2], of[2]])  # one tin is all there is
    assert names_of([Placed(die, solid, 0), *of[1:]], ["", *names[1:]])[0] == "die"


@pytest.mark.parametrize(("text", "words"), [
    ("known: {}", "no objects"),
    ("derender: 1", "no objects"),
    ("known: {a: {type: boxx, length: 1}}", "did you mean"),
    ("known: {a: {type: box, length: 0.1, width: 0.1}}", "height"),
    ("known: {a: {type: plane}}", "no size"),
    ("known: {a: {type: cube, side: {uniform: [0.1, 0.2]}}}", "distribution"),
    ("known: {a: {type: cube, side: 60}}", "60 m long"),
    ("known: {a: {type: cube, side: 0.1, count: 0}}", "count"),
    ("known: {floor: {type: cube, side: 0.1}}", "cannot name"),
    ("known: {a: {type: mesh, file: nowhere.obj}}", "nowhere.obj"),
])  # fmt: skip
def test_each_fault_of_a_library_is_one_helpful_line(tmp_path, text, words):
    with pytest.raises(DerenderError) as caught:
        read_library(library(tmp_path, text))
    assert words in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.slow
@pytest.mark.skipif(not (REAL / "meshes").is_dir(), reason="the folder of real frames (DERENDER_REAL) is not here")
def test_four_groceries_by_their_meshes(tmp_path):
    from derender.scene.shapes.mesh import load_mesh

    meshes = sorted((REAL / "meshes").glob("*.obj"))
    text = "known:\n" + "".join(f"  ycb_{m.stem}: {{type: mesh, file: {m}}}\n" for m in meshes)
    seen = read_depth(REAL / "0001_000001_depth.png", REAL / "0001_000001_camera.json", None)
    options = Options(known=library(tmp_path, text), method="map")
    graph = infer_structure(seen.depth, seen.camera, options, np.random.default_rng(0)).best_graph()
    poses = graph.poses()
    assert set(graph.names) == {"floor", *(f"ycb_{m.stem}" for m in meshes)}
    for item in json.loads((REAL / "0001_000001_gt.json").read_text())["objects"]:
        box_from_file = load_mesh(REAL / "meshes" / f"{item['name']}.obj").box_from_file
        truth = np.vstack([item["pose_obj_to_cam_3x4"], [0, 0, 0, 1]]) @ np.linalg.inv(box_from_file)
        # the data set's own poses sit 4 to 13 mm under the table
        assert np.linalg.norm(poses[f"ycb_{item['name']}"][:3, 3] - truth[:3, 3]) < 0.012


def test_what_stands_on_a_cube_stands_where_it_was_placed(tmp_path):
    """A cube's turn was told within a quarter, and what stood on it went by axes a quarter turn off: a right tower had
    P < .01, and chains began there."""
    scene = sample("stack", seed=2)
    image = scene.render(noise=True)
    (tmp_path / "known.yaml").write_text("known:\n  brick: {type: cube, side: 10 cm}\n")
    options = Options(known=tmp_path / "known.yaml")
    quick = infer_structure(image.depth, image.camera, replace(options, method="map"), np.random.default_rng(1))
    assert quick.best_part.weight > 0.9 and len(quick.best_part.graph.names) == 4
    found, true = (
        sorted(tuple(each.poses()[vertex.name][:3, 3]) for vertex in each.vertices if vertex.shape != "plane")
        for each in (quick.best_graph(), scene.graph)
    )
    np.testing.assert_allclose(found, true, atol=2e-3)
    whole = infer_structure(image.depth, image.camera, options, np.random.default_rng(1))
    rows = parameter_rows(whole.best_part.addresses, whole.best_part.values)
    assert not any(map(misleads, rows))  # of 200 draws of each chain, which were all there were, R-hat was 1.15 to 1.2
    few = infer_structure(image.depth, image.camera, replace(options, draws=50, quick=True), np.random.default_rng(1))
    assert few.best_part.values.shape[1] == 50  # as many as were asked for
