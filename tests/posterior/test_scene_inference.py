"""Inference with a given structure, as a whole."""

import signal
from types import SimpleNamespace

import numpy as np
import pytest
from invariance import bound
from small_scenes import LOOKED_AT, OPENING, TOWER, SceneWorld, read

from derender.camera.intrinsics import Camera
from derender.errors import DerenderError
from derender.posterior.compiled.backend import backend_of
from derender.posterior.kernels import mixture
from derender.posterior.sampler import Settings, read_settings
from derender.sampling import diagnostics
from derender.structures import given, parts
from derender.structures.given import infer_scene, targets
from derender.structures.options import Options

TWO_NUMBERS = (
    OPENING
    + """
  box:
    shape: {type: box, length: 0.2, width: 0.12, height: 0.1}
    parent: floor
    contact: {type: face-to-face, theta: {uniform: [0, 180 deg]}, x: {normal: [0, 0.05]}, y: 0.0}
likelihood: {type: gaussian, sigma: 0.4, blur: 0.7, background: 1.5}
"""
)
FEW = Settings(draws=300, warmup=100, chains=2)


def image_of(text, seed=4):
    world = SceneWorld(text)
    rng = np.random.default_rng(seed)
    truth = world.space.sample(rng)
    return world, truth, world.target(rng, truth).images.observed


@pytest.mark.parametrize("method", ["mcmc", pytest.param("smc", marks=pytest.mark.slow)])
def test_posterior_of_two_numbers_by_quadrature(method):
    """Means, spreads and correlation against a sum over a 160 x 160 grid; errors judged by their own MCSE."""
    world, _, image = image_of(TWO_NUMBERS)
    target = world._target(image)
    thetas = (np.arange(160) + 0.5) * np.pi / 160
    places = np.linspace(-0.2, 0.2, 160)
    logs = np.empty((160, 160))
    backend = backend_of(target, mixture(world.space, [{"resimulate": {}}]))
    for i, theta in enumerate(thetas):
        for j, x in enumerate(places):
            logs[i, j] = sum(backend.evaluate(np.array([theta, x])))
    weight = np.exp(logs - logs.max())
    weight /= weight.sum()
    theta, x = np.meshgrid(thetas, places, indexing="ij")
    result = infer_scene(world.document, image, world.document.camera, Settings(draws=1500), Options(method, seed=5))
    values = result.posterior.parts[0].values
    tests = {
        "cos": (np.cos(2 * theta), np.cos(2 * values[..., 0])),
        "sin": (np.sin(2 * theta), np.sin(2 * values[..., 0])),
        "x": (x, values[..., 1]),
        "x2": (x**2, values[..., 1] ** 2),
        "x cos": (x * np.cos(2 * theta), values[..., 1] * np.cos(2 * values[..., 0])),
    }
    for name, (exact, drawn) in tests.items():
        expected = float(np.sum(weight * exact))
        if method == "smc":  # particles of one population share ancestors: judged between the populations
            error = np.std(drawn.mean(axis=1), ddof=1) / np.sqrt(len(drawn))
            assert abs(drawn.mean() - expected) < 13 * error, name  # Student's t with 3 degrees of freedom
        else:
            assert abs(drawn.mean() - expected) < bound(len(tests)) * diagnostics.mean_mcse(drawn), name


@pytest.mark.parametrize("kernel", ["drift", "drift-all"])
def test_an_angle_of_which_the_image_says_nothing_is_as_before(kernel):
    """No step about its circle is refused, so that steps grew until all of them were rounded to 0: draws of a uniform
    angle were 0 and 90 degrees alone, with an R-hat of one."""
    text = TWO_NUMBERS.replace("{normal: [0, 0.05]}", "0.0").replace("sigma: 0.4", "sigma: 10")
    world, _, image = image_of(text)
    settings = Settings(kernels=[{kernel: None}], draws=300, warmup=400, chains=2)
    result = infer_scene(world.document, image, world.document.camera, settings, Options("mcmc", seed=5))
    counts = np.histogram(result.posterior.parts[0].values, 6, (0.0, np.pi))[0]
    assert np.abs(counts - 100).max() < 45  # each has a standard deviation of 9.1, were the draws independent


