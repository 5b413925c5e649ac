"""Bridges: found in an image as one, with a probability that follows the gap, and kept by every reader of the scene."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from derender.camera.intrinsics import Camera
from derender.detection.search.greedy import Settings
from derender.detection.solids.beliefs import Rules, bare_image
from derender.document import read_document, write_document
from derender.evaluation.metrics import compare_scenes
from derender.report.scene_json import scene_json
from derender.report.tree_text import scene_lines
from derender.results.posterior import Posterior, StructurePosterior, load
from derender.scene.graph import Contact, SceneGraph, Vertex
from derender.scene.pose import rotation_x
from derender.scene.priors.bare_image import Loose, balances
from derender.structures.bridges import judge, nearest_to_resting, some_of, with_bridges
from derender.structures.infer import infer_structure
from derender.structures.options import Options
from worlds.made_scenes import render_floor_scene

SLACK = 0.0015
RULES = Rules(SLACK)
CAMERA = Camera(fx=140.0, fy=140.0, cx=79.5, cy=59.5, width=160, height=120)


def view():
    """Return the floor's pose (4, 4), z up, as a camera 35 degrees above it and 0.8 m away sees it."""
    pose = rotation_x(np.pi / 2 + np.radians(35))
    pose[:3, 3] = [0.0, 0.0, 0.8]
    return pose


def bridge(second_height=0.08, plank_shift=0.0, length=0.24):
    """Return the graph of a plank on the tower `left`, over the tower `right` of some height, as a tree."""
    box = dict(length=0.06, width=0.06)

    def on_floor(x):
        return Contact("face-to-face", "+z", "-z", {"theta": 0.3, "x": x, "y": 0.0})

    graph = SceneGraph(
        view(),
        (
            Vertex("floor", "plane"),
            Vertex("left", "box", {**box, "height": 0.08}, "floor", on_floor(-0.08)),
            Vertex("right", "box", {**box, "height": second_height}, "floor", on_floor(0.08)),
            Vertex("plank", "box", {"length": length, "width": 0.06, "height": 0.025}),
        ),
    )
    local = np.eye(4)
    local[:3, 3] = [plank_shift, 0.0, 0.08 + 0.0125]
    from derender.scene.contacts import contacts

    graph = graph.replace("plank", contact=Contact("6dof", values=contacts["6dof"].invert(local).phi))
    return hung(graph, "left")


def hung(graph, parent):
    """Return the graph with the plank on another parent, where it was."""
    contact, _ = graph.nearest_contact("plank", parent, "face-to-face", "+z", "-z")
    return graph.replace("plank", parent=parent, contact=contact)


def posterior_of(graph, spread, rng):
    """Return a posterior whose right tower's height is uncertain by `spread` metres."""
    height = graph.vertex("right").parameters["height"]
    values = rng.normal(height, spread, (2, 40, 1))
    return StructurePosterior(graph, ("right.height",), values, np.zeros((2, 40)), np.zeros((2, 40)), 1.0)


def second_support(gap, spread=0.0005, rules=RULES, **how):
    """Return the probability that is given to the plank's second support."""
    part = posterior_of(bridge(0.08 - gap, **how), spread, np.random.default_rng(0))
    return Posterior(tuple(with_bridges([part], rules))).support_probability("plank").get("right", 0.0)


def test_the_probability_is_the_savage_dickey_ratio():
    # even odds where the parent alone could carry the plank: 6 cm times a normal density at the gap
    shift = -0.06  # the plank's centre over the left tower
    assert balances(bridge(plank_shift=shift), "plank", "left")
    for gap, spread in ((0.0, 0.0005), (0.003, 0.001), (0.006, 0.002)):
        part = posterior_of(bridge(0.08 - gap, plank_shift=shift), spread, np.random.default_rng(0))
        gaps = 0.08 - part.values[..., 0].ravel()
        variance = np.std(gaps[::1]) ** 2 + SLACK**2
        odds = 0.06 * np.exp(-0.5 * np.median(gaps) ** 2 / variance) / np.sqrt(2 * np.pi * variance)
        assert second_support(gap, spread, plank_shift=shift) == pytest.approx(odds / (1 + odds), abs=0.02)


@pytest.mark.parametrize("shift", [-0.06, 0.0])
def test_a_tower_whose_top_is_hidden_may_reach_the_plank_however_low_the_best_scene_has_it(shift):
    """Of two towers one hid its top, the best scene had it 14 mm too low, and the plank on the other at P > .99."""
    rng, gaps = np.random.default_rng(3), np.linspace(0.0, 0.03, 80)
    part = posterior_of(bridge(0.08 - 0.015, plank_shift=shift), 0.0, rng)
    part = replace(part, values=rng.permutation(0.08 - gaps).reshape(part.values.shape))
    odds = 0.06 / 0.03 / (1.0 if shift else bare_image().loose.tipping)  # as dense at the plank as anywhere
    told = Posterior(tuple(with_bridges([part], RULES))).support_probability("plank")["right"]
    assert np.log(told / (1.0 - told)) == pytest.approx(np.log(odds), abs=0.3)  # of 80 draws, some 25 about the end


