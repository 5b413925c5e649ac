"""Draws and weights of structures: the chart, the prior's integrals, the walk, the evidence against quadrature."""

import itertools
import math
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest

import derender
from derender.camera.depth_file import DepthImage
from derender.camera.intrinsics import Camera
from derender.detection.search.greedy import Settings
from derender.detection.solids.beliefs import Rules, bare_image
from derender.detection.solids.graph import TILTS, matched_names, names_of, scene_graph, structure_key
from derender.detection.solids.image import ROW, make_row
from derender.detection.solids.state import FLOOR, State
from derender.errors import DerenderError
from derender.render.likelihoods import likelihoods
from derender.render.raycast.evaluator import DepthEvaluator
from derender.report.tables import parameter_rows
from derender.results.trust import doubtful
from derender.scene.graph import Contact, Vertex
from derender.scene.pose import inverse, rotation_x, rotation_z
from derender.scene.solids import BOX, CYLINDER, SPHERE
from derender.structures import graph_posterior
from derender.structures.case import CHAINS, DRAWS
from derender.structures.draws import chart as charts
from derender.structures.draws import metropolis
from derender.structures.draws.chart import (
    camera_poses,
    log_prior,
    log_prior_about,
    make_chart,
    place_rows,
    solid_log_prior,
    touching_area,
)
from derender.structures.draws.curvature import Curvature
from derender.structures.draws.metropolis import Draws, engine_of, evaluate, load, log_evidence, run, sample, walker_at
from derender.structures.draws.numbers import numbers_of_draws, scene_log_prior
from derender.structures.draws.refined import Refined, agreed, chains_of, structure_posterior
from derender.structures.draws.sensor import (
    RATES,
    Sensor,
    final_sensor,
    first_sensor,
    image_likelihood,
    model_depth,
    noise_of,
)
from derender.structures.draws.steps import (
    FIRST,
    FLOOR_SHARE,
    WIDER,
    Step,
    block_steps,
    factor_of_inverse,
    floor_step,
    inverse_of,
    make_proposals,
    own_members,
    single_steps,
    touched_by,
)
from derender.structures.graph_posterior import MOST_PARTS, independent_parts, leading
from derender.structures.weighing import Weighed

UPRIGHT, FREE = 0, 1


def floor_pose(elevation=0.7, distance=0.7):
    """The floor frame's pose in front of a camera that looks down by `elevation` radians at its origin."""
    pose = rotation_x(math.pi / 2 + elevation)
    pose[:3, 3] = 0.0, 0.0, distance
    return pose


def row(kind, theta, x, y, bottom, size):
    return make_row(kind, rotation_z(theta)[:3, :3], np.array([x, y, bottom + size[2] / 2]), np.array(size, float))


def stack():
    """A cube on the floor, a box on it, a cylinder and a sphere beside them."""
    state = State()
    state = state.add(row(BOX, 0.3, 0.0, 0.0, 0.0, (0.08, 0.08, 0.08)), UPRIGHT, True, FLOOR, 0.0)
    state = state.add(row(BOX, 0.9, 0.01, -0.01, 0.08, (0.06, 0.09, 0.05)), UPRIGHT, False, 0, 0.08)
    state = state.add(row(CYLINDER, 0.0, 0.15, 0.0, 0.0, (0.05, 0.05, 0.09)), UPRIGHT, False, FLOOR, 0.0)
    return state.add(row(SPHERE, 0.0, -0.13, 0.05, 0.0, (0.06, 0.06, 0.06)), UPRIGHT, False, FLOOR, 0.0)


def cube(side=0.08, theta=0.4):
    return State().add(row(BOX, theta, 0.0, 0.0, 0.0, (side,) * 3), UPRIGHT, True, FLOOR, 0.0)


def camera(width, height):
    return Camera(0.9 * width, 0.9 * width, (width - 1) / 2, (height - 1) / 2, width, height)


def observe(rng, state, values, view, name="gaussian"):
    """Return the Sensor of an image of a state at its own coordinates."""
    likelihood = likelihoods[name]
    chart, start = make_chart(state, floor_pose(), Rules(0.0015))
    clean = model_depth(chart, start, view)
    values = likelihood.complete(values)
    return Sensor(view, likelihood.sample(rng, clean, values), likelihood, values), chart, start


def rows_at(chart, values):
    rows = np.empty((len(chart.flags), ROW))
    place_rows(chart, values, rows)
    return rows


def test_chart_starts_at_the_state():
    state = stack()
    chart, values = make_chart(state, floor_pose(), Rules(0.0015))
    spun = rows_at(chart, values)
    # all but the sphere's rotation, which says nothing, to rounding
    np.testing.assert_allclose(spun[:3], state.rows[:3], atol=1e-12)
    np.testing.assert_allclose(spun[3, 10:], state.rows[3, 10:], atol=1e-12)


