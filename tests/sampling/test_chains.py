"""Chains: same bytes for any number of workers, exact resumption, and survival of kills, faults and Ctrl-C."""

import multiprocessing
import os
import signal
import threading
import time

import numpy as np
import pytest
from toy_samplers import Walk

from derender.errors import DerenderError
from derender.sampling import chains
from derender.sampling.chains import Plan, chain, run_chain, stream

NEVER = lambda: False  # noqa: E731
SILENT = lambda *_: None  # noqa: E731


def plan(**changes):
    return Plan(**{"sampler": Walk(), "seed": 7, "chains": 4, "warmup": 25, "draws": 57, "run": "r", **changes})


def same(one, other):
    assert one.generator == other.generator and one.warmed == other.warmed
    for name in ("values", "densities"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    for name, value in one.state.items():
        np.testing.assert_array_equal(value, other.state[name])


@pytest.fixture(scope="module")
def alone():
    return [run_chain(plan(), number, NEVER, SILENT) for number in range(4)]


def test_shape_of_a_chain(alone):
    assert alone[0].values.shape == (57, 2) and alone[0].warmed == 25
    assert not np.array_equal(alone[0].values, alone[1].values)


@pytest.mark.parametrize("jobs", [1, 3])
def test_same_draws_for_any_workers(alone, jobs):
    outcome = chains.run_chains(plan(), jobs)
    assert not outcome.lost and not outcome.interrupted
    for number, record in enumerate(alone):
        same(outcome.records[number], record)


@pytest.mark.parametrize("stop_after", range(1, 11))
def test_resumed_equals_uninterrupted(alone, tmp_path, stop_after):
    """Stopped after each possible segment, in warm-up and later, written, read and resumed."""
    calls = iter(range(100))
    settings = plan(folder=tmp_path)
    partial = run_chain(settings, 1, lambda: next(calls) >= stop_after - 1, SILENT)
    assert partial.drawn < 57 or stop_after >= 10
    same(run_chain(settings._replace(resume=True), 1, NEVER, SILENT), alone[1])


def test_resume_can_ask_for_more(tmp_path):
    longer = run_chain(plan(draws=130), 2, NEVER, SILENT)
    run_chain(plan(draws=60, folder=tmp_path, checkpoint_seconds=-1), 2, NEVER, SILENT)
    same(run_chain(plan(draws=130, folder=tmp_path, resume=True), 2, NEVER, SILENT), longer)


def test_a_checkpoint_of_another_run_is_refused(tmp_path):
    run_chain(plan(folder=tmp_path, checkpoint_seconds=-1), 0, NEVER, SILENT)
    with pytest.raises(DerenderError, match="another image, prior, seed or settings"):
        chains.run_chains(plan(folder=tmp_path, run="other", resume=True))
    (tmp_path / "chain_0.npz").write_bytes(b"PK\x03\x04 torn")
    with pytest.raises(DerenderError, match="not a checkpoint"):
        chains.run_chains(plan(folder=tmp_path, resume=True))


def test_a_checkpoint_of_another_version_is_refused(tmp_path, monkeypatch):
    with monkeypatch.context() as older:
        older.setattr(chains, "FORMAT", 1)
        run_chain(plan(folder=tmp_path, checkpoint_seconds=-1), 0, NEVER, SILENT)
    with pytest.raises(DerenderError, match="another version of derender"):
        chains.run_chains(plan(folder=tmp_path, resume=True))


def test_fingerprint_knows_where_parts_end():
    assert chains.fingerprint("ab", "c") != chains.fingerprint("a", "bc")


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_fault_loses_one_chain_only(alone, jobs):
    outcome = chains.run_chains(plan(sampler=Walk(doomed=(2,))), jobs)
    assert list(outcome.records) == [0, 1, 3] and "doomed" in outcome.lost[2]
    same(outcome.records[3], alone[3])


def test_all_chains_lost_is_an_error():
    with pytest.raises(RuntimeError, match="doomed"):
        chains.run_chains(plan(sampler=Walk(doomed=(0, 1, 2, 3))))


@pytest.mark.parametrize("jobs", [1, 2])
def test_control_c_keeps_what_there_is(tmp_path, jobs):
    settings = plan(sampler=Walk(seconds=0.02), draws=2000, folder=tmp_path, chains=2)
    first_draw = threading.Event()

    def interrupt():
        first_draw.wait(20)
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    outcome = chains.run_chains(settings, jobs, lambda number, done, total: done > 60 and first_draw.set())
    thread.join()
    assert outcome.interrupted and outcome.records
    for number, record in outcome.records.items():
        assert 0 < record.drawn < 2000
        same(chains.load_record(tmp_path / f"chain_{number}.npz", "r"), record)


def _run_with_checkpoints(folder):
    run_chain(plan(sampler=Walk(), draws=20_000, folder=folder, checkpoint_seconds=-1, resume=True), 0, NEVER, SILENT)


@pytest.mark.slow
def test_killed_at_random_fifty_times(tmp_path):
    """kill -9 while checkpoints are written as fast as they can be: the file that is left can always be resumed."""
    whole = run_chain(plan(draws=2000), 0, NEVER, SILENT)
    context = multiprocessing.get_context("fork")  # a spawn would take most of a second each
    rng = np.random.default_rng(3)
    drawn = []
    for _ in range(50):
        process = context.Process(target=_run_with_checkpoints, args=(tmp_path,))
        process.start()
        time.sleep(rng.uniform(0.005, 0.06))
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        record = chains.load_record(tmp_path / "chain_0.npz", "r")
        drawn.append(record.drawn if record else -1)
    assert drawn == sorted(drawn) and drawn[-1] > 0
    count = min(2000, drawn[-1])
    np.testing.assert_array_equal(record.values[:count], whole.values[:count])
    run_chain(plan(draws=drawn[-1], folder=tmp_path, resume=True), 0, NEVER, SILENT)
    assert len(list(tmp_path.iterdir())) == 1


def test_adaptation_ends_with_warm_up():
    steps = [float(record.state["step"]) for record in chain(Walk(), stream(1, 0), 25, 40)]
    assert len(set(steps[:4])) > 1 and len(set(steps[3:])) == 1
