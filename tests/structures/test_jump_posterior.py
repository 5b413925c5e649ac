"""A tiny world whose posterior over structures is also computed by brute force: a chain must agree with it."""

import functools
import math
from functools import partial

import numpy as np
import pytest
from jump_worlds import document_of, generator, jump_chain

from derender.camera.intrinsics import Camera
from derender.posterior.target import ObservedImage
from derender.render.raycast.evaluator import DepthEvaluator
from derender.scene.pose import rotation_x, translation
from derender.structures.infer import infer_structure
from derender.structures.jumps.base import State, Target, Vocabulary
from derender.structures.jumps.proposal import Hypothesis, HypothesisProposal
from derender.structures.jumps.run import Draws, posterior_of, share_error
from derender.structures.options import Options
from worlds.made_scenes import render_floor_scene

# At most two objects, cubes or balls, on the floor or on a cube; 16 x 12 pixels with noise that leaves doubt.
TINY = """
derender: 1
root: {distance: 0.5, elevation: 60 deg}
objects:
  floor: {shape: plane, contact: {type: 6dof}}
structure:
  type: grammar
  offspring: {floor: {categorical: {0: 0.2, 1: 0.5, 2: 0.3}}, cube: {categorical: {0: 0.6, 1: 0.4}}}
shapes: {cube: {side: {uniform: [0.04, 0.1]}}, sphere: {radius: {uniform: [0.02, 0.05]}}}
contacts:
  standing: {type: face-to-face, parent_face: top, child_face: -z, x: {normal: [0, 0.04]}, y: {normal: [0, 0.04]},
             theta: 20 deg}
  rolling: {type: point-on-face, parent_face: top, x: {normal: [0, 0.04]}, y: {normal: [0, 0.04]}}
constraints: [at-most: 2]
"""
CAMERA = Camera(fx=20.0, fy=20.0, cx=7.5, cy=5.5, width=16, height=12)
VALUES = {"sigma": 0.1, "background": 0.7}


def key_of(graph):
    """Return what tells two structures of the tiny world apart: kinds and parents as a multiset."""
    kind = {"floor": "floor", **{v.name: v.shape for v in graph.vertices if v.name != "floor"}}
    return tuple(sorted((kind[v.name], kind[v.parent]) for v in graph.vertices if v.name != "floor"))


@functools.cache
def observed(seed):
    prior = document_of(TINY).prior
    rng = generator(seed, 77)
    truth = prior.sample(rng)
    evaluator = DepthEvaluator(CAMERA, np.ones((12, 16)), "gaussian", VALUES)
    evaluator.load(truth.solids())
    return prior, truth, evaluator.model_depth() + VALUES["sigma"] * rng.standard_normal((12, 16))


def likelihood_of(image):
    """Return the log likelihood of a scene of the tiny world."""
    return partial(ObservedImage(CAMERA, image, "gaussian", VALUES).log_likelihood, parameters={})


@functools.cache
def reference(seed, draws=10_000):
    """Return ({structure: probability}, their standard errors, draws' worth) by weighing draws of the prior."""
    prior, _, image = observed(seed)
    rng = generator(seed, 78)
    log_likelihood = likelihood_of(image)
    logs, keys = [], []
    for _ in range(draws):
        graph = prior.sample(rng)
        logs.append(log_likelihood(graph))
        keys.append(key_of(graph))
    logs = np.array(logs)
    weights = np.exp(logs - logs.max())
    total = weights.sum()
    shares, errors = {}, {}
    for key in set(keys):
        inside = np.array([k == key for k in keys])
        share = weights[inside].sum() / total
        shares[key] = float(share)
        errors[key] = float(np.sqrt(np.sum(weights**2 * (inside - share) ** 2)) / total)
    return shares, errors, float(total**2 / np.sum(weights**2))