@pytest.mark.parametrize("tilt, stands", [(0.0, True), (2.0, True), (-2.0, True), (4.0, False)])
def test_what_tilts_as_a_floor_does_stands_upright_and_what_tilts_more_may_turn(tilt, stands):
    turned = rotation_z(0.4)[:3, :3] @ rotation_x(np.radians(tilt))[:3, :3]
    state = State().add(make_row(BOX, turned, [0, 0, 0.05], [0.1, 0.12, 0.1]), UPRIGHT, False, FLOOR, 0.0)
    chart, values = make_chart(state, floor_pose(), Rules(0.0015))
    assert bool(chart.flags[0, charts.VERTICAL]) == stands
    started = rows_at(chart, values)[0, 1:10].reshape(3, 3)
    np.testing.assert_allclose(started, rotation_z(0.4)[:3, :3] if stands else turned, atol=1e-3)
    np.testing.assert_allclose(started @ started.T, np.eye(3), atol=1e-12)
    assert not stands or started[2, 2] == 1.0


def test_what_stands_on_a_support_rises_with_it_and_stays_in_place():
    chart, values = make_chart(stack(), floor_pose(), Rules(0.0015))
    before = rows_at(chart, values)
    values[chart.slots[0, charts.SIZE]] += 0.01
    values[chart.slots[0, charts.X]] += 0.02
    after = rows_at(chart, values)
    np.testing.assert_allclose(after[1, 12] - before[1, 12], 0.01, atol=1e-12)
    np.testing.assert_array_equal(after[1, :12], before[1, :12])
    np.testing.assert_array_equal(after[2:], before[2:])


def test_numbers_of_draws_place_the_graph_where_the_chart_does():
    rng = np.random.default_rng(1)
    state = stack()
    chart, values = make_chart(state, floor_pose(), Rules(0.0015))
    draws = values + 0.003 * rng.standard_normal((5, len(values)))
    names = ["cube", "box", "can", "ball"]
    graph = scene_graph(state, floor_pose(), names)
    addresses, numbers, root = numbers_of_draws(chart, draws, graph, names)
    for n, draw in enumerate(draws):
        placed = replace(graph, root_pose=root[n]).with_numbers(dict(zip(addresses, numbers[n], strict=True)))
        rows = rows_at(chart, draw)
        poses, sizes = np.empty((5, 4, 4)), np.empty((5, 3))
        camera_poses(chart, draw, rows, poses, sizes)
        for k, name in enumerate(names):
            np.testing.assert_allclose(placed.vertex(name).body.size(), sizes[k + 1], atol=1e-9)
            columns = slice(3, 4) if name in ("can", "ball") else slice(0, 4)  # round ones may be turned
            np.testing.assert_allclose(placed.poses()[name][:, columns], poses[k + 1][:, columns], atol=1e-9)


def test_what_leans_a_little_is_told_upright_about_its_centre():
    """With its foot held a tall box was 4 mm off its own draws, and told to explain 6 of 10 of its pixels."""
    state = stack()
    for k, angle in ((0, 0.015), (1, -0.01)):  # radians
        row = state.rows[k].copy()
        row[1:10] = (rotation_x(angle)[:3, :3] @ row[1:10].reshape(3, 3)).ravel()
        state = state.changed(k, row=row, form=FREE)
    chart, values = make_chart(state, floor_pose(), Rules(0.0015))
    names = ["cube", "box", "can", "ball"]
    graph = scene_graph(state, floor_pose(), names)
    addresses, numbers, root = numbers_of_draws(chart, values[None], graph, names)
    placed = replace(graph, root_pose=root[0]).with_numbers(dict(zip(addresses, numbers[0], strict=True)))
    up = inverse(floor_pose())
    for k, name in enumerate(names[:2]):
        assert not set(TILTS) & set(graph.vertex(name).contact.values)
        pose = up @ placed.poses()[name]
        np.testing.assert_allclose(pose[:3, 2], [0.0, 0.0, 1.0], atol=1e-9)
        np.testing.assert_allclose(pose[:2, 3], state.rows[k][10:12], atol=1e-9)
        foot = state.rows[k][10:12] - 0.5 * state.rows[k][15] * state.rows[k][1:10].reshape(3, 3)[:2, 2]
        assert np.linalg.norm(foot - pose[:2, 3]) > 2e-4  # where it was put


def test_what_hangs_a_little_is_told_to_reach_down_to_what_bears_it():
    """Its top is seen and its foot is not: put down as it was, a tall box was told 7 mm too low, and not trusted."""
    row = make_row(BOX, rotation_x(0.015)[:3, :3], [0.0, 0.0, 0.103], [0.08, 0.06, 0.2])
    state = State().add(row, FREE, False)
    chart, values = make_chart(state, floor_pose(), Rules(0.0015))
    graph = scene_graph(state, floor_pose(), ["box"])
    addresses, numbers, root = numbers_of_draws(chart, values[None], graph, ["box"])
    told = dict(zip(addresses, numbers[0], strict=True))
    assert "gap" not in graph.vertex("box").contact.values
    assert [told[f"box.{side}"] for side in ("length", "width", "height")] == pytest.approx([0.08, 0.06, 0.203])
    placed = replace(graph, root_pose=root[0]).with_numbers(told)
    assert (inverse(floor_pose()) @ placed.poses()["box"])[2, 3] == pytest.approx(0.5 * 0.203)


