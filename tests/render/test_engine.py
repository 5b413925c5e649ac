"""The engine against the readable likelihoods, and its incremental values against its full ones."""

import numpy as np
import pytest
from random_scenes import random_solids

from derender.camera.intrinsics import Camera
from derender.render.likelihoods import likelihoods
from derender.render.raycast.depth import render_depth
from derender.render.raycast.engine import load_state, propose_state, settle_state
from derender.render.raycast.evaluator import DepthEvaluator
from derender.render.raycast.state import CANDIDATE, CURRENT, DEPTH, PAD, SCORE
from derender.scene.solids import BOX, CYLINDER, MESH, PLANE, SPHERE, Solids

CAMERAS = [Camera(61, 61, 31.5, 31.5, 64, 64), Camera(152, 152, 79.5, 59.5, 160, 120), Camera(40, 42, 17, 12, 37, 29)]
CASES = [
    ("gaussian", {"blur": 1.0}),
    ("gaussian", {"blur": 0.0}),
    ("gaussian", {"blur": 3.0}),
    ("robust", {"blur": 0.6}),
    ("robust", {"blur": 0.6, "missing": 0.1, "missing_edge": 0.1}),
    ("robust", {"blur": 2.0, "sigma_growth": 0.002}),
    ("robust", {"blur": 0.3, "sigma_growth": 0.002, "missing": 0.1, "missing_edge": 0.1}),
    ("robust", {"blur": 0.3, "missing": 0.1, "missing_edge": 0.1, "flying": 0.4}),
    ("robust", {"blur": 1.2, "sigma_growth": 0.002, "flying": 0.1, "edge_step": 0.05}),
    ("correlated", {"blur": 0.6, "sigma_growth": 0.002, "outlier": 0.05}),
    ("correlated", {"blur": 0.0, "reach": 2.0, "shared": 0.6, "clump": 0.2}),
]


def proposed(evaluator, indices, poses, sizes):
    """Return the log likelihood with solids `indices` at `poses` (n, 4, 4) and `sizes` (n, 3); settle it after."""
    return propose_state(evaluator.state, len(indices), np.array(indices), poses.copy(), sizes.copy())


def observe(rng, solids, camera, likelihood, values):
    depth, _ = render_depth(solids, camera)
    observed = likelihoods[likelihood].sample(rng, depth, values)
    observed[rng.uniform(size=observed.shape) < 0.05] = np.nan
    if likelihood != "gaussian":  # what is no part of the scene
        observed[rng.uniform(size=observed.shape) < 0.1] *= -1.0
    return observed


@pytest.mark.parametrize("likelihood, values", CASES)
def test_the_engine_equals_the_readable_likelihood(likelihood, values):
    rng = np.random.default_rng(1)
    for trial in range(12):
        camera = CAMERAS[trial % 3]
        solids = random_solids(rng, 6)
        observed = observe(rng, solids, camera, likelihood, values)
        moved = solids._replace(pose=solids.pose.copy())
        moved.pose[:, :3, 3] += rng.normal(scale=0.003, size=(6, 3))
        evaluator = DepthEvaluator(camera, observed, likelihood, values)
        value = evaluator.log_likelihood(moved)
        # From the engine's own clean depth, so that only blur and density are compared (the depth itself: next test).
        expected = likelihoods[likelihood].per_pixel(observed, evaluator.model_depth().astype(float), values)
        # float32 sums a blurred depth of 10 m to 5e-6 m, 1e-3 sigma: with z = residual / sigma, log density -z^2 / 2
        # is then off by 1e-3 |z|, besides the relative rounding of z^2.
        allowed = 2e-3 * (1.0 + np.sqrt(np.abs(expected))) + 1e-6 * np.abs(expected)
        wrong = np.abs(evaluator.per_pixel() - expected) > allowed
        # A step of `edge_step` to the last bit may count as an edge in float64 and not in float32.
        assert wrong.sum() <= (0 if likelihood == "gaussian" else 2)
        if not wrong.any():
            assert value == pytest.approx(expected.sum(), abs=np.sqrt(np.sum(allowed**2)))


@pytest.mark.parametrize("outlier", [1e-30, 1e-4, 0.1, 0.9])
def test_noise_that_is_the_same_everywhere_is_scored_to_rounding(outlier):
    values = {"sigma": 0.01, "blur": 0.0, "missing": 0.1, "missing_edge": 0.1, "outlier": outlier, "far": 3.0}
    off = 0.01 * np.linspace(-12.0, 12.0, 4096)  # from surfaces through where outliers take over to outliers alone
    observed = 1.0 + np.concatenate([off, np.full(60, np.nan), np.full(60, 4.0)]).reshape(62, 68)
    observed[5] *= -1.0  # what may be hidden
    observed = observed.astype(np.float32).astype(float)
    depth = np.ones(observed.shape)
    scores = DepthEvaluator.of_depth(observed, depth, "robust", values)
    scores.set_values({})
    expected = likelihoods["robust"].per_pixel(observed, depth, values)
    assert scores.per_pixel() == pytest.approx(expected, abs=2e-5)  # some roundings of up to 12^2 / 2 to float32