def words_with_hypotheses(prior, truth):
    """Return the vocabulary whose births are drawn around the true solids, 1 cm off, half of them."""
    poses = truth.poses()
    guesses = [
        Hypothesis(v.shape, dict(v.parameters), poses[v.name], 1.0, 0.015, 0.3)
        for v in truth.vertices
        if v.name != "floor"
    ]
    return Vocabulary(prior, HypothesisProposal(guesses, 0.5) if guesses else None)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 5])
def test_chain_agrees_with_brute_force(seed):
    prior, truth, image = observed(seed)
    shares, errors, effective = reference(seed)
    assert effective > 100
    words = words_with_hypotheses(prior, truth)
    target = Target(prior, likelihood_of(image))
    draws = jump_chain(generator(seed, 79), target, words, truth, 3000, 500, 3)
    keys = [key_of(state.graph) for state in draws.states]
    for key in set(shares) | set(keys):
        walked = np.array([k == key for k in keys], float)
        batches = walked.reshape(30, -1).mean(axis=1)
        error = math.hypot(batches.std(ddof=1) / math.sqrt(30), errors.get(key, 0.0))
        assert abs(walked.mean() - shares.get(key, 0.0)) < 4.5 * error + 2e-3, key


def test_objects_are_called_after_what_they_are_in_the_likeliest_structure():
    """A ball where the likeliest structure has a cube is the same object under the same name, however well it fits."""
    prior = document_of(TINY).prior
    words, rng = Vocabulary(prior), generator(3, 79)
    graphs = (prior.sample(rng) for _ in range(1000))
    cube = next(g for g in graphs if [v.shape for v in g.vertices] == ["plane", "cube"])
    place = cube.poses()[cube.names[1]][:3, 3]
    ball = min((g for g in graphs if [v.shape for v in g.vertices] == ["plane", "sphere"]),
               key=lambda g: np.linalg.norm(g.poses()[g.names[1]][:3, 3] - place))  # fmt: skip
    states = [State(graph, 0.0, float(graph is ball)) for graph in (cube, cube, ball)]  # the cube is likelier
    posterior = posterior_of(words, [Draws(states, {})])
    assert [(part.graph.names, part.weight) for part in posterior.parts] == [
        (("floor", "cube_1"), pytest.approx(2 / 3)), (("floor", "cube_1"), pytest.approx(1 / 3)),
    ]  # fmt: skip
    assert posterior.parts[0].addresses[0].startswith("cube_1.")
    # One chain was there twice of three times, and its draws are too few to tell what they are worth.
    assert all(part.weight_interval[1] - part.weight_interval[0] > 0.5 for part in posterior.parts)


def test_the_share_of_a_structure_has_its_error_and_is_no_more_than_one():
    """Two chains that never left the first structure said that it is there with 1.0000000000000013 +- 0."""
    prior = document_of(TINY).prior
    words, rng = Vocabulary(prior), generator(3, 79)
    graph = next(g for g in (prior.sample(rng) for _ in range(1000)) if len(g.vertices) == 2)
    (stuck,) = posterior_of(words, [Draws([State(graph, 0.0, 0.0)] * 30, {})] * 2).parts
    assert stuck.weight == 1.0 and 0.1 < stuck.weight_error < 0.3 and stuck.weight_interval[0] < 0.8
    apart = [["a"] * 300, ["b"] * 300]
    mixed = [rng.choice(["a", "b"], 300).tolist() for _ in range(2)]
    assert share_error(apart, "a", 0.5)[0] > 0.2 > 0.04 > share_error(mixed, "a", 0.5)[0] > 0.01


def test_a_camera_may_be_a_mapping():
    """As for the other methods: chains asked it for its height."""
    floor = translation(0.0, 0.0, 0.8) @ rotation_x(np.radians(125.0))
    camera = Camera(80.0, 80.0, 31.5, 23.5, 64, 48)
    box = floor @ translation(0.0, 0.0, 0.05)
    depth, _ = render_floor_scene(["box"], box[None], np.full((1, 3), 0.1), floor, camera)
    options = Options(method="mcmc", draws=2, warmup=20, chains=1, seed=1)
    assert infer_structure(depth, camera, options).best_part.log_density.shape == (1, 2)
