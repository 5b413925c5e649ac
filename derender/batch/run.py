"""The story of many frames: what is missing is inferred, told and gathered, until all is done or someone stops it.

On a Dask cluster frames are read here, inferred there, written here: the workers need derender, but no file of ours.
"""

import os
import signal
import socket
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context, resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from derender.atomic import ROOM, files_together, make_folder, write_bytes
from derender.batch.frames import (
    THUMBNAIL,
    Done,
    Frame,
    Order,
    Watch,
    answer_frame,
    attempt,
    failure,
    find_frames,
    infer_frame,
    is_pattern,
    leave_with_parent,
    request_of,
)
from derender.batch.ledger import Ledger
from derender.compilation.threads import THREADS_VARIABLE, each_one_of_many, interruptible
from derender.errors import DerenderError, optional
from derender.json_text import parse_json

if TYPE_CHECKING:
    from derender.workflow import Request

LOOK = 0.2  # seconds between two looks at what is finished and at what has come
# Seconds between two writings of the tables while frames are in work, and at least so many times what the last one
# took: tables of thousands of frames take longer than one frame.
GATHER, SELDOM = 2.0, 50.0


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
    crew_of: Callable[[Order, str], "Crew"],
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
    warn : called with a line about files that are left out, or are watched and not there yet.

    Raises DerenderError : no frame, or results of other options in the folder; or its disk is full.
    """
    watcher = Watch(arguments, output) if watch else None
    for argument in arguments if watch else ():
        if not (is_pattern(argument) or os.path.exists(argument)):
            warn(f"{argument} is not there yet: it is waited for")
    frames = watcher.look() if watcher else find_frames(arguments, output, topic=order.reading.topic, warn=warn)
    if any(frame.path == "-" for frame in frames):  # whoever infers it is another process
        raise DerenderError("stdin is one image alone", "-", "leave it out, or give it without others")
    if order.prior or order.options.known:  # a fault in these is none of each frame
        from derender.workflow import asked_of_any  # which takes a tenth of a second to import

        asked_of_any(order.options, order.prior)
    ledger = Ledger(output, order)
    waiting = deque(ledger.missing(frames, warn))
    before, total, over = {frame.name for frame in frames} - {frame.name for frame in waiting}, len(waiting), 0
    count, failed = {"done": 0, "doubtful": 0}, set[str]()  # failed : names; one that changes may yet be done
    busy = {frame.name for frame in waiting}
    in_turn = deque([] if watch else [frame.name for frame in waiting])
    early: dict[str, Done] = {}  # by name: a frame waits for those before it
    started = time.monotonic()
    due = started + GATHER
    crew = crew_of(order, str(output))

    def begin() -> None:
        while waiting and crew.busy < crew.size and not stop.is_set():
            crew.submit(waiting.popleft())

    try:
        with interruptible() as stop:
            while crew.busy or (not stop.is_set() and (waiting or watcher)):
                if waiting:
                    make_folder(output, ROOM)  # else all that are left would be inferred in vain
                begin()
                finished = crew.finished(LOOK)
                begin()  # nobody waits while the others are told of
                for done in finished:
                    if done.died and stop.is_set():  # by the signal that is to end all: it is done on the next run
                        continue
                    ledger.record(done)
                    over += 1
                    busy.discard(done.frame.name)
                    failed.discard(done.frame.name)
                    if done.error:
                        failed.add(done.frame.name)
                    count["done"] += not done.error
                    count["doubtful"] += not done.error and not done.rows[0]["trusted"]
                    early[done.frame.name] = done
                    while early and (watch or in_turn[0] in early):
                        tell(early.pop(done.frame.name if watch else in_turn.popleft()))
                now = time.monotonic()
                if now > due and over:
                    ledger.write_tables()
                    due = time.monotonic() + max(GATHER, SELDOM * (time.monotonic() - now))
                if watcher and not stop.is_set():
                    found = watcher.look(busy)
                    come = ledger.missing(found, warn)
                    waiting.extend(come)
                    busy.update(frame.name for frame in come)
                    before |= {frame.name for frame in found} - busy - ledger.recorded
                    total += len(come)
                    if not crew.busy and not waiting:
                        time.sleep(LOOK)
                if total:
                    progress(over / total, words(over, total, now - started, watch))
            interrupted = stop.is_set()
    finally:
        crew.close()
        ledger.write_tables(ended=True)
    return Tally(
        **count, failed=len(failed), before=len(before), interrupted=interrupted, seconds=time.monotonic() - started
    )


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
        with each_one_of_many(), held(ENDING):
            resource_tracker.ensure_running()

    @property
    def busy(self) -> int:
        """How many frames are in work."""
        return len(self._busy)

    def submit(self, frame: Frame) -> None:
        """Begin to infer a frame; fewer than `size` are in work."""
        with each_one_of_many(), held(ENDING):  # an executor starts its process with its first task
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
    """Make this process one of many: signals to end are its parent's business."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)
    leave_with_parent()


