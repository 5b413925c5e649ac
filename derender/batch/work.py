"""One frame of many: inferred in a process of its own, told in rows."""

import json
import os
import shlex
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from derender.atomic import locked, make_folder, write_bytes
from derender.batch.frames import RESULT, Frame
from derender.camera.depth_file import Reading
from derender.errors import DerenderError
from derender.results.table import failed_row, rows_of
from derender.structures.options import Options

if TYPE_CHECKING:
    from derender.camera.depth_file import DepthImage
    from derender.workflow import Request

THUMBNAIL = "thumbnail.png"
THUMBNAIL_WIDTH = 160  # pixels of each half, about


@dataclass(frozen=True)
class Order:
    """What is asked of every frame alike.

    words : the options as they were typed, for the command that each result records: it makes that result alone.
    """

    options: Options = field(default_factory=lambda: Options(seed=0))  # see `workflow.infer_to_folder`
    prior: str | None = None  # see `workflow.infer_to_folder`
    reading: Reading = Reading()  # see `workflow.infer_to_folder`
    gradient: str = "exact"  # see `workflow.infer_to_folder`
    page: bool = False  # whether each frame gets its report.html at once
    words: Sequence[str] = ()

    def command(self, frame: Frame) -> str:
        """Return the command that infers this frame alone."""
        return shlex.join(["derender", "infer", frame.path, *self.words])


class Done(NamedTuple):
    """What came of a frame."""

    frame: Frame  # which
    rows: list[dict[str, Any]]  # of the table, see `table.COLUMNS`
    error: str = ""  # why there is no result, in a line, or ""
    trace: str = ""  # of a fault that is ours, or ""
    warnings: tuple[str, ...] = ()  # lines for a person
    seconds: float = 0.0  # that it took
    died: bool = False  # whether the process that worked on it ended under it


def infer_frame(frame: Frame, order: Order, output: str) -> Done:
    """Infer a frame into its folder below `output`; whatever goes wrong with it is told, not raised."""

    def rows(warn: Callable[[str], None]) -> list[dict[str, Any]]:
        request = request_of(frame, order, output, warn)
        return answer_frame(frame, request, order.page, make_folder(Path(output) / frame.name), warn)

    return attempt(frame, rows)


def attempt(frame: Frame, work: Callable[[Callable[[str], None]], list[dict[str, Any]]]) -> Done:
    """Return what came of a frame: of work that takes a function to warn with and returns the rows of its table."""
    started, warnings = time.monotonic(), []
    try:
        done = Done(frame, work(warnings.append))
    except DerenderError as fault:
        done = failure(frame, str(fault))
    except Exception as fault:  # a bug: it must not cost the other frames their results, so it is shown with its trace
        error = f"{type(fault).__name__}: {' '.join(str(fault).split())}"[:300]
        done = failure(frame, error)._replace(trace=traceback.format_exc())
    return done._replace(warnings=tuple(warnings), seconds=time.monotonic() - started)


def request_of(frame: Frame, order: Order, output: str, warn: Callable[[str], None]) -> "Request":
    """Read a frame and return what is asked of it; DerenderError where it cannot be read."""
    from derender.workflow import ask

    folder = Path(output) / frame.name
    return ask(
        frame.path, order.options, order.prior, folder, order.reading, order.gradient,
        order.command(frame), warn,
    )  # fmt: skip


def answer_frame(
    frame: Frame, request: "Request", page: bool, folder: Path, warn: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Infer a frame that has been read, into a folder, and return its rows."""
    from derender.workflow import answer

    outcome = answer(request, folder, page, warn=warn)
    write_thumbnail(folder / THUMBNAIL, outcome.posterior, request.seen)
    return rows_in(folder, frame.name)


def failure(frame: Frame, why: str) -> Done:
    """Return what is told of a frame without a result."""
    return Done(frame, [failed_row(frame.name, why)], why)


def is_done(folder: Path) -> bool:
    """Return whether a frame's folder is whole: its thumbnail is written last."""
    return (folder / RESULT).exists() and (folder / THUMBNAIL).exists()


def rows_in(folder: Path, name: str) -> list[dict[str, Any]]:
    """Return the rows of a frame that is done; DerenderError where its summary is none."""
    try:
        with locked(folder):  # another process may be writing it
            return rows_of(name, json.loads((folder / RESULT).read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as fault:
        raise DerenderError("this is no summary of a result", folder / RESULT) from fault


def write_thumbnail(path: Path, posterior: Any, seen: "DepthImage") -> None:
    """Write a small picture: the depth image, and beside it the best scene."""
    import numpy as np

    from derender.camera.image_files import png_bytes
    from derender.render.raycast.depth import render_depth
    from derender.report import pictures
    from derender.scene.solids import PLANE

    step = max(1, round(seen.depth.shape[1] / THUMBNAIL_WIDTH))
    depth, camera = seen.depth[step // 2 :: step, step // 2 :: step], seen.camera.downscaled(step)
    depth = depth[: camera.height, : camera.width]
    graph = posterior.best_graph()
    solids = graph.solids()
    things = np.isin(render_depth(solids, camera)[1], np.flatnonzero(solids.kind != PLANE))
    left = pictures.paint(depth, *pictures.depth_limits(depth, things), pictures.DEPTH_ANCHORS)
    right = pictures.shade(solids, camera, graph.solid_names, samples=1, shadows=False)
    write_bytes(path, png_bytes(np.hstack([left, right])))


def leave_with_parent() -> None:
    """End this process as soon as the one that started it has gone, however that came about."""
    import multiprocessing
    import threading
    from multiprocessing.process import BaseProcess

    def end_with(parent: BaseProcess) -> None:
        parent.join()
        os._exit(1)

    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=end_with, args=(parent,), daemon=True).start()
