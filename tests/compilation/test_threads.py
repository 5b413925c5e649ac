"""Tasks in threads: as many as there are processors for, and the first fault of any is raised."""

import os
import threading
from functools import partial

import numpy as np
import pytest

from derender.compilation.threads import THREADS_VARIABLE, in_threads, run_together


def number_and_thread(rng):
    return rng.integers(1_000_000), threading.current_thread()


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="this system does not say which processors are ours")
def test_one_processor_has_one_thread_and_the_same_numbers(monkeypatch):
    """Two in turns on one took a tenth longer than one."""
    monkeypatch.delenv(THREADS_VARIABLE, raising=False)
    told = []
    for processors in ({0}, {0, 1}):
        monkeypatch.setattr(os, "sched_getaffinity", lambda process, few=processors: few)
        numbers, threads = zip(*in_threads(np.random.default_rng(1), [number_and_thread] * 20), strict=True)
        told.append(numbers)
        assert len(set(threads)) <= len(processors)
    assert told[0] == told[1]


def test_tasks_run_beside_each_other_and_the_first_fault_is_raised(monkeypatch):
    monkeypatch.setenv(THREADS_VARIABLE, "2")
    both = threading.Barrier(2, timeout=60)

    def meet(fault):
        both.wait()
        if fault:
            raise fault
        return "met"

    assert run_together(partial(meet, None), partial(meet, None)) == ["met", "met"]
    with pytest.raises(IndexError, match="lost"):
        run_together(partial(meet, None), partial(meet, IndexError("lost")))
