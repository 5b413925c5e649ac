"""Simulation-based calibration over structure: at most two objects, 16 x 12 pixels, scenes drawn from the prior.

The truth is put at a random place among the states of a chain that runs from it both ways (the jumps are reversible):
if the chain leaves the posterior invariant, truth and states are exchangeable, whatever the autocorrelation, so ranks
are uniform, and the share of the states with a structure is right on average (Gandy and Scott, "Unit testing for MCMC
and other Monte Carlo methods", 2020). The same images' posteriors are also enumerated from a bank of prior draws.
"""

import functools
import math

import numpy as np
import pytest
from jump_worlds import document_of, generator
from scipy.stats import chi2
from test_jump_posterior import CAMERA, TINY, VALUES, key_of, likelihood_of

from derender.render.raycast.evaluator import DepthEvaluator
from derender.scene.graph import Vertex
from derender.structures.jumps.base import BirthDeath, Target, Vocabulary, evaluate
from derender.structures.jumps.run import walk

STATES = 15  # of a chain besides the truth
SEVERE = 4.5  # standard errors that pass; the twins are to fail by more
UNLIKELY = 1e-5  # probability of a rank histogram as uneven that passes


def figures(graph):
    """Return numbers of a scene that no naming of its objects changes: how many, how large, how far to the right."""
    solids = [v for v in graph.vertices if v.name != "floor"]
    extents = [float(v.body.size()[0]) for v in solids]
    poses = graph.poses()
    return len(solids), sum(extents), sum(float(poses[v.name][0, 3]) for v in solids), max(extents, default=0.0)


@functools.cache
def bank(count):
    """Return (images (count, 12, 16), structures) of draws from the prior."""
    prior = document_of(TINY).prior
    rng, evaluator = generator(90), DepthEvaluator(CAMERA, np.ones((12, 16)), "gaussian", VALUES)
    images, keys = [], []
    for _ in range(count):
        graph = prior.sample(rng)
        evaluator.load(graph.solids())
        images.append(evaluator.model_depth().copy())
        keys.append(key_of(graph))
    return np.array(images), keys


def enumerated(image, count):
    """Return {structure: posterior probability} by weighing the bank."""
    images, keys = bank(count)
    logs = -0.5 * np.sum((images - image) ** 2, axis=(1, 2)) / VALUES["sigma"] ** 2
    weights = np.exp(logs - logs.max())
    shares: dict = {}
    for key, weight in zip(keys, weights / weights.sum(), strict=True):
        shares[key] = shares.get(key, 0.0) + float(weight)
    return shares


def calibration(scenes, thin, in_bank):
    """Return (ranks (scenes, figures), {structure: standard errors off}, the same against the enumerated ones)."""
    prior, words = document_of(TINY).prior, Vocabulary(document_of(TINY).prior)
    ranks, found, truths, exact = [], [], [], []
    evaluator = DepthEvaluator(CAMERA, np.ones((12, 16)), "gaussian", VALUES)
    for scene in range(scenes):
        rng = generator(91, scene)
        truth = prior.sample(rng)
        evaluator.load(truth.solids())
        image = evaluator.model_depth() + VALUES["sigma"] * rng.standard_normal((12, 16))
        target = Target(prior, likelihood_of(image))
        before, states = int(rng.integers(STATES + 1)), []
        for length in (before, STATES - before):
            state = evaluate(target, truth)
            for _ in range(length):
                state = walk(rng, target, words, state, thin)
                states.append(state.graph)
        own, others = np.array(figures(truth)), np.array([figures(graph) for graph in states])
        below = (others < own - 1e-12).sum(axis=0)
        ties = (np.abs(others - own) <= 1e-12).sum(axis=0)
        ranks.append(below + rng.integers(ties + 1))
        truths.append(key_of(truth))
        found.append([key_of(graph) for graph in states])
        exact.append(enumerated(image, in_bank))
    off, against = {}, {}
    for key in sorted(set(truths)):
        shares = np.array([np.mean([k == key for k in keys]) for keys in found])
        true = np.array([key == truth for truth in truths], float)
        known = np.array([each.get(key, 0.0) for each in exact])
        for result, difference in ((off, shares - true), (against, shares - known)):
            result[key] = abs(difference.mean()) / max(difference.std(ddof=1) / math.sqrt(scenes), 1e-3)
    return np.array(ranks), off, against


def unevenness(ranks):
    """Return the least probability, over the figures, of ranks as uneven if they were uniform (chi-square, 8 bins)."""
    scenes = len(ranks)
    least = 1.0
    for column in ranks.T:
        counts = np.bincount(column // 2, minlength=(STATES + 1) // 2)
        expected = scenes / len(counts)
        least = min(least, float(chi2.sf(np.sum((counts - expected) ** 2) / expected, len(counts) - 1)))
    return least


@pytest.mark.slow
@pytest.mark.parametrize(("scenes", "thin", "in_bank"), [
    (60, 10, 2500), (300, 20, 20_000)])  # fmt: skip
def test_jumps_are_calibrated_over_structure(scenes, thin, in_bank):
    ranks, off, against = calibration(scenes, thin, in_bank)
    print(f"unevenness {unevenness(ranks):.3g}", {k: (round(off[k], 2), round(against[k], 2)) for k in off})
    assert unevenness(ranks) > UNLIKELY
    assert max(off.values()) < SEVERE
    assert max(against.values()) < SEVERE


@pytest.mark.slow
def test_a_birth_of_wrong_density_is_not(monkeypatch):
    """A birth that forgets that a new object's place and size were drawn with a density."""
    honest = BirthDeath.log_choice

    def forgetful(self, words, graph, choice):
        value = honest(self, words, graph, choice)
        return value - 2.0 if isinstance(choice, Vertex) else value

    monkeypatch.setattr(BirthDeath, "log_choice", forgetful)
    ranks, off, against = calibration(60, 10, 2500)
    print(unevenness(ranks), off, against)
    assert max(*off.values(), *against.values()) > 1.2 * SEVERE or unevenness(ranks) < UNLIKELY / 10
