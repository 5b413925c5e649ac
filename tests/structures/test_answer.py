"""What is told of the structures that were found: their objects may be clutter."""

from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from small_scenes import read

from derender.camera.intrinsics import Camera
from derender.detection.solids.beliefs import bare_image
from derender.render.raycast.depth import render_depth
from derender.results.fit import BACKGROUND, explain
from derender.results.posterior import Posterior, StructurePosterior
from derender.scene.graph import ROOT, Contact
from derender.structures.answer import chances, shown_shares, with_absences
from derender.structures.parts import MOST_STRUCTURES

THREE = """
derender: 1
objects:
  floor: {shape: plane, contact: {type: 6dof}}
  low:   {shape: {type: cube, side: 0.1}, parent: floor, contact: {type: face-to-face, x: 0.0}}
  top:   {shape: {type: cube, side: 0.05}, parent: low, contact: {type: face-to-face, u: 0.5, v: 0.5}}
  left:  {shape: {type: cube, side: 0.05}, parent: floor, contact: {type: face-to-face, x: 0.3}}
  right: {shape: {type: sphere, radius: 0.05}, parent: floor, contact: {type: point-on-face, x: -0.3}}
"""
CHANCE = {"left": (0.9, 0.05), "right": (0.6, 0.1), "low": (0.7, 0.1)}


@pytest.fixture(scope="module")
def part():
    addresses = ("low.contact.x", "left.contact.x", "right.contact.x")
    values = np.random.default_rng(0).normal(0.0, 0.01, (2, 5, 3))
    return StructurePosterior(read(THREE).graph, addresses, values, np.zeros((2, 5)), np.zeros((2, 5)), 0.8,
                              weight_error=0.02, weight_interval=(0.76, 0.84))  # fmt: skip


def test_no_structure_is_likelier_than_its_objects(part):
    parts = with_absences([part], CHANCE, {}, {})
    expected = {(a, b): 0.8 * (0.9 if a else 0.1) * (0.6 if b else 0.4) for a, b in product((True, False), repeat=2)}
    told = {("left" in each.graph.names, "right" in each.graph.names): each for each in parts}
    assert {key: each.weight for key, each in told.items()} == pytest.approx(expected)
    assert parts == sorted(parts, key=lambda each: -each.weight)
    posterior = Posterior(tuple(parts), meta={"existence": CHANCE})
    for name in ("left", "right"):
        assert posterior.object_probability(name) == pytest.approx(CHANCE[name][0])
        assert posterior.object_probability_error(name) == pytest.approx(CHANCE[name][1], rel=0.3)
        there = sum(each.weight for each in parts if name in each.graph.names)
        assert there / 0.8 == pytest.approx(CHANCE[name][0])


def test_a_solid_that_free_forms_hide_but_for_a_sliver_is_rather_a_piece_of_these():
    """A bowl that was cut off had a cylinder in it that only its foot showed, at P .97."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = 0.0, 0.1, 0.8
    graph = replace(read(THREE).graph, root_pose=pose)
    camera = Camera(100.0, 100.0, 79.5, 59.5, 160, 120)
    depth, label = render_depth(graph.solids(), camera)
    left = label == graph.solid_names.index("left")
    nearer = left & (np.cumsum(left, axis=1) > 3)
    told = explain(graph, depth, camera)
    told.label[nearer] = told.names.index("right")
    assert shown_shares(graph, told, depth, camera)["left"] == 1.0  # what another solid hides says nothing
    told.label[nearer] = BACKGROUND
    shares = shown_shares(graph, told, depth, camera)
    assert set(shares) == {"low", "top", "left", "right"} and shares["left"] < 0.4
    assert shares["low"] == shares["top"] == shares["right"] == 1.0  # what stands on it says nothing against a solid
    believed = bare_image().loose.existence
    assert believed.shown_by(1.0)[0] > 0.99 and believed.shown_by(shares["left"])[0] < 0.5
    assert believed.shown_by(believed.shown) == (0.5, believed.error_at_even)


def test_a_structure_is_told_though_nothing_shows_one_of_its_objects(part):
    """Of a shelf's front all structures had a probability of 0, and the report failed."""
    parts = with_absences([part], {}, {"left": 0.0}, {})
    assert [each.graph for each in parts] == [part.graph] and 0.0 < parts[0].weight < 0.05


def test_a_free_form_thing_that_is_seldom_seen_where_it_should_be_is_not_told(part):
    """Beside a mug's silhouette a strip, likely by its nats, explained a fifth of what it covered: told, at P .12."""
    numbers = {"length": 0.05, "width": 0.05, "height": 0.05}
    free = replace(part, graph=part.graph.replace("left", shape="thing", parameters=numbers))
    parts = with_absences([free], {"left": (0.6, 0.1)}, {"left": 0.2}, {})
    assert [each.weight for each in parts] == pytest.approx([0.8 * 0.88, 0.8 * 0.12])
    assert "left" not in parts[0].graph.names and parts[0].extras["absent"] == ["left"]


