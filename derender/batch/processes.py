"""Processes on this machine that infer frames, one each at a time."""

import os
import signal
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context

from derender.batch.frames import Frame
from derender.batch.work import Done, Order, failure, infer_frame, leave_with_parent
from derender.compilation.threads import THREADS_VARIABLE, safe_path

ENDING = ("SIGINT", "SIGTERM", "SIGHUP")  # a terminal or a scheduler sends them to all processes of a group


class Processes:
    """So many processes, each an executor of its own: one that dies takes only the frame with it that it was on."""

    def __init__(self, size: int, order: Order, output: str) -> None:
        self._size, self.order, self.output = size, order, output
        self._idle: list[ProcessPoolExecutor] = []
        self._busy: dict[Future, tuple[ProcessPoolExecutor, Frame]] = {}
        self._context = get_context("spawn")

    @property
    def size(self) -> int:
        """How many frames can be in work at a time."""
        return self._size

    @property
    def busy(self) -> int:
        """How many frames are in work."""
        return len(self._busy)

    def submit(self, frame: Frame) -> None:
        """Begin to infer a frame; fewer than `size` are in work."""
        executor = self._idle.pop() if self._idle else ProcessPoolExecutor(1, self._context, _begin)
        with safe_path():  # an executor starts its process with its first task
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
    for name in ENDING:
        if hasattr(signal, name):  # not on Windows
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    os.environ[THREADS_VARIABLE] = "1"
    leave_with_parent()