@pytest.mark.slow
def test_a_wrong_posterior_is_seen():
    """The quadrature test's twin: chains on another image disagree with this one's grid by many standard errors."""
    world, _, image = image_of(TWO_NUMBERS)
    _, _, other = image_of(TWO_NUMBERS, seed=11)
    means = [
        infer_scene(world.document, picture, world.document.camera, Settings(draws=500), Options(seed=5))
        .posterior.parts[0]
        .values[..., 1]
        for picture in (image, other)
    ]
    error = np.hypot(*(diagnostics.mean_mcse(values) for values in means))
    assert abs(means[0].mean() - means[1].mean()) > bound(5) * error


@pytest.mark.slow
@pytest.mark.parametrize("text", [TOWER, LOOKED_AT], ids=["tower", "looked-at"])
def test_same_bytes_for_any_jobs(text):
    world, _, image = image_of(text)
    one, two = (infer_scene(world.document, image, world.document.camera, FEW, Options(jobs=jobs)) for jobs in (1, 2))
    np.testing.assert_array_equal(one.posterior.parts[0].values, two.posterior.parts[0].values)
    np.testing.assert_array_equal(one.posterior.parts[0].log_likelihood, two.posterior.parts[0].log_likelihood)


@pytest.mark.slow
def test_resumed_run_equals_an_uninterrupted_one(tmp_path, monkeypatch):
    from derender.sampling import chains

    world, _, image = image_of(TOWER)
    whole = infer_scene(world.document, image, world.document.camera, FEW)
    calls = iter(range(10_000))
    genuine = chains.run_chain
    monkeypatch.setattr(
        "derender.sampling.chains.run_chain",
        lambda plan, number, stop, progress: genuine(plan, number, lambda: next(calls) >= 3, progress),
    )
    infer_scene(world.document, image, world.document.camera, FEW, Options(folder=tmp_path))
    monkeypatch.undo()
    again = infer_scene(world.document, image, world.document.camera, FEW, Options(folder=tmp_path, resume=True))
    np.testing.assert_array_equal(again.posterior.parts[0].values, whole.posterior.parts[0].values)


@pytest.mark.parametrize(("done", "shape"), [(0, (1, 1)), (2, (2, 16))])
def test_particles_that_someone_stops_leave_the_populations_that_are_done_or_their_best(monkeypatch, done, shape):
    genuine, begun = given.tempered, []

    def tempered(*arguments, **how):
        begun.append(0)
        if len(begun) > done:
            signal.raise_signal(signal.SIGINT)
        return genuine(*arguments, **how)

    monkeypatch.setattr(given, "SMC_PARTICLES", 16)
    monkeypatch.setattr(given, "SMC_STEPS", 2)
    monkeypatch.setattr(given, "tempered", tempered)
    world, _, image = image_of(TOWER)
    result = infer_scene(world.document, image, world.document.camera, Settings(chains=4), Options("smc"))
    assert result.interrupted and len(begun) == done + 1
    found = result.posterior.parts[0].log_density
    assert found.shape == shape and np.isfinite(found).all()


def test_chains_that_disagree_go_on_as_if_never_stopped(monkeypatch):
    twice = lambda target, outcome, draws, closely: 40 if draws < 40 else 0  # noqa: E731  so often they disagree
    monkeypatch.setattr(parts, "_enough", twice)
    world, _, image = image_of(TOWER)
    few = Settings(draws=10, warmup=20, chains=2, thin=2, population=1)
    shapes = []
    for settings in (few, few._replace(goes_on=True)):
        part = infer_scene(world.document, image, world.document.camera, settings).posterior.parts[0]
        shapes.append(part.values.shape[1])
    assert shapes == [10, 40]
    straight = infer_scene(world.document, image, world.document.camera, few._replace(draws=shapes[1]))
    # to rounding: where objects stayed as others moved is placed anew from their contacts when chains go on
    np.testing.assert_allclose(straight.posterior.parts[0].values, part.values, rtol=0.0, atol=1e-9)


