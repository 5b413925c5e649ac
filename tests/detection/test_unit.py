"""Scenes much larger or smaller than a table are searched in a unit of their own."""

from dataclasses import replace

import numpy as np
import pytest

from derender.detection import unit as detection_unit
from derender.detection.solids.beliefs import bare_image
from derender.detection.solids.graph import scene_graph
from derender.detection.solids.image import make_row
from derender.detection.solids.polish import UPRIGHT
from derender.detection.solids.state import State
from derender.detection.unit import likelihood_in_metres, part_in_metres, scale_drawn
from derender.render.raycast.depth import render_depth
from derender.results.posterior import StructurePosterior
from derender.scene.pose import rotation_x, rotation_z, translation
from derender.scene.solids import BOX
from derender.structures.infer import infer_structure
from derender.structures.options import Options
from worlds.made_scenes import SETS, make_scene, photograph, render_floor_scene


def test_the_unit_is_the_metre_for_what_is_as_far_off_as_a_table():
    loose = bare_image().loose

    def unit_of(depth):
        return detection_unit.unit_of(depth, loose)

    nearest, farthest = loose.seen_from
    for distance in (nearest, 0.7, farthest):
        assert unit_of(np.full((4, 5), distance)) == 1.0
    assert unit_of(np.full((4, 5), 10 * farthest)) == pytest.approx(10.0)
    assert unit_of(np.full((4, 5), 0.1 * nearest)) == pytest.approx(0.1)
    assert unit_of(np.full((4, 5), np.nan)) == 1.0
    coins = type(loose.unit)(0.1, 0.5)  # a file whose lengths are those of coins
    assert detection_unit.unit_of(np.full((4, 5), 0.1), replace(loose, unit=coins)) == pytest.approx(0.1)
    table_in_a_hall = np.where(np.arange(100) < 40, 0.8, 9.0)[None]
    assert unit_of(table_in_a_hall) == 1.0


@pytest.mark.slow
def test_every_length_of_a_posterior_is_converted():
    """With balls, cans and boxes that lie, lean and stand: each draw is the same scene, larger."""
    scene = make_scene(np.random.default_rng([70000, SETS.index("mixed")]), "mixed")
    found = infer_structure(scene["depth"], scene["camera"], Options(draws=4), np.random.default_rng(1))
    part = found.best_part
    large = part_in_metres(part, 3.0)
    for draw in range(2):
        one, other = part.graph_at(0, draw), large.graph_at(0, draw)
        assert other.names == one.names
        assert other.solids().size == pytest.approx(3.0 * one.solids().size, abs=1e-9)
        for name, pose in one.poses().items():
            assert other.poses()[name][:3, 3] == pytest.approx(3.0 * pose[:3, 3], abs=1e-9)
            assert other.poses()[name][:3, :3] == pytest.approx(pose[:3, :3], abs=1e-9)
    numbers, threefold = part.extras["likelihood"], large.extras["likelihood"]
    assert threefold["sigma"] == pytest.approx(3.0 * numbers["sigma"]) and threefold["blur"] == numbers["blur"]


def test_draws_are_of_scenes_a_little_larger_and_farther_or_smaller_and_nearer():
    """All of a draw together, so that the image is the same; the best stays as it is."""
    box = make_row(BOX, np.eye(3), np.array([0.1, 0.05, 0.04]), np.array([0.1, 0.06, 0.08]))
    graph = scene_graph(State().add(box, UPRIGHT, False), translation(0.0, 0.1, 0.9) @ rotation_x(2.0))
    addresses = ("box_1.length", "box_1.width", "box_1.height", "box_1.contact.x", "box_1.contact.y")
    values = np.tile([graph.numbers()[address] for address in addresses], (2, 50, 1))
    density = np.zeros((2, 50))
    density[1, 7] = 1.0
    drawn = scale_drawn(np.random.default_rng(0), StructurePosterior(graph, addresses, values, density, density), 0.01)
    place, size = graph.poses()["box_1"][:3, 3], np.array(graph.body("box_1").size())
    scenes = [drawn.graph_at(*draw) for draw in np.ndindex(2, 50)]
    factors = np.array([scene.body("box_1").size()[0] / size[0] for scene in scenes])
    assert 0.007 < np.std(np.log(factors)) < 0.013 and factors[57] == 1.0
    for factor, scene in zip(factors, scenes, strict=True):
        np.testing.assert_allclose(scene.body("box_1").size(), factor * size)
        np.testing.assert_allclose(scene.poses()["box_1"][:3, 3], factor * place, atol=1e-12)
        np.testing.assert_allclose(scene.poses()["floor"][:3, 3], factor * graph.poses()["floor"][:3, 3])


@pytest.mark.parametrize("times", [0.1, 12.0])
def test_a_scene_many_times_as_large_or_small_is_found(times):
    """Of millimetres, or of rooms whose floor is seen far beyond ten metres."""
    sizes = np.array([[0.1, 0.08, 0.06], [0.07, 0.05, 0.12]])
    poses = np.stack([translation(-0.08, 0, 0.03) @ rotation_z(0.3), translation(0.09, 0.04, 0.06) @ rotation_z(0.9)])
    scene = photograph(np.random.default_rng(3), ["box"] * 2, sizes, poses, ["floor"] * 2)
    sizes, floor = sizes * times, scene["floor"].copy()
    poses = np.array([item["pose"] for item in scene["objects"]])
    poses[:, :3, 3] *= times
    floor[:3, 3] *= times
    depth, _ = render_floor_scene(["box"] * 2, poses, sizes, floor, scene["camera"])
    noise = 0.001 * times
    depth = depth + noise * np.random.default_rng(0).normal(size=depth.shape)
    found = infer_structure(depth, scene["camera"], Options(draws=10), np.random.default_rng(0))
    graph = found.best_graph()
    solids = graph.solids()
    said, true = (each[np.argsort(each.prod(axis=1))] for each in (solids.size[1:], sizes))
    assert np.sort(said, axis=1) == pytest.approx(np.sort(true, axis=1), rel=0.05)
    drawn, label = render_depth(solids, scene["camera"])
    assert np.median(np.abs(depth - drawn)[label > 0]) < noise
    assert found.meta["likelihood"]["sigma"] == pytest.approx(noise, rel=0.25)
    missed = found.meta["missed"]
    assert missed > 0.0 and sum(part.weight for part in found.parts) == pytest.approx(1.0 - missed)


def test_a_noise_at_the_end_of_its_range_stays_in_it_in_metres():
    least = {"type": "gaussian", "sigma": 1e-6, "blur": 0.5}
    assert likelihood_in_metres(least, 0.96) == least
    assert likelihood_in_metres(least, 3.0) == {**least, "sigma": pytest.approx(3e-6)}
