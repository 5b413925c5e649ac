"""The sweep compiled and interpreted: the same random numbers must give the same steps."""

from types import SimpleNamespace

import numpy as np
import pytest
from invariance import State, bound, verdict
from small_scenes import SCENES, TOWER, SceneWorld

from derender.posterior.compiled.backend import CompiledBackend, InterpretedBackend, backend_of
from derender.posterior.compiled.model import NotCompiled
from derender.posterior.kernels.base import first_tuning, kernels, mixture
from derender.posterior.sampler import Settings
from derender.scene.contacts import contacts
from derender.structures.given import infer_scene

EVERY = list(kernels)
ALIKE = [name for name in EVERY if not kernels[name].keeps_children]  # Python knows no places in the world


@pytest.fixture(scope="module", params=SCENES)
def world(request):
    return SceneWorld(SCENES[request.param])


def both(world, names):
    rng = np.random.default_rng(2)
    target = world.target(rng, world.sample(rng))
    parts = mixture(world.space, [{name: {}} for name in names])
    return target, parts, CompiledBackend(target, parts), InterpretedBackend(target, parts)


def test_same_random_numbers_same_steps(world):
    """Step by step, at several temperatures: the same kernel, the same decision, the same values to rounding."""
    target, parts, compiled, plain = both(world, ALIKE)
    values = world.sample(np.random.default_rng(1))
    archive = np.array([world.sample(np.random.default_rng(n)) for n in range(8)])
    moved = 0
    for number in range(200):
        tuning = first_tuning(world.space, values)._replace(
            temperature=(1.0, 0.1, 0.003)[number % 3], archive=archive if number % 2 else None
        )
        fast = compiled.sweep(np.random.default_rng(number), values, tuning, 1, 1)
        slow = plain.sweep(np.random.default_rng(number), values, tuning, 1, 1)
        np.testing.assert_array_equal(fast.counts, slow.counts)
        np.testing.assert_allclose(fast.values, slow.values, rtol=0, atol=1e-9)
        np.testing.assert_allclose(fast.densities, slow.densities, rtol=1e-9, atol=1e-6)
        moved += int(slow.counts[:, 1].sum())
        values = slow.values[-1]
        if number % 20 == 19:  # the posterior is narrow: begin elsewhere, so that bold steps are accepted too
            values = world.sample(np.random.default_rng(number))
    assert moved > 30


def test_long_sweep_equals_fresh_evaluation(world):
    """After thousands of incremental steps the density carried along is still that of the values."""
    target, parts, compiled, plain = both(world, EVERY)
    values = world.sample(np.random.default_rng(1))
    tuning = first_tuning(world.space, values)._replace(temperature=0.01)
    stretch = compiled.sweep(np.random.default_rng(3), values, tuning, 50, 200)
    for place in (10, 49):
        expected = plain.evaluate(stretch.values[place])
        np.testing.assert_allclose(stretch.densities[place], expected, rtol=1e-9, atol=1e-6)
    assert stretch.counts[:, 0].sum() == 10_000 and stretch.counts[:, 1].sum() > 300


def test_every_kernel_was_met():
    """Between them the scenes give every kernel something to do."""
    met = set()
    for text in SCENES.values():
        world = SceneWorld(text)
        met |= {part.type for part in mixture(world.space, [{name: {}} for name in EVERY])}
    assert met == set(EVERY)


def verdict_of_sweeps(world, without_terms=False):
    """Return the invariance test's verdict on compiled sweeps; `without_terms` the sweep forgets the constraints."""
    parts = mixture(world.space, [{name: {}} for name in EVERY])

    def make(target):
        backend = CompiledBackend(target, parts)
        if without_terms:
            backend.model = backend.model._replace(terms_at=0)
        tuning = first_tuning(world.space, world.space.sample(np.random.default_rng(9)))

        def kernel(rng, state):
            stretch = backend.sweep(rng, state.values, tuning, 1, 250)
            prior, likelihood = stretch.densities[-1]
            if without_terms:  # its own log prior is another function of the values: the test is of one
                prior = max(target.log_prior(stretch.values[-1]), -1e3)
            return State(stretch.values[-1], float(prior), float(likelihood)), bool(stretch.counts[:, 1].sum())

        return kernel

    return verdict(world, make, 250, steps=1, until_caught=without_terms)


@pytest.mark.slow
def test_scene_posterior_is_invariant(world):
    """The invariance test of the kernels, on images, through the compiled sweep."""
    result = verdict_of_sweeps(world)
    assert result.moved > 0.5
    assert result.worst < bound(len(result.z)), result


