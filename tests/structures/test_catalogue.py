"""Leaps between structures: round trips, weights against brute force, populations, checkpoints, options."""

import functools
import math
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_scenes import box, brute_force, entries_of, sensor_of, state_of

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

from scene_makers import SETS, make_scene

from derender.errors import DerenderError
from derender.structures.catalogue import chain as chains
from derender.structures.catalogue.chain import Walker
from derender.structures.catalogue.leap import leap_values, make_leap, shared_of
from derender.structures.catalogue.population import population
from derender.structures.catalogue.run import Plan, chain_record, read_plan
from derender.structures.infer import infer_structure
from derender.structures.options import Options

LIMIT = 4.5  # standard errors
SIGMA = 0.02  # metres


@functools.cache
def world(seed=0):
    """Return (entries, sensor): one long box, two cubes side by side, or a cube and a box, in much noise."""
    rng = np.random.default_rng([seed, 5])
    left, right = box(-0.041, 0.0, (0.08, 0.08, 0.08), 0.0), box(0.041, 0.012, (0.08, 0.08, 0.08), 0.0)
    whole = box(0.0, 0.006, (0.16, 0.08, 0.08), 0.0)
    found = [[(whole, False)], [(left, True), (right, True)], [(left, True), (right, False)]]
    names = [["whole"], ["left", "right"], ["left", "right"]]
    sensor = sensor_of(state_of(*found[1]), SIGMA, rng)
    return entries_of(rng, sensor, [state_of(*items) for items in found], names), sensor


@functools.cache
def evidences():
    """Return (log integral of each entry, standard errors) by brute force."""
    walker = Walker(*world())
    found = [brute_force(np.random.default_rng(k), walker, k) for k in range(len(walker.entries))]
    return np.array([value for value, _ in found]), np.array([error for _, error in found])


@functools.cache
def shares():
    """Return (probability of each entry, standard errors) by brute force."""
    logs, relative = evidences()
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    # of w_i / sum w: first order
    errors = [weights[k] * math.hypot((1 - weights[k]) * relative[k], np.linalg.norm(np.delete(weights * relative, k)))
              for k in range(len(weights))]  # fmt: skip
    return weights, np.array(errors)


def visits(seed, draws=4000):
    entries, sensor = world()
    rng, walker = np.random.default_rng(seed), Walker(entries, sensor)
    place, found = walker.place(0, entries[0].start.copy()), []
    for _ in range(draws):
        place = walker.stepped(rng, place, 40)
        found.append(place.entry)
    return np.array(found[200:])