@pytest.mark.parametrize("name", ["gaussian", "robust"])
def test_an_engine_begun_at_the_wall_scores_as_a_full_evaluation_does(name):
    rng = np.random.default_rng(2)
    sensor, chart, values = observe(rng, stack(), {"sigma": 0.004, "blur": 0.5}, camera(48, 36), name)
    engine = engine_of(chart, sensor)
    _, found = load(engine, chart, values)
    graph = scene_graph(stack(), floor_pose())
    full = DepthEvaluator(sensor.camera, sensor.observed, name, sensor.values).log_likelihood(graph.solids())
    # single precision in the pixels, and the graph's own rounding of poses
    assert abs(found - full) < 1e-3 * math.sqrt(48 * 36)
    moved = values + 0.002
    assert load(engine, chart, moved)[1] != pytest.approx(found, abs=1.0)


@pytest.mark.parametrize("theta", [0.0, 0.5, math.pi / 4])
def test_places_on_a_top_integrate_to_their_rate(theta):
    """The prior summed over all places where child and parent touch is that of the sizes and the turn, what would tip
    being as likely as what would not."""
    beliefs = bare_image()
    rules = Rules(0.0015, beliefs=beliefs._replace(loose=replace(beliefs.loose, tipping=1.0)))
    state = State().add(row(BOX, 0.2, 0.0, 0.0, 0.0, (0.09, 0.05, 0.06)), UPRIGHT, False, FLOOR, 0.0)
    state = state.add(row(BOX, 0.2 + theta, 0.0, 0.0, 0.06, (0.08, 0.04, 0.05)), UPRIGHT, False, 0, 0.06)
    chart, values = make_chart(state, floor_pose(), rules)
    step = 0.001
    total = 0.0
    for x, y in itertools.product(np.arange(-0.12, 0.12, step), repeat=2):
        values[chart.slots[1, 0]], values[chart.slots[1, 1]] = x, y
        total += math.exp(solid_log_prior(chart, rows_at(chart, values), 1)) * step * step
    alone = state.copy()
    alone.rows[1, 12] -= 0.06
    alone.parents[1], alone.bottoms[1] = FLOOR, 0.0
    other, start = make_chart(alone, floor_pose(), rules)
    share = total / math.exp(solid_log_prior(other, rows_at(other, start), 1))
    assert share == pytest.approx(1.0, rel=0.02)  # the grid's border
    # a broken twin: the area as if the axes were parallel
    aligned = share * touching_area(*rows_at(chart, values)[::-1]) / ((0.08 + 0.09) * (0.04 + 0.05))
    assert (abs(aligned - 1.0) > 0.05) == (theta > 0.1)


def test_walk_draws_sizes_from_their_prior():
    """At temperature 0 a cube's side is log-normal; without the density's 1 / side its log would be shifted."""
    chart, values = make_chart(cube(), floor_pose(), Rules(0.0015))
    sensor, _, _ = observe(np.random.default_rng(0), cube(), {"sigma": 0.01}, camera(16, 12))
    rng = np.random.default_rng(3)
    side = int(chart.slots[0, charts.SIZE])
    proposals = single_steps(chart, own_members(chart, 0))
    proposals.scale[:] = 0.05
    draws = run(rng, walker_at(engine_of(chart, sensor), chart, values), proposals, 0.0, 0.0, 1500, 60)
    z = (np.log(draws.values[:, side]) - math.log(0.085)) / 0.45
    assert kstest(z[::2], "norm").pvalue > 1e-3
    assert kstest(z[::2] - 0.45, "norm").pvalue < 1e-6  # the broken twin


def test_a_walk_gives_its_generator_back():
    """Else each of the hundred walks that a frame takes would keep one in memory for good."""
    chart, values = make_chart(cube(), floor_pose(), Rules(0.0015))
    sensor, _, _ = observe(np.random.default_rng(0), cube(), {"sigma": 0.01}, camera(16, 12))
    rng, proposals = np.random.default_rng(3), single_steps(chart)
    held = sys.getrefcount(rng)
    run(rng, walker_at(engine_of(chart, sensor), chart, values), proposals, 1.0, 0.0, 5, 1)
    assert sys.getrefcount(rng) == held


@pytest.mark.parametrize("part", [1.0, 0.5])
def test_steps_drawn_to_a_normal_leave_the_density_as_it_is(part):
    """Sizes at temperature 0 again, by steps made from a normal that is neither where nor as wide as their prior."""
    chart, values = make_chart(cube(), floor_pose(), Rules(0.0015))
    sensor, _, _ = observe(np.random.default_rng(0), cube(), {"sigma": 0.01}, camera(16, 12))
    side, spread = int(chart.slots[0, charts.SIZE]), 0.04  # narrower than the prior: a wrong ratio shows in its tails
    center, pull = values.copy(), np.zeros((1, len(values)))
    center[side], pull[0, side] = 0.1, 1.0 / spread
    step = Step(np.array([side]), np.array([[spread]]), touched_by(chart, [side]), 1.0, part, 0.3, pull, center)

    def drawn(step):
        rng = np.random.default_rng(3)
        engine, start = engine_of(chart, sensor), values.copy()
        draws = run(rng, walker_at(engine, chart, start), make_proposals([step]), 0.0, 0.0, 3000, 20)
        return (np.log(draws.values[::2, side]) - math.log(0.085)) / 0.45

    assert kstest(drawn(step), "norm").pvalue > 1e-3
    broken = step._replace(pull=4.0 * pull)  # which is not the inverse of the matrix
    assert kstest(drawn(broken), "norm").pvalue < 1e-6