def test_a_sweep_that_forgets_the_constraints_is_caught():
    world = SceneWorld(SCENES["bound"])
    result = verdict_of_sweeps(world, without_terms=True)
    assert result.worst > bound(len(result.z))


BLURRED = TOWER.replace("sigma: 0.05, blur: 0.7", "sigma: {log-uniform: [0.02, 0.2]}, blur: {uniform: [0.3, 2]}")
ROBUST = TOWER.replace(
    "type: gaussian, sigma: 0.05",
    "type: robust, sigma: {log-uniform: [0.02, 0.2]}, outlier: {beta: [2, 8]}, missing: {uniform: [0.001, 0.2]}",
)
WALLED = ROBUST.replace("blur: 0.7, background: 1.5", "blur: {uniform: [0, 1]}, background: {uniform: [0.5, 1.5]}")
SHARING = TOWER.replace(
    "type: gaussian,", "type: correlated, shared: {uniform: [0.2, 0.9]}, clump: {uniform: [0.01, 0.5]},"
)
KRIGED = SHARING.replace("clump:", "step: {uniform: [0.001, 0.01]}, clump:")  # takes more than scoring the image


@pytest.mark.parametrize("text", [BLURRED, ROBUST, WALLED, SHARING, KRIGED],
                         ids=["blurred", "robust", "walled", "sharing", "kriged"])  # fmt: skip
def test_long_sweeps_of_a_likelihoods_numbers_equal_fresh_evaluations(text):
    """Numbers that take scoring or drawing all of the image are compiled steps, but for what only Python makes."""
    target, parts, compiled, plain = both(SceneWorld(text), EVERY)
    assert bool(compiled._elsewhere) == (text is KRIGED)
    values = target.space.sample(np.random.default_rng(1))
    tuning = first_tuning(target.space, values)._replace(temperature=0.05)
    stretch = compiled.sweep(np.random.default_rng(3), values, tuning, 50, 20)
    open_ones = [place for place, name in enumerate(target.space.addresses) if name.startswith("likelihood.")]
    assert np.all(np.ptp(stretch.values[:, open_ones], axis=0) > 0.0), "or it tests nothing"
    for place in (0, 10, 25, 49):
        np.testing.assert_allclose(
            stretch.densities[place], plain.evaluate(stretch.values[place]), rtol=1e-9, atol=1e-6
        )


@pytest.mark.parametrize("text", [BLURRED, WALLED, KRIGED], ids=["blurred", "walled", "kriged"])
def test_likelihood_numbers_change_as_interpreted(text):
    """Numbers that mean to draw or score the image anew, and rows of steps: those of the interpreted mixture."""
    world = SceneWorld(text)
    target, parts, compiled, plain = both(world, ALIKE)
    values, moved = world.space.sample(np.random.default_rng(5)), 0
    for number in range(120):
        tuning = first_tuning(world.space, values)._replace(temperature=(1.0, 0.1, 0.003)[number % 3])
        fast = compiled.sweep(np.random.default_rng(number), values, tuning, 3, 2)
        slow = plain.sweep(np.random.default_rng(number), values, tuning, 3, 2)
        np.testing.assert_array_equal(fast.counts, slow.counts)
        np.testing.assert_allclose(fast.values, slow.values, rtol=0, atol=1e-9)
        np.testing.assert_allclose(fast.densities, slow.densities, rtol=1e-9, atol=1e-6)
        moved += int(slow.counts[:, 1].sum())
        values = slow.values[-1]
    assert moved > 30
    assert isinstance(backend_of(target, parts), CompiledBackend)


def test_what_has_no_compiled_form_says_so(monkeypatch):
    world = SceneWorld(TOWER)
    parts = mixture(world.space, [{"resimulate": {}}])
    with monkeypatch.context() as ruled:
        ruled.setattr(world.blank, "constraints", (SimpleNamespace(name="harmony"),))
        with pytest.raises(NotCompiled, match="the constraint harmony"):
            CompiledBackend(world.blank, parts)
    monkeypatch.setattr(contacts["face-to-face"], "compiled_code", None)
    with pytest.raises(NotCompiled, match="the contact type face-to-face"):
        CompiledBackend(world.blank, parts)
    assert isinstance(backend_of(world.blank, parts), InterpretedBackend)
    told = []
    settings = Settings(kernels=[{"resimulate": {}}], draws=5, warmup=0, chains=1, population=1, thin=1)
    image = np.full((18, 24), 0.7)
    infer_scene(world.document, image, world.document.camera, settings, warn=told.append)
    assert told == ["chains run uncompiled, a hundred times slower: there is no compiled form of the contact type "
                    "face-to-face"]  # fmt: skip