def test_clean_depth_is_within_a_hundredth_of_a_millimetre():
    rng = np.random.default_rng(2)
    worst, pixels, wrong = 0.0, 0, 0
    for trial in range(60):
        camera = CAMERAS[trial % 3]
        solids = random_solids(rng, 6)
        evaluator = DepthEvaluator(camera, np.ones(camera.shape))
        evaluator.load(solids)
        exact = np.fmin(render_depth(solids, camera)[0], 10.0)
        difference = np.abs(evaluator.model_depth() - exact) / np.maximum(exact, 1.0) ** 2
        edge = difference > 1e-3
        pixels, wrong = pixels + edge.size, wrong + int(edge.sum())
        worst = max(worst, difference[~edge].max())
    assert worst < 1e-4  # at the limb of a sphere; elsewhere a hundred times less
    assert wrong < 1e-4 * pixels


def _wander(state, fresh, moves, count, indices, steps, choices):
    """Make random moves of random sets of solids; return the greatest relative difference from a full evaluation."""
    worst = 0.0
    total = state.kind.shape[1]
    chosen, pose, size = np.empty(total, np.int64), np.empty((total, 4, 4)), np.empty((total, 3))
    for n in range(moves):
        many = int(1 + choices[n, 0] % count)
        for k in range(many):
            index = indices[(choices[n, 1] + k) % len(indices)]
            chosen[k], pose[k], size[k] = index, state.pose[0, index], state.size[0, index]
            for axis in range(3):
                pose[k, axis, 3] += steps[n, axis]
                if pose[k, axis, 3] > 1.3 or pose[k, axis, 3] < (0.25 if axis == 2 else -0.5):
                    pose[k, axis, 3] -= 2.0 * steps[n, axis]
        value = propose_state(state, many, chosen, pose, size)
        if n % choices[0, 3] == 0:
            full = load_state(fresh, state.pose[1], state.size[1])
            worst = max(worst, abs(value - full) / abs(full))
        if choices[n, 2] % 2 == 0:
            settle_state(state, CANDIDATE)
        else:
            settle_state(state, CURRENT)
    return worst


def wander(rng, solids, camera, likelihood, values, moves, every, most=3, step=0.02):
    observed = observe(rng, solids, camera, likelihood, values)
    one, other = (DepthEvaluator(camera, observed, likelihood, values) for _ in range(2))
    one.load(solids)
    other.load(solids)
    movable = np.flatnonzero(solids.kind != PLANE)
    steps = rng.normal(size=(moves, 3)) * step * 10.0 ** rng.uniform(-2, 0.7, size=(moves, 1))
    choices = rng.integers(0, 1 << 30, size=(moves, 4))
    choices[0, 3] = every
    worst = _wander(one.state, other.state, moves, min(most, len(movable)), movable, steps, choices)
    return worst, one.state, other.state


@pytest.mark.parametrize("likelihood, values", CASES)
def test_incremental_equals_full(likelihood, values):
    rng = np.random.default_rng(5)
    kinds = np.array([PLANE, BOX, BOX, SPHERE, CYLINDER, MESH])
    for camera in CAMERAS:
        solids = random_solids(rng, 6)
        while set(solids.kind) != set(kinds):
            solids = random_solids(rng, 6)
        worst, *_ = wander(rng, solids, camera, likelihood, values, 300, 1)
        assert worst < 1e-9


@pytest.mark.slow
def test_incremental_equals_full_over_a_million_moves():
    rng = np.random.default_rng(6)
    solids = random_solids(rng, 6, (BOX, BOX, SPHERE, CYLINDER))
    worst, state, _ = wander(rng, solids, CAMERAS[0], "gaussian", {"blur": 1.0}, 1_000_000, 10)
    assert worst < 1e-9
    assert state.total[CURRENT] == pytest.approx(state.images[SCORE + CURRENT].sum(dtype=np.float64), rel=1e-12)


def test_incremental_equals_full_over_many_moves():
    rng = np.random.default_rng(7)
    solids = random_solids(rng, 6, (BOX, BOX, SPHERE, CYLINDER))
    worst, *_ = wander(rng, solids, CAMERAS[0], "gaussian", {"blur": 1.0}, 40_000, 4)
    assert worst < 1e-9


def test_the_comparison_notices_a_region_that_is_too_small():
    """The broken twin: without the blur's margin incremental values drift off."""
    rng = np.random.default_rng(8)
    solids = random_solids(rng, 5, (BOX, SPHERE))
    camera = CAMERAS[0]
    observed = observe(rng, solids, camera, "gaussian", {"blur": 1.0})
    one, other = (DepthEvaluator(camera, observed, "gaussian", {"blur": 1.0}) for _ in range(2))
    one.load(solids)
    other.load(solids)
    one.state.settings[3] = 0  # MARGIN
    steps, choices = rng.normal(scale=0.01, size=(200, 3)), rng.integers(0, 1 << 30, size=(200, 4))
    choices[0, 3] = 1
    assert _wander(one.state, other.state, 200, 1, np.arange(5), steps, choices) > 1e-6