def test_a_floor_that_takes_all_else_along_leaves_a_normal_as_it_is():
    """Along its own coordinates the normal is WIDER, given them as it was: q' = M q + scale F z leaves that."""
    mixed = np.random.default_rng(5).standard_normal((9, 9))
    covariance = mixed @ mixed.T + 0.1 * np.eye(9)
    step = floor_step(covariance, 1, np.zeros(9))
    narrow, pull = step.matrix / WIDER, step.pull
    wide = covariance + (WIDER**2 - 1.0) * narrow @ narrow.T
    kept = np.eye(9) + (np.sqrt(1.0 - 0.6**2) - 1.0) * step.matrix @ pull
    assert np.allclose(kept @ wide @ kept.T + 0.6**2 * step.matrix @ step.matrix.T, wide)
    assert np.allclose(pull @ step.matrix, np.eye(3)) and np.allclose(pull @ wide @ pull.T, np.eye(3))


def test_a_precision_that_rounding_made_indefinite_still_gives_steps():
    """As an image of stripes one pixel wide does."""
    along = np.array([[1.0], [2.0], [-1.0]])
    precision = 1e12 * along @ along.T - 1e-6 * np.eye(3)
    factor = factor_of_inverse(precision)
    assert np.isfinite(factor).all() and np.allclose(along.T @ factor @ factor.T @ along, 1e-12)
    assert np.allclose(along.T @ inverse_of(precision) @ along, 1e-12)
    loose = np.diag([4.0, 9.0, -1e-6])
    assert np.linalg.eigvalsh(inverse_of(loose)).min() > 0.0
    well = np.diag([4.0, 9.0, 16.0])
    assert np.array_equal(inverse_of(well), np.linalg.inv(well))


def test_steps_of_one_top_leave_those_above_where_they_are():
    state = State().add(row(BOX, 0.2, 0.0, 0.0, 0.0, (0.09, 0.07, 0.06)), UPRIGHT, False, FLOOR, 0.0)
    state = state.add(row(BOX, 0.3, 0.0, 0.0, 0.06, (0.08, 0.06, 0.05)), UPRIGHT, False, 0, 0.06)
    state = state.add(row(BOX, 0.4, 0.0, 0.0, 0.11, (0.07, 0.05, 0.04)), UPRIGHT, False, 1, 0.11)
    chart, values = make_chart(state, floor_pose(), Rules(0.0015))
    for first in (True, False):
        only = [m for k in range(3) for m in own_members(chart, k) if first or k]
        steps = block_steps(chart, 1e-6 * np.eye(len(only)), only)
        lowest = 0 if first else 1
        own = next(s for s in steps if chart.slots[lowest, charts.X] in s.members and len(s.matrix[0]) == 6)
        np.testing.assert_array_equal(own.touched[1:], [first, True, not first])
        moved = values.copy()
        moved[own.members] += own.matrix @ np.ones(6)
        before, after = rows_at(chart, values), rows_at(chart, moved)
        tops = after[:, 12] + 0.5 * after[:, 15] - before[:, 12] - 0.5 * before[:, 15]
        assert abs(tops[lowest]) > 1e-4
        np.testing.assert_allclose(np.delete(tops, lowest), 0.0, atol=1e-12)
        np.testing.assert_allclose(before[~own.touched[1:]], after[~own.touched[1:]], atol=1e-12)
    assert list(touched_by(chart, [int(chart.slots[0, charts.SIZE + 2])])) == [False, True, True, True]
    assert list(touched_by(chart, [int(chart.slots[0, charts.X])])) == [False, True, False, False]


def quadrature(engine, chart, start, indices, half, count):
    """Return the log integral of prior times likelihood over some coordinates, by the midpoint rule."""
    offsets = (np.arange(count) + 0.5) / count * 2 - 1
    logs = []
    for shift in itertools.product(offsets, repeat=len(indices)):
        values = start.copy()
        values[indices] += half * np.array(shift)
        logs.append(sum(load(engine, chart, values)))
    logs = np.array(logs)
    return float(logs.max() + math.log(np.exp(logs - logs.max()).sum()) + len(indices) * math.log(2 * half / count))


def test_evidence_of_cube_against_box_is_that_of_quadrature():
    """On a tiny image, sizes alone free: odds from draws against a sum over a grid."""
    rng = np.random.default_rng(4)
    sensor, chart, values = observe(rng, cube(), {"sigma": 0.02, "blur": 0.5}, camera(24, 18))
    found, true = [], []
    for is_cube, count in ((True, 400), (False, 28)):
        state = cube()
        state.cubes = [is_cube]
        chart, values = make_chart(state, floor_pose(), Rules(0.0015))
        sizes = sorted({int(s) for s in chart.slots[0, charts.SIZE :]})
        engine = engine_of(chart, sensor)
        (draws,) = sample(rng, chart, sensor, values, 1, 600, 12, sizes)
        found.append(log_evidence(rng, chart, sensor, values, draws.values, sizes))
        spread = draws.values[:, sizes].std(axis=0).max()
        start = values.copy()
        start[sizes] = draws.values[:, sizes].mean(axis=0)
        half = min(5 * spread, 0.9 * start[sizes].min())
        true.append(quadrature(engine, chart, start, sizes, half, count))
    for each, sure in zip(found, true, strict=True):  # and the grid's own error
        assert abs(each.log - sure) < 3.0 * each.standard_error + 0.05
        assert each.standard_error < 0.2
    assert found[0].log - found[1].log > 1.0  # and the simpler one wins: the Occam factor is there