def test_chains_that_are_apart_need_more_draws_and_others_none():
    world, truth, image = image_of(TOWER)
    rng, target = np.random.default_rng(0), world._target(image)
    for apart, more in ((0.0, False), (0.01, True)):
        places = [truth + apart * k + 1e-3 * rng.standard_normal((400, len(truth))) for k in range(2)]
        outcome = SimpleNamespace(records={k: SimpleNamespace(values=values) for k, values in enumerate(places)})
        assert (parts._enough(target, outcome, 400, True) > 400) == more


def test_map_is_one_scene_no_worse_than_the_truth():
    world, truth, image = image_of(TOWER)
    result = infer_scene(world.document, image, world.document.camera, FEW, Options("map"))
    part = result.posterior.parts[0]
    assert part.values.shape[:2] == (1, 1)
    target = world._target(image)
    assert part.log_density[0, 0] > target.log_prior(truth) + target.log_likelihood(truth)


def test_open_faces_become_weighted_structures():
    """A box that lies on one of two faces with unlike heights: the image says which."""
    faces = "child_face: {categorical: {-z: 1, -x: 1}}, "
    text = TWO_NUMBERS.replace("type: face-to-face, ", f"type: face-to-face, {faces}")
    text = text.replace("sigma: 0.4", "sigma: 0.05")
    document = read(text)
    world = SceneWorld(text)
    rng = np.random.default_rng(2)
    truth = world.space.sample(rng)
    image = world.target(rng, truth).images.observed
    result = infer_scene(document, image, document.camera, FEW)
    best = result.posterior.best_part
    assert best.weight > 0.95
    assert best.graph.structure() == world.template.structure()


def boxes_on_any_face(count: int) -> str:
    faces = "{categorical: {-z: 1, -x: 1, +x: 1, -y: 1, +y: 1, +z: 1}}"
    return "".join(
        f"""
  box_{k}:
    shape: {{type: box, length: 0.1, width: 0.08, height: 0.06}}
    parent: floor
    contact: {{type: face-to-face, child_face: {faces}, theta: {{uniform: [0, 180 deg]}}, x: {0.2 * k}, y: 0}}"""
        for k in range(count)
    )


def test_no_structure_is_overlooked(monkeypatch):
    """Three boxes on any of six faces: 216 ways, eight of each say the same, and the 27 are equally likely."""
    head = "derender: 1\nroot: {distance: 1, elevation: 40 deg}\n"
    head += "objects:\n  floor: {shape: plane, contact: {type: 6dof}}"
    image, camera = np.ones((18, 24)), Camera.from_field_of_view(24, 18)
    found = targets(read(head + boxes_on_any_face(3) + "\n"), image, camera, 0)
    assert len(found) == 27
    np.testing.assert_allclose([density for _, density in found], np.log(1 / 27), atol=1e-9)
    monkeypatch.setattr(given, "MOST_STRUCTURES", 8)
    with pytest.raises(DerenderError, match="more than 8 combinations of parents and faces open"):
        targets(read(head + boxes_on_any_face(2) + "\n"), image, camera, 0)


def test_settings_are_data():
    text = TOWER + "inference: {kernels: [{resimulate: {weight: 1}}, drift], thin: 3, draws: 7}\n"
    settings = read_settings(read(text).inference)
    assert settings.kernels == [{"resimulate": {"weight": 1}}, {"drift": None}]
    assert settings.thin == 3 and settings.draws == 7
    assert read_settings(None) == Settings()


@pytest.mark.parametrize(
    "section, what", [("{kernel: []}", "kernels"), ("{thin: 0}", "thin"), ("{kernels: [3]}", "not a name with options")]
)
def test_faults_in_settings_are_told(section, what):
    with pytest.raises(DerenderError, match=what):
        read_settings(read(TOWER + f"inference: {section}\n").inference)


def test_nothing_unknown_is_told():
    document = read(TWO_NUMBERS.replace("{uniform: [0, 180 deg]}", "0.3").replace("{normal: [0, 0.05]}", "0.0"))
    with pytest.raises(DerenderError, match="nothing is unknown"):
        infer_scene(document, np.ones((18, 24)), document.camera)
