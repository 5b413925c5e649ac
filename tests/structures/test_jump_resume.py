"""Chains over structures under an open prior: stopped, killed, resumed, and spread over processes."""

import multiprocessing
import os
import signal
import time

import numpy as np
import pytest
from test_jump_posterior import CAMERA, VALUES, observed

from derender.errors import DerenderError
from derender.sampling.chains import Plan, run_chain, run_chains
from derender.structures.jumps.run import JumpSampler


def plan(**settings):
    prior, truth, image = observed(3)
    sampler = JumpSampler(prior, truth, CAMERA, image, "gaussian", VALUES, (), 3, 10)
    return Plan(sampler, 5, 2, warmup=12, draws=60, run="r", **settings)


def silent(*_):
    pass


def never():
    return False


def same(first, second):
    assert first.generator == second.generator
    for one, other in zip(first[1:3], second[1:3], strict=True):
        np.testing.assert_array_equal(one, other)
    assert first.state.keys() == second.state.keys()
    for name, one in first.state.items():
        np.testing.assert_array_equal(one, second.state[name])


@pytest.fixture(scope="module")
def whole():
    return [run_chain(plan(), number, never, silent) for number in range(2)]


def test_scenes_come_back_from_a_record_as_they_were(whole):
    """Structure, numbers and densities of every draw; the densities are those of the scenes, from nothing."""
    sampler = plan().sampler
    draws = sampler.draws(whole[0])
    assert len(draws.states) == 60 and len({state.graph.structure() for state in draws.states}) > 1
    target, _, state = sampler._begin({"now": whole[0].state["now"]})
    assert state.graph == draws.states[-1].graph
    for state in draws.states[::7]:
        assert target.log_prior(state.graph) == state.log_prior
        assert target.log_likelihood(state.graph) == state.log_likelihood
    assert 0.0 < draws.acceptance["wiggle"] < 1.0


@pytest.mark.parametrize("segments", [1, 2, 3, 6])
def test_resumed_equals_uninterrupted(whole, tmp_path, segments):
    """Stopped in warm-up and later, written, read and resumed."""
    seen = []
    stopped = run_chain(plan(folder=tmp_path), 0, lambda: len(seen) > segments, lambda *_: seen.append(0))
    assert stopped.drawn < 60
    same(run_chain(plan(folder=tmp_path, resume=True), 0, never, silent), whole[0])
    with pytest.raises(DerenderError, match="another image, prior, seed or settings"):
        run_chain(plan(folder=tmp_path, resume=True)._replace(run="other"), 0, never, silent)


def _run_with_checkpoints(folder):
    run_chain(plan(folder=folder, checkpoint_seconds=-1, resume=True)._replace(draws=100_000), 0, never, silent)


def test_killed_at_random(whole, tmp_path):
    """kill -9 while it writes checkpoints after every segment: it goes on where it was, to the same scenes."""
    rng, context = np.random.default_rng(3), multiprocessing.get_context("fork")
    for _ in range(5):
        process = context.Process(target=_run_with_checkpoints, args=(tmp_path,))
        process.start()
        time.sleep(rng.uniform(0.1, 0.6))
        os.kill(process.pid, signal.SIGKILL)
        process.join()
    again = run_chain(plan(folder=tmp_path, resume=True), 0, never, silent)
    assert again.drawn >= 60
    np.testing.assert_array_equal(again.densities[:60], whole[0].densities)


@pytest.mark.slow
def test_any_number_of_jobs_draws_the_same(whole):
    spread = run_chains(plan(), 2).records
    assert spread.keys() == {0, 1}
    for number, record in enumerate(whole):
        same(spread[number], record)