@pytest.mark.parametrize("pixels", [0.0, 0.5, 1.0])
def test_sensor_is_read_off_the_image(pixels):
    rng = np.random.default_rng(5)
    sensor, chart, values = observe(rng, stack(), {"sigma": 0.003, "blur": pixels}, camera(120, 90))
    fitted = final_sensor(first_sensor(sensor.camera, sensor.observed, chart, values), chart, values)
    assert fitted.likelihood.name == "robust" and fitted.values["outlier"] == RATES[0]  # as the prior's file says
    assert fitted.values["blur"] == pytest.approx(pixels, abs=0.03)
    # ten thousand pixels: 0.7 % is one standard deviation
    assert fitted.values["sigma"] == pytest.approx(0.003, rel=0.03)


@pytest.mark.parametrize("kind", ["constant", "one depth", "steep", "wild", "none"])
def test_fitted_noise_is_in_the_range_of_a_likelihood(kind):
    rng = np.random.default_rng(8)
    model = rng.uniform(0.5, 2.0, 4000)
    if kind == "one depth":
        model[:] = 0.7
    spread = {"steep": np.where(model > 1.25, 3.0, 1e-4), "wild": 400.0}.get(kind, 0.002)
    residual = rng.normal(size=4000) * spread
    if kind == "none":
        residual[:] = np.nan
    sigma, growth = noise_of(residual, model)
    values = likelihoods["robust"].complete({"sigma": sigma, "sigma_growth": growth})  # checks the ranges
    if kind in ("constant", "one depth"):
        assert growth == 0.0 and values["sigma"] == pytest.approx(0.002, rel=0.05)


@pytest.mark.parametrize(("wall", "scale"), [(3.0, 1.0), (4.0, 0.4)], ids=["nearer", "in another unit"])
def test_what_lies_behind_everything_is_as_far_away_as_it_is_seen(wall, scale):
    rng = np.random.default_rng(3)
    eye = camera(96, 72)
    clean = scale * model_depth(*make_chart(cube(), floor_pose(0.25), Rules(0.0015)), eye)
    noise = {"sigma": 0.002 * scale, "blur": 0.5, "background": wall}
    observed = likelihoods["gaussian"].sample(rng, clean, noise)
    found = derender.infer(DepthImage(observed, eye), quick=True)
    assert found.meta["likelihood"]["background"] == pytest.approx(wall, rel=0.01)
    assert len(found.objects) == 1 and not any("explained" in each for each in found.doubts)


def test_what_nothing_returned_from_but_the_far_plane_is_outside_no_likelihood():
    """A simulator's far plane of 950 m was "likelihood.far: far is 1045; it lies in [0, 1000]"."""
    eye = camera(96, 72)
    clean = model_depth(*make_chart(cube(), floor_pose(0.25), Rules(0.0015)), eye)
    observed = likelihoods["gaussian"].sample(np.random.default_rng(3), clean, {"sigma": 0.002, "blur": 0.0})
    observed[:6] = 950.0
    assert len(derender.infer(DepthImage(observed, eye), quick=True).objects) == 1


def test_the_whole_image_s_likelihood_is_read_off_it():
    rng = np.random.default_rng(9)
    eye = camera(160, 120)
    chart, values = make_chart(stack(), floor_pose(), Rules(0.0015))
    clean = model_depth(chart, values, eye)
    graph = scene_graph(stack(), floor_pose())
    true = {"sigma": 0.001, "sigma_growth": 0.002, "blur": 0.75, "outlier": 0.05, "missing": 0.1, "missing_edge": 0.1}
    observed = likelihoods["robust"].sample(rng, clean, true)
    name, numbers = image_likelihood(eye, observed, graph.solids())
    assert name == "robust"
    assert numbers["blur"] == pytest.approx(0.75, abs=0.15) and numbers["outlier"] == 0.05
    assert numbers["missing"] == pytest.approx(0.1, abs=0.01)
    seen = clean[clean < 2.0] ** 2
    fitted, wanted = (each["sigma"] + each["sigma_growth"] * seen for each in (numbers, true))
    np.testing.assert_allclose(fitted, wanted, rtol=0.15)
    plain = likelihoods["gaussian"].sample(rng, clean, {"sigma": 0.003})
    name, numbers = image_likelihood(eye, plain, graph.solids())
    assert numbers["sigma"] == pytest.approx(0.003, rel=0.03) and numbers["outlier"] == RATES[0]
    assert numbers["blur"] < 0.2


def test_a_scene_has_the_density_that_its_chart_gives_it():
    chart, values = make_chart(stack(), floor_pose(), Rules(0.0015))
    graph = scene_graph(stack(), floor_pose())
    assert scene_log_prior(graph) == pytest.approx(log_prior(chart, rows_at(chart, values)), abs=1e-6)
    names = graph.names
    with pytest.raises(DerenderError, match="no floor"):
        scene_log_prior(graph.remove(names[0]))
    with pytest.raises(DerenderError, match="carton is a mesh"):
        scene_log_prior(graph.add(Vertex("carton", "mesh", {}, "root", Contact("6dof"), {"file": "a.obj"})))