def test_a_rejected_proposal_leaves_no_trace():
    rng = np.random.default_rng(9)
    solids = random_solids(rng, 6)
    evaluator = DepthEvaluator(CAMERAS[0], observe(rng, solids, CAMERAS[0], "gaussian", {}))
    before = evaluator.load(solids)
    proposed(evaluator, [1], solids.pose[1:2], solids.size[1:2])
    settle_state(evaluator.state, CURRENT)
    images = evaluator.state.images.copy()
    for _ in range(20):
        pose = solids.pose[1:3].copy()
        pose[:, :3, 3] += rng.normal(scale=0.05, size=(2, 3))
        proposed(evaluator, [1, 2], pose, solids.size[1:3])
        settle_state(evaluator.state, CURRENT)
    shown = slice(PAD, PAD + 64)
    for image in (DEPTH + CURRENT, DEPTH + CANDIDATE, SCORE + CURRENT):
        np.testing.assert_array_equal(evaluator.state.images[image][:, shown], images[image][:, shown])
    assert proposed(evaluator, [1], solids.pose[1:2], solids.size[1:2]) == pytest.approx(before, rel=1e-12)


def test_two_evaluators_do_not_know_each_other():
    rng = np.random.default_rng(11)
    solids = [random_solids(rng, 4), random_solids(rng, 4)]
    observed = [observe(rng, one, CAMERAS[0], "gaussian", {}) for one in solids]
    evaluators = [DepthEvaluator(CAMERAS[0], image) for image in observed]
    alone = [DepthEvaluator(CAMERAS[0], image).load(one) for image, one in zip(observed, solids, strict=True)]
    together = [evaluator.load(one) for evaluator, one in zip(evaluators, solids, strict=True)]
    moved = [proposed(e, [1], s.pose[1:2], s.size[1:2]) for e, s in zip(evaluators, solids, strict=True)]
    assert together == alone
    assert moved == pytest.approx(alone, rel=1e-12)


@pytest.mark.parametrize("likelihood", ["gaussian", "robust", "correlated"])
def test_changed_noise_needs_no_rendering(likelihood):
    rng = np.random.default_rng(12)
    solids = random_solids(rng, 4)
    observed = observe(rng, solids, CAMERAS[0], likelihood, {})
    evaluator = DepthEvaluator(CAMERAS[0], observed, likelihood)
    evaluator.load(solids)
    for changed in ({"sigma": 0.02}, {"sigma": 0.003, "blur": 1.0}, {"background": 2.0}):
        value = evaluator.set_values(changed)
        fresh = DepthEvaluator(CAMERAS[0], observed, likelihood, evaluator.values)
        assert value == pytest.approx(fresh.load(solids), rel=1e-12)
    assert evaluator.log_likelihood(solids, {"sigma": 0.01}) == pytest.approx(
        DepthEvaluator(CAMERAS[0], observed, likelihood, {**evaluator.values}).load(solids), rel=1e-12
    )


@pytest.mark.parametrize("likelihood", ["gaussian", "robust", "correlated"])
def test_a_changed_blur_keeps_the_engine(likelihood):
    """One set of images serves every blur, in full and for moves: the values are those of an engine made for it."""
    rng = np.random.default_rng(14)
    solids = random_solids(rng, 4)
    observed = observe(rng, solids, CAMERAS[0], likelihood, {})
    evaluator = DepthEvaluator(CAMERAS[0], observed, likelihood)
    evaluator.load(solids)
    images = evaluator.state.images
    for pixels in (0.0, 0.3, 0.32, 1.0, 2.5, 0.6):
        fresh = DepthEvaluator(CAMERAS[0], observed, likelihood, {"blur": pixels})
        assert evaluator.set_values({"blur": pixels}) == pytest.approx(fresh.load(solids), rel=1e-12)
        moved = solids.pose[1:2] + rng.normal(0, 0.01, (1, 4, 1)) * [0, 0, 0, 1]
        assert proposed(evaluator, [1], moved, solids.size[1:2]) == proposed(fresh, [1], moved, solids.size[1:2])
        settle_state(evaluator.state, CURRENT)
    assert evaluator.state.images is images


def test_a_scene_with_other_solids_gets_a_new_state():
    rng = np.random.default_rng(13)
    evaluator = DepthEvaluator(CAMERAS[0], np.ones((64, 64)))
    for count in (3, 5, 2):
        solids = random_solids(rng, count)
        assert evaluator.load(solids) == DepthEvaluator(CAMERAS[0], np.ones((64, 64))).load(solids)
    empty = Solids(np.zeros(0, np.int32), np.zeros((0, 4, 4)), np.zeros((0, 3)), np.zeros(0, np.int32))
    depth = np.full((64, 64), np.nan)
    expected = likelihoods["gaussian"].log_density(np.ones((64, 64)), depth)
    assert evaluator.load(empty) == pytest.approx(expected, rel=1e-6)
