"""Work in several threads: compiled code and waiting for the disk let go of the interpreter."""

import contextlib
import functools
import importlib.util
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

THREADS = 2  # so that two processors walk in half the time of one
SAFE_PATH = "PYTHONSAFEPATH"  # of the environment: as python -P
THREADS_VARIABLE = "DERENDER_THREADS"  # of the environment: how many a process may use where it is one of many


def threads() -> int:
    """Return how many threads this process may use; results do not depend on it."""
    given = os.environ.get(THREADS_VARIABLE, "")
    return max(1, int(given)) if given.isdecimal() else THREADS


@functools.cache
def import_in_background(*modules: str) -> None:
    """Begin, once, to import what will be needed later, as far as it is installed."""
    threading.Thread(target=_import_all, args=(modules,), daemon=True).start()


def _import_all(modules) -> None:
    for module in modules:
        if importlib.util.find_spec(module.partition(".")[0]) is not None:
            importlib.import_module(module)


@contextlib.contextmanager
def safe_path():
    """Within, processes that are started do not look for modules in the current folder, whatever lies there."""
    former = os.environ.get(SAFE_PATH)
    os.environ[SAFE_PATH] = "1"
    try:
        yield
    finally:
        if former is None:
            del os.environ[SAFE_PATH]
        else:
            os.environ[SAFE_PATH] = former


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


def run_together(*tasks: Callable[[], object]) -> None:
    """Do all tasks, the first in this thread, and return when all are done; the first fault is raised."""
    if threads() == 1:
        for task in tasks:
            task()
        return
    with ThreadPoolExecutor(max(len(tasks) - 1, 1)) as pool:
        others = [pool.submit(task) for task in tasks[1:]]
        tasks[0]()
        for other in others:
            other.result()


def in_threads(rng, tasks: Sequence[Callable[[Any], Any]]) -> list:
    """Return what each task gives for a random generator of its own, whatever the number of threads."""
    streams = rng.spawn(len(tasks))
    if min(len(tasks), threads()) < 2:
        return [task(stream) for task, stream in zip(tasks, streams, strict=True)]
    with ThreadPoolExecutor(threads()) as pool:
        return list(pool.map(lambda task, stream: task(stream), tasks, streams))
