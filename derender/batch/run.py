"""The story of many frames: what is missing is inferred, told and gathered, until all is done or someone stops it."""

import os
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context, resource_tracker
from pathlib import Path
from typing import NamedTuple, Protocol

from derender.batch.frames import Frame, Watch, find_frames
from derender.batch.ledger import Ledger
from derender.batch.work import Done, Order, failure, infer_frame, leave_with_parent
from derender.compilation.threads import THREADS_VARIABLE, interruptible, safe_path
from derender.errors import DerenderError

LOOK = 0.2  # seconds between two looks at what is finished and at what has come
GATHER = 2.0  # seconds between two writings of the tables while frames are in work


class Crew(Protocol):
    """Who infers frames: processes on this machine, or a cluster."""

    @property
    def size(self) -> int:
        """How many frames can be in work at a time."""

    @property
    def busy(self) -> int:
        """How many frames are in work."""

    def submit(self, frame: Frame) -> None:
        """Begin to infer a frame."""

    def finished(self, timeout: float) -> list[Done]:
        """Return what was finished since the last call; waits at most so many seconds for the first."""

    def close(self) -> None:
        """End it."""


class Tally(NamedTuple):
    """How it went: frames done, of these not to be trusted, failed, done before; whether someone stopped it."""

    done: int
    doubtful: int
    failed: int
    before: int
    interrupted: bool
    seconds: float  # from the first frame's beginning to the last one's end


def infer_frames(
    arguments: Sequence[str],
    output: str | Path,
    order: Order,
    crew_of: Callable[[Order, str], Crew],
    watch: bool = False,
    tell: Callable[[Done], None] = lambda done: None,
    progress: Callable[[float, str], None] = lambda share, words: None,
    warn: Callable[[str], None] = lambda line: None,
) -> Tally:
    """Infer every frame that has no result in the output folder yet, and write the tables.

    arguments : files, folders and patterns. output : the folder of all results.
    crew_of : makes the crew, from the order and the output folder.
    watch : go on as frames come into the folders, until Ctrl-C.
    tell : called with each frame that is done, in the order of the frames whichever is done first; while watching, in
        the order in which they are done.
    progress : called with (fraction done, words about the frames and the time left).
    warn : called with a line about files that are left out.

    Raises DerenderError : no frame, or results of other options in the folder.
    """
    watcher = Watch(arguments, output) if watch else None
    frames = watcher.look() if watcher else find_frames(arguments, output, topic=order.reading.topic, warn=warn)
    if any(frame.path == "-" for frame in frames):  # whoever infers it is another process
        raise DerenderError("stdin is one image alone", "-", "leave it out, or give it without others")
    ledger = Ledger(output, order)
    waiting = deque(ledger.missing(frames))
    before, total = len(frames) - len(waiting), len(waiting)
    count = {"done": 0, "doubtful": 0, "failed": 0}
    in_turn = _InTurn([] if watch else [frame.name for frame in waiting], tell)
    started = gathered = time.monotonic()
    crew = crew_of(order, str(output))
    try:
        with interruptible() as stop:
            while crew.busy or (not stop.is_set() and (waiting or watcher)):
                while waiting and crew.busy < crew.size and not stop.is_set():
                    crew.submit(waiting.popleft())
                for done in crew.finished(LOOK):
                    if done.died and stop.is_set():  # by the signal that is to end all: it is done on the next run
                        continue
                    ledger.record(done)
                    count["failed" if done.error else "done"] += 1
                    count["doubtful"] += not done.error and not done.rows[0]["trusted"]
                    in_turn.add(done)
                now, over = time.monotonic(), count["done"] + count["failed"]
                if now - gathered > GATHER and over:
                    ledger.write_tables()
                    gathered = now
                if watcher and not stop.is_set():
                    come = ledger.missing(watcher.look())
                    waiting.extend(come)
                    total += len(come)
                    if not crew.busy and not waiting:
                        time.sleep(LOOK)
                if total:
                    progress(over / total, words(over, total, now - started, watch))
            interrupted = stop.is_set()
    finally:
        crew.close()
        ledger.write_tables(ended=True)
    return Tally(**count, before=before, interrupted=interrupted, seconds=time.monotonic() - started)


def words(over: int, total: int, seconds: float, watch: bool = False) -> str:
    """Return what a bar says: how many frames are left, and about how long that takes."""
    left = total - over
    said = f"{left} of {total} frames left"
    if watch and not left:
        return f"{total} frames done, watching"
    return f"{said}, {duration(seconds / over * left)}" if over else said


def duration(seconds: float) -> str:
    """Return a time for a person: 40 s, 3 min or 2 h 05 min."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"


class _InTurn:
    """Tells of frames in their order: one that is done early waits for those before it."""

    def __init__(self, names: Sequence[str], tell: Callable[[Done], None]) -> None:
        self.names, self.tell = deque(names), tell
        self.early: dict[str, Done] = {}
        self.ordered = bool(names)

    def add(self, done: Done) -> None:
        if not self.ordered:
            self.tell(done)
            return
        self.early[done.frame.name] = done
        while self.names and self.names[0] in self.early:
            self.tell(self.early.pop(self.names.popleft()))


# A terminal or a scheduler sends them to all processes of a group.
ENDING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


@contextmanager
def held(signals: Sequence[int]) -> Iterator[None]:
    """Hold signals back meanwhile; a process that is started here holds them back for good."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class Processes:
    """So many processes, each an executor of its own: one that dies takes only the frame with it that it was on."""

    def __init__(self, size: int, order: Order, output: str) -> None:
        self.size, self.order, self.output = size, order, output
        self._idle: list[ProcessPoolExecutor] = []
        self._busy: dict[Future, tuple[ProcessPoolExecutor, Frame]] = {}
        self._context = get_context("spawn")
        with held(ENDING):
            resource_tracker.ensure_running()

    @property
    def busy(self) -> int:
        """How many frames are in work."""
        return len(self._busy)

    def submit(self, frame: Frame) -> None:
        """Begin to infer a frame; fewer than `size` are in work."""
        with safe_path(), held(ENDING):  # an executor starts its process with its first task
            executor = self._idle.pop() if self._idle else ProcessPoolExecutor(1, self._context, _begin)
            self._busy[executor.submit(infer_frame, frame, self.order, self.output)] = (executor, frame)

    def finished(self, timeout: float) -> list[Done]:
        """Return the frames that were finished since the last call; waits for one for so many seconds at most."""
        done = []
        for future in wait(self._busy, timeout, FIRST_COMPLETED).done:
            executor, frame = self._busy.pop(future)
            try:
                done.append(future.result())
                self._idle.append(executor)
            except BrokenProcessPool:
                executor.shutdown(wait=False)
                why = "the process that worked on it died: there may be too little memory"
                done.append(failure(frame, why)._replace(died=True))
        return done

    def close(self) -> None:
        """End the processes; what is in work is given up."""
        for executor in [*self._idle, *(executor for executor, _ in self._busy.values())]:
            for process in list((executor._processes or {}).values()):
                process.kill()
            executor.shutdown(wait=False, cancel_futures=True)


def _begin() -> None:
    """Make this process one of many: signals to end are its parent's business, and one thread is its share."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)
    os.environ[THREADS_VARIABLE] = "1"
    leave_with_parent()