def test_solids_that_overlap_are_unlikely():
    chart, values = make_chart(stack(), floor_pose(), Rules(0.0015))
    free = log_prior(chart, rows_at(chart, values))
    values[chart.slots[2, charts.X]] -= 0.10
    assert log_prior(chart, rows_at(chart, values)) < free - 100


def test_a_step_s_change_of_the_prior_is_that_of_the_whole():
    rng = np.random.default_rng(10)
    chart, values = make_chart(stack(), floor_pose(), Rules(0.0015))
    before, short = rows_at(chart, values), 0
    for k in range(4):
        moved = values.copy()
        moved[own_members(chart, k)] += 0.002 * rng.standard_normal(len(own_members(chart, k)))
        after, touched = rows_at(chart, moved), touched_by(chart, own_members(chart, k))
        change = log_prior_about(chart, after, touched) - log_prior_about(chart, before, touched)
        assert change == pytest.approx(log_prior(chart, after) - log_prior(chart, before), abs=1e-9)
        # a broken twin: what stands on the solid left out
        alone = np.arange(5) == k + 1
        alone_change = solid_log_prior(chart, after, k) - solid_log_prior(chart, before, k)
        short += abs(alone_change - change) > 1e-3 and (touched != alone).any()
    assert short == 1  # the cube under the box


def test_nothing_leans_on_a_support_of_negative_extent():
    state = stack()
    state.forms[1], state.bottoms[1] = FREE, np.nan  # the box on the cube
    chart, values = make_chart(state, floor_pose(), Rules(0.0015))
    values[chart.slots[0, charts.SIZE]] = -0.1  # so that the area that it offers would be negative
    assert solid_log_prior(chart, rows_at(chart, values), 1) == -np.inf


def test_the_floor_is_moved_less_often_than_each_solid():
    chart, values = make_chart(stack(), floor_pose(), Rules(0.0015))
    blocks = make_proposals(block_steps(chart, 1e-6 * np.eye(len(values))))
    for steps, total in ((single_steps(chart), 1.0), (blocks, 2.0)):
        floor = steps.members[steps.table[FIRST, 1:] - 1] >= len(values) - 3
        weights = np.diff(steps.cumulative, prepend=0.0)
        assert weights.sum() == pytest.approx(total)
        np.testing.assert_allclose(weights[floor].mean(), FLOOR_SHARE * weights[~floor])


def test_densities_of_what_moves_are_those_of_all():
    rng = np.random.default_rng(12)
    sensor, chart, values = observe(rng, stack(), {"sigma": 0.002}, camera(96, 72))
    engine = engine_of(chart, sensor)
    load(engine, chart, values)
    for k, alone in ((0, False), (2, True)):  # the cube carries a box; nothing stands on the other
        members = own_members(chart, k)
        points = np.tile(values, (5, 1))
        points[:, members] += 0.002 * rng.standard_normal((5, len(members)))
        found = np.empty((3, 5, 2))
        for touched, each in zip(
            (touched_by(chart, members), np.ones(5, bool), np.arange(5) == k + 1), found, strict=True
        ):
            evaluate(engine, chart, points, touched, each)
        np.testing.assert_allclose(found[0], found[1], rtol=1e-7)
        # a broken twin: what stands on the solid left out
        assert np.allclose(found[2], found[1], rtol=1e-7) == alone


def test_the_normal_about_a_mode_is_about_as_wide_as_the_draws():
    rng = np.random.default_rng(11)
    sensor, chart, values = observe(rng, stack(), {"sigma": 0.002}, camera(96, 72))
    (draws,) = sample(rng, chart, sensor, values, 1, 400, 60)
    engine = engine_of(chart, sensor)
    load(engine, chart, values)
    members = list(range(len(values)))
    factor = np.linalg.cholesky(Curvature(engine, chart, sensor, values).precision(members))
    ratios = np.linalg.eigvalsh(factor.T @ np.cov(draws.values.T) @ factor)
    # edges are only roughly accounted for; steps of one length in metres are wrong by far more
    assert 1e-2 < ratios.min() and ratios.max() < 20.0
    plain = np.linalg.eigvalsh(np.cov(draws.values.T))
    assert plain.max() / plain.min() > 5.0 * ratios.max() / ratios.min()


def test_an_edge_just_outside_the_picture_tells_no_more_than_one_inside():
    """Of a box that ends above the picture a lower one shows what is far behind, whose step no pixel has yet."""
    view, height, likelihood, precisions = camera(48, 36), 5, likelihoods["gaussian"], []
    noise = likelihood.complete({"sigma": 0.001, "blur": 0.2})
    for tall in np.arange(0.22, 0.34, 0.004):  # metres: the top is inside the picture, at its border, and outside
        state = State().add(row(BOX, 0.4, 0.0, 0.0, 0.0, (0.08, 0.08, tall)), UPRIGHT, False, FLOOR, 0.0)
        chart, values = make_chart(state, floor_pose(0.2), Rules(0.0015))
        sensor = Sensor(view, model_depth(chart, values, view), likelihood, noise)
        engine = engine_of(chart, sensor)
        load(engine, chart, values)
        precisions.append(Curvature(engine, chart, sensor, values).precision([height])[0, 0])
    assert precisions[0] > 1e6 and precisions[-1] == pytest.approx(1e4)  # inside; outside, where only the prior tells
    assert max(precisions) < 10.0 * precisions[0]


