"""Work in several threads: compiled code and waiting for the disk let go of the interpreter."""

import contextlib
import functools
import importlib.util
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

THREADS = 2  # so that two processors walk in half the time of one
SAFE_PATH = "PYTHONSAFEPATH"  # of the environment: as python -P
THREADS_VARIABLE = "DERENDER_THREADS"  # of the environment: how many a process may use where it is one of many
# Of the environment: threads of the libraries behind numpy. On two processors a second one, which mostly waits in a
# loop for matrices too small to share, took a seventh of what the first did: two processes then disturb each other.
LIBRARIES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def threads() -> int:
    """Return how many threads this process may use; results do not depend on it.

    On one processor several would wait for each other: two took a tenth longer than one.
    """
    given = os.environ.get(THREADS_VARIABLE, "")
    if given.isdecimal():
        return max(1, int(given))
    return min(THREADS, processors())


def processors() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache
def import_in_background(*modules: str) -> None:
    """Begin, once, to import what will be needed later, as far as it is installed."""

    def import_all() -> None:
        for module in modules:
            if importlib.util.find_spec(module.partition(".")[0]) is not None:
                importlib.import_module(module)

    threading.Thread(target=import_all, daemon=True).start()


@contextlib.contextmanager
def each_one_of_many() -> Iterator[None]:
    """Within, a process that is started uses one thread, of libraries too where the user does not say how many, and
    does not look for modules in the current folder, whatever lies there.
    """
    said = {name: os.environ.get(name) for name in (SAFE_PATH, THREADS_VARIABLE, *LIBRARIES)}
    os.environ.update({name: (value if name in LIBRARIES else None) or "1" for name, value in said.items()})
    try:
        yield
    finally:
        for name, value in said.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def interruptible() -> Iterator[threading.Event]:
    """Within, the first Ctrl-C sets the event that this yields; a second one is a KeyboardInterrupt."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return

    def handle(number, frame):
        if event.is_set():
            raise KeyboardInterrupt
        event.set()

    former = signal.signal(signal.SIGINT, handle)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, former)


def run_together(*tasks: Callable[[], Any]) -> list:
    """Return what each task gives, done in several threads; of faults the first task's, once what was begun is done."""
    if threads() == 1 or len(tasks) == 1:
        return [task() for task in tasks]
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(threads()) as pool:
        futures = [pool.submit(task) for task in tasks]
        try:
            return [future.result() for future in futures]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def in_threads(rng, tasks: Sequence[Callable[[Any], Any]]) -> list:
    """Return what each task gives for a random generator of its own, whatever the number of threads."""
    return run_together(*(partial(task, stream) for task, stream in zip(tasks, rng.spawn(len(tasks)), strict=True)))
