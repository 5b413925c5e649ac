"""MAP: exact chain rule, and second-order ascents that find the truth."""

import numpy as np
import pytest
from small_scenes import read

from derender import data_path
from derender.document import read_document
from derender.posterior.ascent import MapProblem, climb, find_motions
from derender.posterior.compiled.model import chain_of, model_of
from derender.posterior.forward import draw_documents, observe
from derender.render.raycast.depth import render_depth
from derender.render.raycast.normal_equations import MOTION
from derender.scene.pose import inverse
from derender.structures.given import targets

FIGURE = data_path("priors/figure-5.yaml").read_text()
OPEN = FIGURE.replace("theta: 20 deg, x", "theta: {uniform: [0, 90 deg]}, x").replace("u: 0.45", "u: {uniform: [0, 1]}")


def problems(count: int, **settings):
    document = read(FIGURE)
    for draw in draw_documents(document, count, 3, {}):
        clean, _ = render_depth(draw.graph.solids(), draw.camera, antialias=8, background=10.0)
        depth = observe(draw.rng, clean, draw.likelihood)
        ((target, _),) = targets(document, depth, draw.camera, 0)
        yield MapProblem(target, target.values(draw.graph), **settings)


def test_descendants_share_their_ancestors_motion():
    """Eqs. 7-9: a contact's parameter moves the vertex and all below it by one rigid motion, and nothing else."""
    document = read(OPEN)
    (draw,) = draw_documents(document, 1, 3, {})
    ((target, _),) = targets(document, np.ones(draw.camera.shape), draw.camera, 0)
    motions, addresses = np.zeros((2, 4, MOTION)), target.space.addresses
    chosen = np.array([addresses.index(address) for address in ("green.contact.theta", "red.contact.u")])
    find_motions(model_of(target), chain_of(target), target.values(draw.graph), chosen, motions)
    names = draw.graph.solid_names
    green, red, yellow, floor = (names.index(name) for name in ("green", "red", "yellow", "floor"))
    # 1e-8: differences with steps of 1e-6 of numbers of order one in float64
    assert np.allclose(motions[0, green], motions[0, red], atol=1e-8)
    assert np.allclose(motions[0, green], motions[0, yellow], atol=1e-8)
    assert np.allclose(motions[1, red], motions[1, yellow], atol=1e-8)
    assert not motions[0, floor].any() and not motions[1, green].any()
    axis = inverse(draw.graph.poses()["floor"])[:3, :3] @ motions[0, green, 3:6]
    assert np.allclose(np.abs(axis), [0, 0, 1], atol=1e-8)


