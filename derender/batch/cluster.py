"""Frames on a Dask cluster: read here, inferred there, written here. The workers need derender, but no file of ours."""

import os
import socket
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from derender.atomic import files_together, make_folder, write_bytes
from derender.batch.frames import Frame
from derender.batch.work import THUMBNAIL, Done, Order, answer_frame, attempt, failure, request_of
from derender.compilation.threads import THREADS_VARIABLE
from derender.errors import DerenderError
from derender.json_text import parse_json

if TYPE_CHECKING:
    from derender.workflow import Request

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
        try:
            from distributed import Client
        except ImportError:
            remedy = "pip install 'derender[dask]'"
            raise DerenderError("Dask is not installed", "--scheduler", remedy) from None
        if "://" not in scheduler and ":" not in scheduler and not os.path.isfile(scheduler):
            raise DerenderError("there is no such scheduler file", scheduler, SCHEDULER)
        _check_that_one_answers(scheduler)
        given = {"scheduler_file": scheduler} if os.path.isfile(scheduler) else {"address": scheduler}
        try:
            self.client = Client(**given, timeout=PATIENCE, set_as_default=False)
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
        files = (
            {} if done.error else {path.name: path.read_bytes() for path in Path(folder).iterdir() if path.is_file()}
        )
    return done, files


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write a frame's files as one set, its thumbnail last: then it is whole."""
    with files_together(folder, files) as place:
        for name, data in files.items():
            if name != THUMBNAIL:
                (place / name).write_bytes(data)
    write_bytes(folder / THUMBNAIL, files[THUMBNAIL])