def test_names_follow_solids_between_structures():
    state = stack()
    names = ["cube", "box", "can", "ball"]
    fewer = state.without(2)
    assert matched_names(fewer, state, names) == ["cube", "box", "ball"]
    more = state.add(row(BOX, 0.0, 0.4, 0.4, 0.0, (0.05,) * 3), UPRIGHT, True, FLOOR, 0.0)
    assert matched_names(more, state, names) == [*names, "solid_1"]
    moved = state.copy()
    moved.parents[1] = FLOOR
    assert structure_key(moved, names) != structure_key(state, names)


def test_the_likeliest_leads_and_odds_are_against_it():
    best, others = leading("a", [Weighed("b", 2.0, 0.3), Weighed("c", -1.0, 0.0), Weighed("d", 5.0, 0.4)])
    assert best == "d" and sorted(each[:2] for each in others) == [("a", -5.0), ("b", -3.0), ("c", -6.0)]
    assert {each.trial: each.error for each in others} == pytest.approx({"a": 0.4, "b": 0.5, "c": 0.4})
    assert all(each.places is None for each in others)  # what they share with the new best is not known
    (back,) = leading("a", [Weighed("b", 2.0, 0.3, ((1,), (0, 2)))])[1]
    assert back == Weighed("a", -2.0, 0.3, ((0, 2), (1,)))  # by the coordinates that were not shared, exchanged
    assert leading("a", [Weighed("b", -2.0)]) == ("a", [Weighed("b", -2.0)])
    assert leading("a", []) == ("a", [])


def test_a_scene_may_turn_out_to_be_empty():
    """Nothing but the floor: the posterior has its one part, without unknowns."""
    sensor, chart, values = observe(np.random.default_rng(6), State(), {"sigma": 0.003}, camera(40, 30))
    engine = engine_of(chart, sensor)
    prior, likelihood = load(engine, chart, values)
    refined = Refined(State(), chart, values, sensor, prior, likelihood)
    part = structure_posterior(
        np.random.default_rng(0), refined, [], 1.0, chains_of(np.random.default_rng(7), refined, 2, 10)
    )
    assert part.values.shape == (2, 10, 0)
    assert part.graph.names == ("floor",)


def test_structures_too_many_to_be_told_keep_their_share(monkeypatch):
    """Of twenty that are as likely twelve are told: each at a twentieth."""
    sensor, chart, values = observe(np.random.default_rng(6), State(), {"sigma": 0.003}, camera(40, 30))
    refined = Refined(State(), chart, values, sensor, *load(engine_of(chart, sensor), chart, values))
    monkeypatch.setattr(graph_posterior, "weighed_structures", lambda *_: [(refined, 0.0, [], 0.0)] * 20)
    parts = independent_parts(np.random.default_rng(0), refined, 0.0, [], Settings(), 1, 2, False)
    assert [part.weight for part in parts] == pytest.approx([0.05] * MOST_PARTS)
    (alone,) = independent_parts(np.random.default_rng(0), refined, 0.0, [], Settings(), 1, 2, True)
    assert alone.extras["weighed"] is False and "weighed" not in parts[0].extras


def test_there_are_draws_enough_for_the_ends_of_intervals():
    """Between the 5 % and the 95 % quantile of n independent draws lies .9 (n - 1) / (n + 1) on average: of 200
    .891, and less of as many that are not independent."""
    rng, count = np.random.default_rng(3), CHAINS * DRAWS
    drawn = np.quantile(rng.random((4000, count)), [0.05, 0.95], axis=1)
    held = float((drawn[1] - drawn[0]).mean())
    assert held == pytest.approx(0.9 * (count - 1) / (count + 1), abs=1e-3) and held > 0.894


@pytest.mark.parametrize(("budget", "times"), [(None, metropolis.LONGER + 1), (0.0, 1), (math.inf, 6)])
def test_chains_that_do_not_agree_go_on_while_it_is_worth_it_or_as_long_as_was_said(monkeypatch, budget, times):
    """Here none agrees before the sixth time."""
    sensor, chart, values = observe(np.random.default_rng(6), cube(), {"sigma": 0.003}, camera(40, 30))
    refined = Refined(cube(), chart, values, sensor, *load(engine_of(chart, sensor), chart, values))
    genuine, told = metropolis.final_draws, []
    monkeypatch.setattr(metropolis, "final_draws", lambda *walk: told.append(walk) or genuine(*walk))
    monkeypatch.setattr("derender.structures.draws.refined.agreed", lambda refined, drawn: len(told) == 6)
    monkeypatch.setattr(metropolis, "far_apart", lambda draws: False)
    settings = Settings()._replace(until=None if budget is None else time.monotonic() + budget)
    monkeypatch.setattr(graph_posterior, "weighed_structures", lambda rng, *_: [(refined, 0.0, ["cube_1"], 0.0)])
    independent_parts(np.random.default_rng(7), refined, 0.0, [], settings, 2, 4, False)
    assert len(told) == times