def slopes(problem: MapProblem, values: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Central differences of fourth order of the log density."""
    found = []
    for p in range(len(values)):
        h = np.zeros(len(values))
        h[p] = step[p]
        f = problem.log_density
        near, far = f(values + h) - f(values - h), f(values + 2 * h) - f(values - 2 * h)
        found.append((8 * near - far) / (12 * step[p]))
    return np.array(found)


@pytest.mark.slow
def test_gradient_by_contact_parameters():
    """Against differences in steps of about a sixth of a pixel: 5 %, the jitter of sampled corner pixels over the step.

    The broken twin leaves the occlusion edges out.
    """
    wrong = []
    for edges in (True, False):
        for problem in problems(4, edges=edges):
            values = problem.start + [0.04, 0.02, -0.02]
            values = problem.domain.bring(values)
            reference = slopes(problem, values, np.array([0.02, 0.008, 0.008]))
            gradient, _ = problem.slope(values)
            wrong.append(np.linalg.norm(gradient - reference) / np.linalg.norm(reference))
    assert np.median(wrong[:4]) < 0.05
    assert np.median(wrong[4:]) > 0.3


@pytest.mark.parametrize("gradient", ["exact", "finite-difference"])
def test_ascent_finds_the_truth(gradient):
    """From some pixels off the end is within 3 nats of the truth or above; every step goes up and stays inside."""
    for problem in problems(4, gradient=gradient):
        path, densities = problem.maximise(problem.domain.bring(problem.start + [0.06, 0.03, -0.03]))
        assert densities[-1] > problem.log_density(problem.start) - 3.0
        assert np.all(np.diff(densities) > 0)
        assert np.allclose(problem.domain.bring(path[-1]), path[-1])


def test_the_precision_at_the_mode_covers_the_truth():
    """The truth is where the normal approximation at the mode says: its squared distance is chi-square with 3 degrees,
    below 16.3 in 99.9 % of images."""
    for problem in problems(4):
        found = problem.maximise(problem.start).path[-1]
        _, precision = problem.slope(found)
        away = found - problem.start
        assert away @ precision @ away < 16.3


def test_climbing_from_a_draw_never_makes_it_worse():
    """`climb` moves a state of the chains' own target uphill, by either derivative."""
    document = read_document(data_path("priors/figure-5.yaml"))
    (draw,) = draw_documents(document, 1, 5, {})
    depth = observe(draw.rng, render_depth(draw.graph.solids(), draw.camera)[0], draw.likelihood)
    ((target, _),) = targets(document, depth, draw.camera, 0)
    truth = np.array([draw.graph.numbers()[address] for address in target.space.addresses])
    start = truth + [0.06, 0.03, -0.03]
    before = target.log_likelihood(start)
    # The target's image has one ray a pixel: its own top is a fifth of a pixel from that of ours, which
    # flips some pixels of the outline, so the rest of the way belongs to the chains.
    top = target.log_likelihood(truth)
    for gradient in ("exact", "finite-difference"):
        assert top - target.log_likelihood(climb(target, start, gradient)) < 0.2 * (top - before)


RING = """
derender: 1
camera: {fx: 60, fy: 60, cx: 31.5, cy: 23.5, width: 64, height: 48}
root: {distance: 0.5, elevation: 35 deg}
objects:
  floor: {shape: plane, contact: {type: 6dof, z: -0.05}}
  ring:
    shape: {type: mesh, file: ring.ply, hull: false, scale: {uniform: [0.8, 1.2]}}
    parent: floor
    contact: {type: face-to-face, theta: 0.3, x: {normal: [0, 0.01]}, y: {normal: [0, 0.01]}}
  box:
    shape: {type: box, length: 0.06, width: 0.03, height: {uniform: [0.03, 0.06]}}
    parent: ring
    contact: {type: face-to-face, theta: {uniform: [0, 180 deg]}, u: {uniform: [0.4, 0.6]}, v: {uniform: [0.4, 0.6]}}
likelihood: {type: gaussian, sigma: 0.003, blur: 1.0}
"""


def test_a_scene_with_a_mesh_ends_at_its_mode(tmp_path):
    """A ring of 2,048 triangles with a box on it: from a guess some millimetres and degrees off to the truth."""
    import trimesh

    trimesh.creation.torus(0.05, 0.02, major_sections=32, minor_sections=32).export(tmp_path / "ring.ply")
    (tmp_path / "ring.yaml").write_text(RING)
    document = read_document(tmp_path / "ring.yaml")
    (draw,) = draw_documents(document, 1, 0, {})
    depth = observe(draw.rng, render_depth(draw.graph.solids(), draw.camera, background=10.0)[0], draw.likelihood)
    ((target, _),) = targets(document, depth, draw.camera, 0)
    truth = np.array([draw.graph.numbers()[address] for address in target.space.addresses])
    off = {"scale": 0.05, "height": 0.004, "theta": 0.15, "u": 0.05, "v": -0.05, "x": 0.006, "y": -0.004}
    start = truth + [off[address.rpartition(".")[2]] for address in target.space.addresses]
    found = climb(target, start)
    assert sum(map(float, (target.log_prior(found), target.log_likelihood(found)))) > (
        target.log_prior(truth) + target.log_likelihood(truth)
    )