def test_what_touches_nothing_is_seldom_an_object():
    """Of a bin's wall a sliver was a rod in the air, at P .99."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = 0.0, 0.1, 0.8
    graph = replace(read(THREE).graph, root_pose=pose)
    free = replace(graph.vertex("left"), parent=ROOT, contact=Contact("6dof", values={"x": 0.3, "z": 0.3}))
    graph = graph.remove("left").add(free)
    camera = Camera(100.0, 100.0, 79.5, 59.5, 160, 120)
    depth = render_depth(graph.solids(), camera)[0]
    beliefs, settings = bare_image(), SimpleNamespace(may_float=False)
    case = SimpleNamespace(beliefs=beliefs, depth=depth, camera=camera, settings=settings)
    told, usual = explain(graph, depth, camera), beliefs.loose.existence.hangs
    found = chances({"left": (0.9, 0.05)}, graph, told, case)
    assert found == {"left": (0.9 * usual, pytest.approx(0.9 * usual * (1.0 - usual), abs=0.01))}
    case.settings = SimpleNamespace(may_float=True)
    assert chances({}, graph, told, case) == {}


def test_what_bears_something_stays_and_so_do_the_draws_of_all(part):
    parts = with_absences([part], CHANCE, {}, {})
    assert all("low" in each.graph.names and "top" in each.graph.names for each in parts)
    whole = parts[0]
    assert whole.graph == part.graph and whole.values.shape == part.values.shape
    for each in parts[1:]:
        assert {address.partition(".")[0] for address in each.addresses} <= set(each.graph.names)
        assert each.values.shape[:2] == (1, 1) and each.extras["absent"]


def test_an_error_of_existence_is_one_of_the_structure(part):
    whole = with_absences([part], CHANCE, {}, {})[0]
    relative = np.linalg.norm([0.02 / 0.8, 0.05 / 0.9, 0.1 / 0.6])
    assert whole.weight_error / whole.weight == pytest.approx(relative)
    assert whole.weight_interval[0] < whole.weight - 0.1 and whole.weight_interval[1] > whole.weight + 0.1


def test_an_object_whose_shape_is_open_is_told_where_it_is_likelier_than_not(part):
    """Three shapes of one object, likely to exist: without it all three are one structure, the likeliest of any."""
    sizes = {"length": 0.05, "width": 0.06, "height": 0.05}
    box = replace(part.scaled(0.9), graph=part.graph.replace("left", shape="box", parameters=sizes))
    ball = replace(part.scaled(0.8), graph=part.graph.replace("left", shape="sphere", parameters={"radius": 0.03}))
    parts = with_absences([part, box, ball], {"left": (0.6, 0.0)}, {}, {})
    assert "left" in parts[0].graph.names
    assert [each.weight for each in parts] == pytest.approx([0.8 * 0.6, 0.72 * 0.6, 0.64 * 0.6, 0.8 * 0.4])
    assert Posterior(tuple(parts), meta={"existence": {"left": (0.6, 0.0)}}).object_probability(
        "left"
    ) == pytest.approx(0.6)


def test_what_may_be_several_objects_is_told_rather_than_nothing(part):
    """A toy of lobes, surely no clutter but one object with .3 only, was left out of the best scene, at P .34."""
    first, second = with_absences([part], {"left": (0.3, 0.1)}, {}, {"left": 0.05})
    assert "left" in first.graph.names and first.weight == pytest.approx(0.8 * 0.3)
    assert second.extras["absent"] == ["left"] and second.weight == pytest.approx(0.8 * 0.05)
    posterior = Posterior((first, second), meta={"existence": {"left": (0.3, 0.1)}})
    assert posterior.object_probability("left") == pytest.approx(0.3) and posterior.missed == pytest.approx(1.0 - 0.28)


def test_of_many_things_the_likeliest_choices_are_told(part):
    """Sixteen of them by 65,536 choices: those told are the likeliest, and what others hold is nobody's."""
    graph, chance = part.graph, {}
    for number in range(16):
        graph = graph.add(replace(part.graph.vertex("left"), name=f"thing_{number}"))
        chance[f"thing_{number}"] = (0.9, 0.0)
    many = replace(part, graph=graph, weight=1.0)
    parts = with_absences([many], chance, {}, {})
    assert len(parts) == MOST_STRUCTURES and parts[0].weight == pytest.approx(0.9**16)
    pairs = MOST_STRUCTURES - 17
    assert sum(each.weight for each in parts) == pytest.approx(0.9**16 + 1.6 * 0.9**15 + 0.01 * pairs * 0.9**14)
    assert Posterior(tuple(parts), meta={"existence": chance}).object_probability("thing_3") == pytest.approx(0.9)


def test_where_an_object_is_seen_elsewhere_something_else_is_there_and_not_nothing(part):
    """A pallet of which a box explained a twelfth was told as nothing, P .92."""
    (told,) = with_absences([part], {}, {"left": 0.08, "nobody": 0.5}, {})
    assert told.graph == part.graph and told.weight == pytest.approx(0.8 * 0.08)