def test_chains_that_do_not_agree_have_ended_when_the_budget_is_spent(monkeypatch):
    """Each time takes as long as all before: begun shortly before the end, it would take twice the budget."""
    sensor, chart, values = observe(np.random.default_rng(6), cube(), {"sigma": 0.003}, camera(40, 30))
    genuine, clock = metropolis.final_draws, [0.0]

    def drawn(rng, walkers, steps, count, thin, *rest):
        clock[0] += thin
        return genuine(rng, walkers, steps, count, thin, *rest)

    monkeypatch.setattr(metropolis, "final_draws", drawn)
    monkeypatch.setattr(metropolis.time, "monotonic", lambda: clock[0])
    metropolis.sample(np.random.default_rng(7), chart, sensor, values, 2, 4, 1, until=7.0, agreed=lambda drawn: False)
    assert clock[0] == 4.0  # 1 + 1 + 2, and 4 more would be too many


def test_many_draws_end_with_the_budget(monkeypatch):
    """Ten million went on for minutes after it was spent, and no signal ended them."""
    sensor, chart, values = observe(np.random.default_rng(6), cube(), {"sigma": 0.003}, camera(40, 30))
    monkeypatch.setattr(metropolis, "AT_ONCE", 100)
    for until, count in ((time.monotonic(), 50), (None, 400), (time.monotonic() + 600, 400)):
        drawn = metropolis.sample(np.random.default_rng(7), chart, sensor, values, 2, 400, 2, until=until)
        assert [len(each.values) for each in drawn] == 2 * [count]


def test_within_a_budget_chains_go_on_until_what_is_told_is_to_be_trusted():
    """At the first look two numbers are not. (Other seeds take up to a hundred times as long as this one.)"""
    sensor, chart, values = observe(np.random.default_rng(6), stack(), {"sigma": 0.003}, camera(40, 30))
    refined = Refined(stack(), chart, values, sensor, *load(engine_of(chart, sensor), chart, values))
    rng = np.random.default_rng(3)
    chains = chains_of(rng, refined, 2, 20, time.monotonic() + 600)
    part = structure_posterior(rng, refined, names_of(stack()), 1.0, chains)
    rows = parameter_rows(part.addresses, part.values, dict(zip(part.addresses, part.periods, strict=True)))
    assert not [row["address"] for row in rows if doubtful(row)]


@pytest.mark.parametrize(("draws", "enough"), [(100, True), (500, False)])
def test_chains_agree_by_the_limits_for_so_many_draws(draws, enough):
    """Their middles are half a standard deviation apart: a quick look does not show that, and 1,000 draws do."""
    sensor, chart, values = observe(np.random.default_rng(6), cube(), {"sigma": 0.003}, camera(40, 30))
    refined = Refined(cube(), chart, values, sensor, *load(engine_of(chart, sensor), chart, values))
    scattered = values + 1e-3 * np.random.default_rng(0).normal([[[0.0]], [[0.5]]], 1.0, (2, draws, len(values)))
    assert agreed(refined, [Draws(each, np.zeros((draws, 2)), 0.3) for each in scattered]) is enough


def test_draws_are_of_what_tips_as_rarely_as_the_prior_says():
    """A walk that the image tells nothing, of a block on another: were all places where the two touch as likely, its
    middle would lie beyond that in three draws of four, and does in two of five where that is a quarter as probable."""
    state = stack().without(3).without(2)
    chart, values = make_chart(state, floor_pose(), Rules(0.0015))
    assert chart.tipping == pytest.approx(math.log(100.0))
    chart = chart._replace(tipping=math.log(4.0))
    sensor = Sensor(
        camera(8, 6), np.full((6, 8), np.nan), likelihoods["gaussian"], likelihoods["gaussian"].complete({})
    )
    place, own = [chart.slots[1, charts.X], chart.slots[1, charts.X] + 1], values.copy()
    drawn = sample(np.random.default_rng(3), chart, sensor, own, 1, 4000, 20, place)[0].values
    rows = np.empty((2, charts.ROW))
    tips = []
    for each in drawn:
        place_rows(chart, each, rows)
        tips.append(len(charts.tipping(chart, rows)))
    over = 0.08**2
    wanted = 0.25 * (charts.touching_area(*state.rows[::-1]) - over)
    assert np.mean(tips) == pytest.approx(wanted / (wanted + over), abs=0.05)  # of .42; each draw is worth a third


def test_the_best_scene_of_a_posterior_is_the_best_of_climb_and_draws():
    """A climb that ended beside the mode is no draw: it would stand apart from all others in the report."""
    rng = np.random.default_rng(8)
    sensor, chart, values = observe(rng, cube(), {"sigma": 0.003}, camera(40, 30))
    prior, likelihood = load(engine_of(chart, sensor), chart, values)
    refined = Refined(cube(), chart, values, sensor, prior, likelihood)
    draws = chains_of(rng, refined, 2, 20)
    beside = structure_posterior(
        np.random.default_rng(0), refined._replace(log_likelihood=-1e9), ["cube_1"], 1.0, draws
    )
    assert beside.log_density.min() > -1e9
    above = structure_posterior(np.random.default_rng(0), refined._replace(log_likelihood=1e9), ["cube_1"], 1.0, draws)
    assert above.log_density[0, 0] > 1e8 and np.array_equal(above.log_density[:, 1:], beside.log_density[:, 1:])
