"""Places for walks to begin at: solids that are seen become the numbers of a given scene, whose images are theirs."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from derender.document import read_prior_document
from derender.posterior.compiled.backend import backend_of
from derender.posterior.sampler import Settings
from derender.render.blur import blur
from derender.render.raycast.depth import render_depth
from derender.structures import detected
from derender.structures.detected import Solid, places_of, root_of, solids_seen
from derender.structures.given import mixture_of, targets

SCENE = """
derender: 1
camera: {fx: 70, fy: 70, cx: 39.5, cy: 29.5, width: 80, height: 60}
root: ROOT
objects:
  floor: {shape: plane, contact: {type: 6dof, z: -0.1}}
  green:
    shape: {type: box, length: {uniform: [0.1, 0.2]}, width: {uniform: [0.1, 0.2]}, height: {uniform: [0.05, 0.15]}}
    parent: floor
    contact: {type: face-to-face, theta: {uniform: [0, 180 deg]}, x: {uniform: [-0.2, 0.2]}, y: {uniform: [-0.2, 0.2]}}
  red:
    shape: {type: box, length: {uniform: [0.03, 0.1]}, width: {uniform: [0.03, 0.1]}, height: {uniform: [0.03, 0.1]}}
    parent: green
    contact: {type: face-to-face, theta: {uniform: [0, 180 deg]}, u: {uniform: [0.2, 0.8]}, v: {uniform: [0.2, 0.8]}}
  yellow:
    shape: {type: cylinder, radius: {uniform: [0.02, 0.05]}, height: {uniform: [0.03, 0.15]}}
    parent: floor
    contact: {type: face-to-face, x: {uniform: [-0.3, 0.3]}, y: {uniform: [-0.3, 0.3]}}
constraints:
  - no-overlap
likelihood: {type: gaussian, sigma: 2 mm, blur: 0.5}
"""
KNOWN_ROOT = "{distance: 0.9, elevation: 35 deg}"
FREE_ROOT = "{distance: {uniform: [0.7, 1.2]}, elevation: {uniform: [20 deg, 50 deg]}}"
LEVEL = 5.0  # nats within which a place is as likely as the truth: of a dozen unknowns cooling gains a nat or two


def made(folder, root, seed):
    """Return (target of a scene drawn with noise, the scene, its log posterior density)."""
    rng = np.random.default_rng([7, seed])
    (folder / "scene.yaml").write_text(SCENE.replace("ROOT", root))
    document = read_prior_document(folder / "scene.yaml")
    graph = document.prior.sample(rng)
    clean, _ = render_depth(graph.solids(), document.camera)
    image = blur(clean, 0.5) + 0.002 * rng.standard_normal(clean.shape)
    ((target, _),) = targets(document, image, document.camera, 0)
    backend = backend_of(target, mixture_of(target, Settings()))
    return target, backend, graph, sum(backend.evaluate(target.values(graph)))


@pytest.mark.parametrize("root", [KNOWN_ROOT, FREE_ROOT])
@pytest.mark.parametrize("seed", range(3))
def test_solids_seen_become_the_numbers_of_the_scene(tmp_path, root, seed):
    target, backend, graph, truth = made(tmp_path, root, seed)
    names = dict(zip(graph.names, ("floor", "box_1", "box_2", "cylinder_1"), strict=True))
    places = places_of(np.random.default_rng(seed), target, backend, graph.renamed({n: names[n] for n in names}))
    assert sum(backend.evaluate(places[0])) > truth - LEVEL


def test_what_of_a_solid_was_hidden_is_found_longer_or_shorter(tmp_path):
    target, backend, graph, truth = made(tmp_path, KNOWN_ROOT, 1)
    longer = graph.with_numbers({"green.length": 1.3 * graph.numbers()["green.length"]})
    places = places_of(np.random.default_rng(0), target, backend, longer)
    assert sum(backend.evaluate(target.values(longer))) < truth - 1000.0  # the image speaks against it
    assert sum(backend.evaluate(places[0])) > truth - LEVEL


def test_an_object_that_nothing_shows_is_drawn_from_the_prior(tmp_path):
    target, backend, graph, _ = made(tmp_path, KNOWN_ROOT, 0)
    without = type(graph)(graph.root_pose, tuple(v for v in graph.vertices if v.name != "yellow"), graph.gravity)
    for place in places_of(np.random.default_rng(0), target, backend, without):
        assert target.log_prior(place) > -math.inf


def test_the_search_for_solids_leads_to_the_scene(tmp_path):
    target, backend, _, truth = made(tmp_path, KNOWN_ROOT, 2)
    scene = solids_seen(target, 0)
    places = places_of(np.random.default_rng(0), target, backend, scene)
    assert sum(backend.evaluate(places[0])) > truth - LEVEL


def test_what_is_resized_into_another_leads_nowhere(tmp_path, monkeypatch):
    target, backend, graph, truth = made(tmp_path, KNOWN_ROOT, 0)
    tried = []

    def first_as_it_is(scene, placed, solids, backend):  # then with the can where the box below is
        tried.append(placed)
        where = {**graph.numbers(), **{f"yellow.contact.{x}": graph.numbers()[f"green.contact.{x}"] for x in "xy"}}
        inside = graph.with_numbers(where).vertex("yellow")
        vertices = tuple(inside if vertex.name == "yellow" else vertex for vertex in placed.vertices)
        return placed if len(tried) == 1 else placed._replace(vertices=vertices)

    monkeypatch.setattr(detected, "resized", first_as_it_is)
    monkeypatch.setattr(detected, "cooled", lambda rng, target, values: values)
    places = places_of(np.random.default_rng(0), target, backend, graph)
    assert len(tried) > 1 and sum(backend.evaluate(places[0])) > truth - LEVEL


def test_an_interrupt_while_solids_are_looked_for_is_one(tmp_path, monkeypatch):
    target, *_ = made(tmp_path, KNOWN_ROOT, 0)
    found = SimpleNamespace(meta={"interrupted": True}, best_graph=lambda: None)
    monkeypatch.setattr("derender.structures.infer.infer_structure", lambda *_: found)
    with pytest.raises(KeyboardInterrupt):
        solids_seen(target, 0)


def test_a_camera_on_its_side_keeps_its_root(tmp_path):
    target, _, graph, _ = made(tmp_path, FREE_ROOT, 0)
    laws = {unknown.address: unknown.distribution for unknown in target.space.unknowns}
    on_its_side = np.eye(4)
    on_its_side[:3, :3] = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # the floor's normal is x
    on_its_side[:3, 3] = 0.5, 0.0, 1.0
    assert np.isfinite(root_of(target, laws, graph)).all()
    assert (root_of(target, laws, replace(graph, root_pose=on_its_side)) == target.template.root_pose).all()


def test_a_solid_grows_away_from_the_face_that_stays(tmp_path):
    _, _, graph, _ = made(tmp_path, KNOWN_ROOT, 0)
    solid = Solid(graph.vertex("green").body, graph.poses()["green"])
    for axis in range(3):
        for side in (-1.0, 1.0):
            longer = solid.resized(axis, side, 1.5)
            ends = [
                one.pose[:3, 3] - 0.5 * side * one.body.size()[axis] * one.pose[:3, axis] for one in (solid, longer)
            ]
            assert np.abs(ends[0] - ends[1]).max() < 1e-12
            assert longer.body.size()[axis] == pytest.approx(1.5 * solid.body.size()[axis])
