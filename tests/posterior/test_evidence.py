"""The evidence of fixed structures: against integrals that are known, and of structures that are equally likely."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from derender.document import read_prior_document
from derender.posterior import evidence
from derender.posterior.evidence import evidence_about, log_measure
from derender.posterior.sampler import Settings
from derender.posterior.space import Block, Space, Unknown
from derender.render.likelihoods import likelihoods
from derender.render.raycast.depth import render_depth
from derender.scene.distributions import distributions
from derender.structures.given import candidates, targets

ROTATION, ANGLE = distributions["uniform-rotation"](), distributions["uniform"](0.0, 2.0)
UNKNOWNS = Unknown("a.contact.quat_wxyz", ROTATION), Unknown("a.contact.theta", ANGLE, 2.0)


def curved_world():
    """A space of a rotation and an angle, and a density there of known integral: cos^2 of half the rotation's angle,
    whose mean over all rotations is 1/4, times 1 + cos(pi theta), of mean 1."""
    space = Space(UNKNOWNS, [Block("a.contact", (0, 1))])

    def evaluate(values):
        density = values[0] ** 2 * (1.0 + math.cos(math.pi * values[4]))
        return space.log_prior(values), math.log(max(density, 1e-300))

    return space, SimpleNamespace(evaluate=evaluate)


def places_of(space, backend, count=600):
    """Draws of that density, by rejection from the prior."""
    rng, found = np.random.default_rng(0), []
    while len(found) < count:
        values = space.sample(rng)
        if rng.random() < math.exp(backend.evaluate(values)[1]) / 2.0:
            found.append(values)
    return np.array(found)


def test_an_integral_over_rotations_and_angles_is_known(monkeypatch):
    space, backend = curved_world()
    places = places_of(space, backend)
    found = evidence_about(np.random.default_rng(1), space, backend, places)
    assert found.standard_error < 0.1
    assert abs(found.log - math.log(0.25)) < 4.0 * found.standard_error
    monkeypatch.setattr(evidence, "log_measure", lambda space, tangent: min(log_measure(space, tangent), 0.0) * 0.0)
    broken = evidence_about(np.random.default_rng(1), space, backend, places)
    assert abs(broken.log - math.log(0.25)) > 1.0


def test_places_beyond_half_a_turn_are_met_already():
    space, _ = curved_world()
    assert log_measure(space, np.array([math.pi + 0.01, 0.0, 0.0, 0.0])) == -math.inf
    assert log_measure(space, np.array([0.0, 0.0, 0.0, 1.01])) == -math.inf
    assert math.exp(log_measure(space, np.zeros(4))) == pytest.approx(1.0 / (8.0 * math.pi**2))


ANY_FACE = """
derender: 1
camera: {fx: 40, fy: 40, cx: 19.5, cy: 14.5, width: 40, height: 30}
root: {distance: 0.7, elevation: 40 deg}
objects:
  floor: {shape: plane, contact: {type: 6dof}}
  brick:
    shape: {type: box, length: {uniform: [0.05, 0.2]}, width: {uniform: [0.05, 0.2]}, height: {uniform: [0.05, 0.2]}}
    parent: floor
    contact: {type: face-to-face, child_face: {categorical: {-z: 1, -x: 1, -y: 1}}, theta: {uniform: [0, 180 deg]},
              x: {uniform: [-0.1, 0.1]}, y: {uniform: [-0.1, 0.1]}}
likelihood: {type: gaussian, sigma: 0.01, blur: 0.5}
"""


def test_names_of_faces_that_no_image_tells_are_equally_likely(tmp_path):
    """A box of unknown extents on any of three faces: a population's evidence made any of them .9."""
    (tmp_path / "prior.yaml").write_text(ANY_FACE)
    document = read_prior_document(tmp_path / "prior.yaml")
    camera, rng = document.camera, np.random.default_rng(3)
    target, _ = targets(document, np.zeros(camera.shape), camera, 0)[0]
    depth = render_depth(target.graph(target.space.sample(rng)).solids(), camera)[0]
    image = likelihoods["gaussian"].sample(rng, depth, target.images.values)
    # of 64 runs with other seeds and searches one had an error of more than .06
    found = candidates(targets(document, image, camera, 0), Settings(), 1, lambda *told: None)
    weights, errors = (np.array([getattr(each, name) for each in found]) for name in ("weight", "error"))
    assert len(found) == 3 and errors.max() < 0.06
    assert np.all(np.abs(weights - 1 / 3) < 4.0 * errors)
    assert all(low < each.weight < high for each in found for low, high in [each.interval])