def test_a_rarer_second_support_is_less_probable_by_the_odds_of_the_file():
    part, rare = (
        posterior_of(bridge(0.077, plank_shift=-0.06), 0.001, np.random.default_rng(0)),
        Loose(second_support=0.2),
    )
    even, less = (
        judge(some_of(part), part.graph, "plank", "right", SLACK, loose).probability for loose in (Loose(), rare)
    )
    assert less / (1.0 - less) == pytest.approx(0.25 * even / (1.0 - even))


def test_the_slack_of_the_file_is_that_of_second_supports():
    beliefs = bare_image()
    coarse = Settings(beliefs=beliefs._replace(loose=replace(beliefs.loose, slack=2.0 * SLACK))).rules
    gap, spread = 0.006, 0.0005
    odds = [p / (1.0 - p) for p in (second_support(gap, spread, rules, plank_shift=-0.06) for rules in (RULES, coarse))]
    densities = [norm.pdf(gap, scale=np.hypot(spread, slack)) for slack in (SLACK, 2.0 * SLACK)]
    assert np.log(odds[1] / odds[0]) == pytest.approx(np.log(densities[1] / densities[0]), abs=0.3)  # of 80 draws


def test_a_touching_tower_carries_and_a_lower_one_does_not():
    assert second_support(0.0) > 0.99
    # 9 mm is six times the slack; were the plank to balance on one tower alone, nothing would speak for the contact
    assert second_support(0.009, plank_shift=-0.06) < 0.01
    assert second_support(0.02) == 0.0
    # a plank that would tip off its parent makes the same gap likelier to be none
    assert not balances(bridge(), "plank", "left")
    assert second_support(0.004) > second_support(0.004, plank_shift=-0.06) + 0.05


def test_a_plank_that_ends_before_the_other_tower_does_not_rest_on_it():
    assert second_support(0.0, length=0.1, plank_shift=-0.05) == 0.0


def test_weights_stay_and_which_carrier_is_the_parent_does_not_matter():
    rng = np.random.default_rng(0)
    first = replace(posterior_of(bridge(), 0.0005, rng), weight=0.6)
    other = hung(first.graph, "right")
    second = replace(first, graph=other, weight=0.4)
    parts = with_bridges([first, second], RULES)
    assert sum(part.weight for part in parts) == pytest.approx(1.0, abs=1e-12)
    posterior = Posterior(tuple(parts))
    assert posterior.best_graph().vertex("plank").parent == "left"
    assert posterior.support_probability("plank")["right"] > 0.99
    assert len([part for part in parts if part.graph.vertex("plank").supports]) == 1


def test_the_gap_is_closed_in_every_draw():
    part = posterior_of(bridge(0.079), 0.0005, np.random.default_rng(0))
    joined = next(p for p in with_bridges([part], RULES) if p.graph.vertex("plank").supports)
    for draw in range(5):
        assert abs(nearest_to_resting(joined.graph_at(0, draw), "plank", "right")[1].gap) < 1e-12


@pytest.fixture(scope="module")
def found():
    """The posterior from the image of a bridge alone, and the truth."""
    truth = bridge().replace("plank", supports=("right",))
    names = ("left", "right", "plank")
    poses, sizes = truth.poses(), [truth.body(name).size() for name in names]
    depth, _ = render_floor_scene(["box"] * 3, np.array([poses[n] for n in names]), np.array(sizes), view(), CAMERA)
    depth = depth + np.random.default_rng(0).normal(0, 0.001, depth.shape)
    return infer_structure(depth, CAMERA, Options(draws=20), np.random.default_rng(0)), truth


@pytest.mark.slow
def test_a_bridge_in_an_image_is_found_as_one(found):
    posterior, truth = found
    graph = posterior.best_graph()
    result = compare_scenes(scene_json(graph), scene_json(truth))
    assert result["objects"]["0.75"]["hits"] == 3 and result["graph_exact"]
    assert result["edges"]["truth"] == 4  # the second support is an edge too
    without = truth.replace("plank", supports=())
    assert not compare_scenes(scene_json(without), scene_json(truth))["graph_exact"]


@pytest.mark.slow
def test_every_reader_keeps_the_second_support(found, tmp_path):
    posterior, _ = found
    graph = posterior.best_graph()
    plank = next(v for v in graph.vertices if v.supports)
    write_document(tmp_path / "scene.yaml", graph, camera=CAMERA)
    assert read_document(tmp_path / "scene.yaml").graph.vertex(plank.name).supports == plank.supports
    posterior.save(tmp_path / "posterior.npz")
    assert load(tmp_path / "posterior.npz").best_graph().vertex(plank.name).supports == plank.supports
    entry = next(item for item in scene_json(graph, posterior)["objects"] if item["name"] == plank.name)
    assert entry["supports"] == list(plank.supports)
    assert entry["support_probability"][plank.supports[0]] > 0.9
    text = "\n".join(scene_lines(graph, posterior))
    assert f"also on {plank.supports[0]}" in text and f"also {plank.supports[0]} " in text


@pytest.mark.slow
def test_a_bridge_stands_in_simulation_because_of_its_second_support(found):
    from derender.physics.bodies import matter_of_graph
    from derender.physics.simulate import judge, simulate

    posterior, _ = found
    graph = posterior.best_graph()
    plank = next(v for v in graph.vertices if v.supports)
    verdict = judge(simulate(matter_of_graph(graph), early=True))
    assert verdict.stable
    alone = graph.remove(plank.supports[0])  # its broken twin: one tower taken away
    assert not judge(simulate(matter_of_graph(alone), early=True)).stable
