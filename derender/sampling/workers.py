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
            records, lost = _Processes(plan, stop, progress).run(jobs)
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


class _Processes:
    """Chains over processes, a process for each of `jobs` at a time.

    workers : by our end of a process's pipe: the process, and the number of its chain or None.
    records, lost : by chain, see `Outcome`. fault : of the user's, which ends all.
    """

    def __init__(self, plan: Plan, stop: Any, progress: Callable[..., Any]) -> None:
        self.plan, self.stop, self.progress = plan, stop, progress
        self.context = multiprocessing.get_context("spawn")
        self.waiting = deque(range(plan.chains))
        self.workers: dict[Any, tuple[Any, int | None]] = {}
        self.records: dict[int, Record] = {}
        self.lost: dict[int, str] = {}
        self.fault: BaseException | None = None

    def run(self, jobs: int) -> tuple[dict[int, Record], dict[int, str]]:
        """Return (records, lost)."""
        told = False
        try:
            for _ in range(jobs):
                self._hire()
            while self.workers:
                if self.stop.is_set() and not told:
                    told = True
                    for connection in self.workers:
                        self._tell(connection, ("stop", None))
                for connection in multiprocessing.connection.wait(list(self.workers), timeout=0.1):
                    self._hear(connection)
        finally:
            for process, _ in self.workers.values():
                process.terminate()
        if self.fault is not None:
            raise self.fault
        return self.records, self.lost

    def _hire(self) -> None:
        ours, theirs = self.context.Pipe()
        process = self.context.Process(target=_work, args=(theirs, self.plan), daemon=True)
        with safe_path():
            process.start()
        theirs.close()
        self.workers[ours] = (process, None)
        self._assign(ours)

    def _assign(self, connection: Any) -> None:
        process, _ = self.workers[connection]
        number = None if not self.waiting or self.stop.is_set() else self.waiting.popleft()
        self.workers[connection] = (process, number)
        self._tell(connection, ("leave", None) if number is None else ("run", number))

    def _tell(self, connection: Any, message: tuple[str, int | None]) -> None:
        with contextlib.suppress(OSError):  # the process has died: reading from the connection will tell
            connection.send(message)

    def _hear(self, connection: Any) -> None:
        process, number = self.workers[connection]
        try:
            kind, content = connection.recv()
        except (EOFError, OSError):
            del self.workers[connection]
            process.join()
            if number is not None:
                self.lost[number] = f"the process of chain {number} died with exit status {process.exitcode}"
                if self.waiting and not self.stop.is_set():
                    self._hire()
            return
        if kind == "progress":
            self.progress(*content)
            return
        assert number is not None, "only a process that is on a chain answers"
        if kind == "done":
            self.records[number] = content
        elif kind == "fault":
            self.fault = content
            self.stop.set()
        else:
            self.lost[number] = content
        self._assign(connection)


def _work(connection: Any, plan: Plan) -> None:
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