AHEAD = 2  # frames for each thread of the cluster that are sent before they are asked for: none of them ever waits
PATIENCE = 5  # seconds for the scheduler to answer
GREETING = 1_000_000  # bytes: Dask's first message begins with its length, and is far shorter
SCHEDULER = "give tcp://HOST:PORT of a running `dask scheduler`, or its scheduler file"


class Cluster:
    """A crew behind a Dask scheduler.

    A worker that dies loses nothing: the scheduler gives its frames to others, and those that come back twice are
    written once. A frame that takes several workers down with it is told as failed.
    """

    def __init__(self, scheduler: str, order: Order, output: str) -> None:
        dask = optional("distributed", "Dask is not installed", "pip install 'derender[dask]'", "--scheduler")
        if "://" not in scheduler and ":" not in scheduler and not os.path.isfile(scheduler):
            raise DerenderError("there is no such scheduler file", scheduler, SCHEDULER)
        _check_that_one_answers(scheduler)
        given = {"scheduler_file": scheduler} if os.path.isfile(scheduler) else {"address": scheduler}
        try:
            self.client = dask.Client(**given, timeout=PATIENCE, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise DerenderError(f"no scheduler answers ({error})", scheduler, SCHEDULER) from None
        self.order, self.output = order, output
        self._futures: dict = {}
        self._failed: list[Done] = []

    @property
    def size(self) -> int:
        """How many frames can be in work: more as workers come, fewer as they go."""
        return AHEAD * max(1, sum(self.client.nthreads().values()))

    @property
    def busy(self) -> int:
        """How many frames are in work."""
        return len(self._futures) + len(self._failed)

    def submit(self, frame: Frame) -> None:
        """Read a frame and send it."""
        warnings: list[str] = []
        try:
            request = request_of(frame, self.order, self.output, warnings.append)
        except DerenderError as fault:
            self._failed.append(failure(frame, str(fault)))
            return
        future = self.client.submit(answer_elsewhere, frame, request, self.order.page, pure=False)
        self._futures[future] = (frame, tuple(warnings))

    def finished(self, timeout: float) -> list[Done]:
        """Return the frames that were finished since the last call; waits for one for so many seconds at most."""
        done, self._failed = self._failed, []
        end = time.monotonic() + timeout
        while not done:
            for future in [future for future in self._futures if future.done()]:
                frame, warnings = self._futures.pop(future)
                done.append(self._take(future, frame, warnings))
            if done or time.monotonic() > end:
                break
            time.sleep(min(0.02, timeout))
        return done

    def _take(self, future: Any, frame: Frame, warnings: tuple[str, ...]) -> Done:
        """Return what came of a frame, its files written."""
        if future.status != "finished":
            error = future.exception()
            return failure(frame, f"the cluster gave it up: {type(error).__name__}: {error}"[:300])
        done, files = future.result()
        future.release()
        if files:
            try:
                write_files(make_folder(Path(self.output) / frame.name), files)
            except DerenderError as fault:
                return failure(frame, str(fault))
        return done._replace(warnings=(*warnings, *done.warnings))

    def close(self) -> None:
        """Give up what is in work and leave the cluster as it is."""
        self.client.cancel(list(self._futures))
        self.client.close()


def _check_that_one_answers(scheduler: str) -> None:
    """Raise a DerenderError where no Dask scheduler listens: Dask itself goes on asking, or trusts what answers it."""
    address = scheduler
    if os.path.isfile(scheduler):
        told = parse_json(Path(scheduler).read_bytes(), scheduler)
        if not isinstance(told, dict) or "address" not in told:
            raise DerenderError("this is no scheduler file", scheduler, SCHEDULER)
        address = str(told["address"])
    transport, _, place = address.rpartition("://")
    host, _, port = place.rpartition(":")
    if transport not in ("", "tcp"):
        return
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=PATIENCE) as connection:
            greeting = connection.recv(8, socket.MSG_WAITALL)
    except (OSError, ValueError, OverflowError) as error:
        reason = str(error) if isinstance(error, OSError) else "no such port"
        raise DerenderError(f"no scheduler answers ({reason})", scheduler, SCHEDULER) from None
    if len(greeting) < 8 or int.from_bytes(greeting, "little") > GREETING:
        raise DerenderError("what answers there is no Dask scheduler", scheduler, SCHEDULER)


def answer_elsewhere(frame: Frame, request: "Request", page: bool) -> tuple[Done, dict[str, bytes]]:
    """Infer a frame on a worker; return what came of it and its files by name."""
    os.environ.setdefault(THREADS_VARIABLE, "1")
    with tempfile.TemporaryDirectory() as folder:
        done = attempt(frame, lambda warn: answer_frame(frame, request, page, Path(folder), warn))
        files = {path.name: path.read_bytes() for path in Path(folder).iterdir() if path.is_file() and not done.error}
    return done, files


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write a frame's files as one set, its thumbnail last: then it is whole."""
    with files_together(folder, files) as place:
        for name, data in files.items():
            if name != THUMBNAIL:
                (place / name).write_bytes(data)
    write_bytes(folder / THUMBNAIL, files[THUMBNAIL])


Crew = Processes | Cluster  # who infers frames: processes on this machine, or a cluster
