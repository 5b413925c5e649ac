"""Several chains at once, over threads (where the sampler runs compiled and lets go of the interpreter) or processes.

Threads start at no cost but die together; spawned processes cost about a second each (imports, compiled code from its
cache) and one that dies takes only the chain with it that it was on.
"""

import multiprocessing
import multiprocessing.connection
import queue
import signal
import threading
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, NamedTuple

from derender.errors import DerenderError
from derender.inference.chains import Plan, Progress, run_chain
from derender.inference.checkpoint import Record


class Outcome(NamedTuple):
    """What came of a run.

    Attributes
    ----------
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

    Raises
    ------
    DerenderError : the fault of the user that stopped a chain (no checkpoint of this run, for instance).
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


def _run_threads(plan, jobs, stop, progress):
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


def _run_processes(plan, jobs, stop, progress):
    context = multiprocessing.get_context("spawn")
    waiting: queue.SimpleQueue[int] = queue.SimpleQueue()
    for number in range(plan.chains):
        waiting.put(number)
    records: dict[int, Record] = {}
    lost: dict[int, str] = {}
    workers: dict = {}

    def hire() -> None:
        ours, theirs = context.Pipe()
        process = context.Process(target=_work, args=(theirs, plan), daemon=True)
        process.start()
        theirs.close()
        workers[ours] = (process, None)
        assign(ours)

    def assign(connection) -> None:
        process, _ = workers[connection]
        number = None if waiting.empty() or stop.is_set() else waiting.get()
        workers[connection] = (process, number)
        tell(connection, ("leave", None) if number is None else ("run", number))

    def tell(connection, message) -> None:
        try:
            connection.send(message)
        except OSError:
            pass  # the process has died: reading from the connection will tell

    told = False
    fault: BaseException | None = None
    try:
        for _ in range(jobs):
            hire()
        while workers:
            if stop.is_set() and not told:
                told = True
                for connection in workers:
                    tell(connection, ("stop", None))
            for connection in multiprocessing.connection.wait(list(workers), timeout=0.1):
                process, number = workers[connection]
                try:
                    kind, content = connection.recv()
                except (EOFError, OSError):
                    del workers[connection]
                    process.join()
                    if number is not None:
                        lost[number] = f"the process of chain {number} died with exit status {process.exitcode}"
                        if not waiting.empty() and not stop.is_set():
                            hire()
                    continue
                if kind == "progress":
                    progress(*content)
                    continue
                if kind == "done":
                    records[number] = content
                elif kind == "fault":
                    fault = content
                    stop.set()
                else:
                    lost[number] = content
                assign(connection)
    finally:
        for process, _ in workers.values():
            process.terminate()
    if fault is not None:
        raise fault
    return records, lost


def _work(connection, plan: Plan) -> None:
    """Serve chains to the parent until it says leave. Ctrl-C is the parent's business."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    stopped = False

    def stop() -> bool:
        nonlocal stopped
        if not stopped and connection.poll():
            kind, _ = connection.recv()
            stopped = kind == "stop"
        return stopped

    progress: Callable = lambda *content: connection.send(("progress", content))  # noqa: E731
    while True:
        kind, number = connection.recv()
        if kind == "stop":
            stopped = True
            continue
        if kind == "leave":
            return
        answer: tuple[str, Any]
        try:
            answer = ("done", run_chain(plan, number, stop, progress))
        except DerenderError as fault:
            answer = ("fault", fault)
        except Exception:  # reported by the parent with its traceback
            answer = ("lost", traceback.format_exc())
        connection.send(answer)
