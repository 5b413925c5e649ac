"""Several chains at once, over threads (where the sampler runs compiled and lets go of the interpreter) or processes.

Threads start at no cost but die together; spawned processes cost about a second each (imports, compiled code from its
cache) and one that dies takes only the chain with it that it was on.
"""

import contextlib
import multiprocessing
import multiprocessing.connection
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, NamedTuple

from derender.compilation.threads import safe_path
from derender.errors import DerenderError
from derender.sampling.chains import Plan, Progress, Record, run_chain


class Outcome(NamedTuple):
    """What came of a run.

    records : one for each chain that ran, by its number.
    lost : why a chain was lost, by its number.
    interrupted : whether someone asked to stop before the end.
    """

    records: dict[int, Record]
    lost: dict[int, str]
    interrupted: bool


def run(plan: Plan, jobs: int = 1, processes: bool = True, progress: Progress = lambda *_: None) -> Outcome:
    """Run the plan's chains, at most `jobs` at a time.

    The first Ctrl-C lets every chain finish its segment and write its checkpoint; a second one raises.

    Raises DerenderError : the fault of the user that stopped a chain (no checkpoint of this run, for instance).
    RuntimeError : every chain was lost.
    """
    jobs = min(jobs, plan.chains)
    with interruptible() as stop:
        if jobs > 1 and processes:
            records, lost = _run_processes(plan, jobs, stop, progress)
        else:
            records, lost = _run_threads(plan, jobs, stop, progress)
    if lost and not records:
        raise RuntimeError("every chain was lost:\n" + "\n".join(lost.values()))
    return Outcome(dict(sorted(records.items())), lost, stop.is_set())


@contextmanager
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


def _run_threads(
    plan: Plan, jobs: int, stop: Any, progress: Callable[..., Any]
) -> tuple[dict[int, Record], dict[int, str]]:
    records: dict[int, Record] = {}
    lost: dict[int, str] = {}

    def one(number: int) -> None:
        if stop.is_set():
            return
        try:
            records[number] = run_chain(plan, number, stop.is_set, progress)
        except DerenderError:
            stop.set()
            raise
        except Exception:  # a bug in one chain must not cost the draws of the others: it is reported with its traceback
            lost[number] = traceback.format_exc()

    if jobs == 1:
        for number in range(plan.chains):
            one(number)
        return records, lost
    with ThreadPoolExecutor(jobs) as pool:
        for future in [pool.submit(one, number) for number in range(plan.chains)]:
            future.result()
    return records, lost


def _run_processes(
    plan: Plan, jobs: int, stop: Any, progress: Callable[..., Any]
) -> tuple[dict[int, Record], dict[int, str]]:
    """Run each chain in a process of its own, at most `jobs` at a time."""
    context, waiting = multiprocessing.get_context("spawn"), deque(range(plan.chains))
    running: dict[Any, tuple[Any, int]] = {}  # by our end of a process's pipe: the process and its chain
    records: dict[int, Record] = {}
    lost: dict[int, str] = {}
    told = False
    try:
        while running or (waiting and not stop.is_set()):
            while waiting and len(running) < jobs and not stop.is_set():
                ours, theirs = context.Pipe()
                process = context.Process(target=_work, args=(theirs, plan, waiting[0]), daemon=True)
                with safe_path():
                    process.start()
                theirs.close()
                running[ours] = process, waiting.popleft()
            if stop.is_set() and not told:
                told = True
                for connection in running:
                    with contextlib.suppress(OSError):  # the process has died: reading from the connection will tell
                        connection.send("stop")
            ready: list[Any] = multiprocessing.connection.wait(list(running), timeout=0.1)
            for connection in ready:
                process, number = running[connection]
                try:
                    kind, content = connection.recv()
                except (EOFError, OSError):
                    process.join()
                    kind, content = "lost", f"the process of chain {number} died with exit status {process.exitcode}"
                if kind == "progress":
                    progress(*content)
                    continue
                del running[connection]
                process.join()
                if kind == "fault":
                    raise content
                if kind == "done":
                    records[number] = content
                else:
                    lost[number] = content
    finally:
        for process, _ in running.values():
            process.terminate()
    return records, lost


def _work(connection: Any, plan: Plan, number: int) -> None:
    """Run one chain for the parent, whose only word is to stop. Ctrl-C is the parent's business."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    progress: Callable = lambda *content: connection.send(("progress", content))  # noqa: E731
    answer: tuple[str, Any]
    try:
        answer = ("done", run_chain(plan, number, connection.poll, progress))
    except DerenderError as fault:
        answer = ("fault", fault)
    except Exception:  # reported by the parent with its traceback
        answer = ("lost", traceback.format_exc())
    connection.send(answer)