def far_off(found):
    """Return by how many standard errors the shares of visits are from brute force's."""
    weights, errors = shares()
    worst = 0.0
    for number, weight in enumerate(weights):
        there = (found == number).astype(float)
        batches = there[: len(there) // 40 * 40].reshape(40, -1).mean(axis=1)
        error = math.hypot(batches.std(ddof=1) / math.sqrt(40), errors[number])
        worst = max(worst, abs(there.mean() - weight) / error)
    return worst


def test_brute_force_leaves_doubt():
    """The world is one in which the test means something: two structures at least with more than a twentieth."""
    weights, errors = shares()
    assert np.sort(weights)[-2] > 0.05
    assert errors.max() < 0.03


def test_a_leap_and_its_return_undo_each_other():
    entries, _ = world()
    rng = np.random.default_rng(1)
    for here, one in enumerate(entries):
        for there, other in enumerate(entries):
            if here == there:
                continue
            forth, back = make_leap(one, other), make_leap(other, one)
            values, ratio = leap_values(rng, forth, one.start, len(other.mean))
            assert np.array_equal(values[forth.kept[1]], one.start[forth.kept[0]])
            returned = back.back.log_density(values) - back.forth.log_density(one.start)
            assert ratio == pytest.approx(-returned, abs=1e-9)
            assert shared_of(one, other) == shared_of(other, one)


def test_a_conditional_draws_what_its_density_says():
    """E[exp(-log g) over a box] = volume: the mean of 1 / density over the draws within a box is the box's volume."""
    entries, _ = world()
    rng = np.random.default_rng(2)
    law = make_leap(entries[0], entries[2]).forth
    values, spread = entries[2].mean.copy(), np.sqrt(np.diag(law.factor @ law.factor.T))
    scale = 1.2 * spread
    centre = law.centre + law.slope @ (values[law.given] - law.middle)
    inside = []
    for _ in range(20_000):
        law.sample(rng, values)
        within = np.all(np.abs(values[law.own] - centre) < scale)
        inside.append(math.exp(-law.log_density(values) - np.sum(np.log(2 * scale))) if within else 0.0)
    inside = np.array(inside)
    assert abs(inside.mean() - 1.0) < LIMIT * inside.std() / math.sqrt(len(inside))


def test_chain_agrees_with_brute_force():
    assert far_off(visits(3)) < LIMIT


def test_a_leap_without_its_density_does_not(monkeypatch):
    def broken(rng, leap, values, size):
        new, ratio = leap_values(rng, leap, values, size)
        return new, ratio + leap.forth.log_density(new)  # forgets with what density the new numbers were drawn

    monkeypatch.setattr(chains, "leap_values", broken)
    assert far_off(visits(3)) > 2 * LIMIT


def test_populations_agree_with_brute_force():
    entries, sensor = world()
    weights, errors = shares()
    found, totals = [], []
    for run in range(8):
        walker = Walker(entries, sensor)
        result = population(np.random.default_rng([9, run]), walker, 100)
        found.append([np.mean([place.entry == k for place in result.places]) for k in range(len(entries))])
        totals.append(result.log_evidence)
    found = np.array(found)
    for k, weight in enumerate(weights):
        error = math.hypot(found[:, k].std(ddof=1) / math.sqrt(8), errors[k], 0.005)
        assert abs(found[:, k].mean() - weight) < LIMIT * error, k
    ratios = np.exp(np.array(totals) - np.logaddexp.reduce(evidences()[0]))
    assert abs(ratios.mean() - 1.0) < LIMIT * math.hypot(ratios.std(ddof=1) / math.sqrt(8), 0.02)


def test_a_resumed_chain_equals_an_uninterrupted_one(tmp_path):
    entries, sensor = world()
    plan = Plan("mcmc", 1, 30, 5, 1, tmp_path, False, "a run")

    def record(plan, stop):
        return chain_record(np.random.default_rng(4), Walker(entries, sensor), plan, 0, stop, lambda share: None)

    whole = record(plan._replace(folder=None), lambda: False)
    asked = iter([False] * 17 + [True] * 99)
    part = record(plan, lambda: next(asked))
    assert 0 < part.drawn < 30
    again = record(plan._replace(resume=True), lambda: False)
    assert np.array_equal(whole.state["visited"], again.state["visited"])
    assert np.array_equal(whole.values, again.values, equal_nan=True)
    with pytest.raises(DerenderError, match="another image"):
        record(plan._replace(resume=True, run="another run"), lambda: False)


def test_options_that_do_not_fit_are_refused():
    depth = np.ones((2, 2))
    with pytest.raises(DerenderError, match="--warmup"):
        read_plan(Options(method="smc", warmup=3), depth)
    plan = read_plan(Options(method="mcmc", warmup=0, chains=3, draws=7, jobs=1), depth)
    assert (plan.chains, plan.draws, plan.warmup, plan.jobs) == (3, 7, 0, 1)


@pytest.mark.parametrize("method", ["mcmc", "smc"])
def test_a_tower_is_found_with_its_graph_whatever_the_number_of_jobs(method):
    scene = make_scene(np.random.default_rng([3, SETS.index("tower")]), "tower")
    options = Options(method=method, chains=2, draws=40, seed=3)
    found = [infer_structure(scene["depth"], scene["camera"], replace(options, jobs=jobs)) for jobs in (1, 2)]
    assert sum(part.weight for part in found[0].parts) == pytest.approx(1.0)
    assert [part.weight for part in found[0].parts] == [part.weight for part in found[1].parts]
    assert np.array_equal(found[0].best_part.values, found[1].best_part.values)
    graph = found[0].best_graph()
    parents = [graph.vertex(vertex.parent).parent for vertex in graph.vertices if vertex.parent != "root"]
    assert len(parents) == 3 and parents.count("root") == 1  # one on the floor, each other on the one before
    told = found[0].meta["structure_chains"]
    assert len(told["shares"]) == 2 and (method == "mcmc" or len(told["log_evidence"]) == 2)


def test_an_interrupt_keeps_what_was_drawn(tmp_path):
    scene = make_scene(np.random.default_rng([3, SETS.index("tower")]), "tower")
    options = Options(method="mcmc", chains=1, draws=100_000, warmup=0, seed=3, folder=tmp_path)

    sent = []

    def interrupt(fraction, message):
        if message == "jumping" and not sent:
            sent.append(fraction)
            os.kill(os.getpid(), signal.SIGINT)

    found = infer_structure(scene["depth"], scene["camera"], options, progress=interrupt)
    assert found.meta["interrupted"] and (tmp_path / "checkpoint" / "mcmc_0.npz").exists()
    assert 0 < sum(part.values.shape[1] for part in found.parts) < 1000
