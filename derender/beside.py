"""What is done beside something else, in a thread: compiled code and waiting for the disk let go of the interpreter."""

import functools
import importlib.util
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


@functools.cache
def import_beside(*modules: str) -> None:
    """Begin, once, to import what will be needed later, as far as it is installed."""
    threading.Thread(target=_import_all, args=(modules,), daemon=True).start()


def _import_all(modules) -> None:
    for module in modules:
        if importlib.util.find_spec(module.partition(".")[0]) is not None:
            importlib.import_module(module)


def side_by_side(*tasks: Callable[[], object]) -> None:
    """Do all tasks, the first in this thread, and return when all are done; the first fault is raised."""
    with ThreadPoolExecutor(max(len(tasks) - 1, 1)) as pool:
        others = [pool.submit(task) for task in tasks[1:]]
        tasks[0]()
        for other in others:
            other.result()
