"""The depth images that a command line names: files, folders and patterns, each with a name of its own; and one of
them inferred in a process of its own, told in rows."""

import glob
import multiprocessing
import os
import shlex
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from derender.atomic import locked, make_folder, write_bytes
from derender.camera.camera_file import camera_beside
from derender.camera.depth_file import SUFFIXES, DepthImage, Reading, read_depth
from derender.camera.image_files import png_bytes
from derender.camera.ros_bag import FRAME, bag_frames, is_bag
from derender.errors import DerenderError, is_unicode
from derender.json_text import parse_json
from derender.results.table import failed_row, rows_of
from derender.scene.solids import PLANE
from derender.structures.options import Options

if TYPE_CHECKING:
    from derender.workflow import Request

RESULT, LEDGER = "summary.json", "results.jsonl"  # a folder that holds one of them is a result, no folder of frames
PNG_HEADER, PNG_DEPTH = b"\x89PNG\r\n\x1a\n", 24  # where the bits for one number stand in a PNG
# Seconds for which a file has not changed while it was watched, and since it was written: its writer has finished.
SETTLED, LONG_AGO = 1.0, 60.0


class Frame(NamedTuple):
    """A depth image."""

    name: str  # of its folder among the results, with / where it lay below a folder
    path: str  # as told


def is_many(arguments: Sequence[str]) -> bool:
    """Return whether what a command line names is more than one image: several, a folder or a pattern."""
    if len(arguments) == 1 and is_bag(arguments[0]):
        return FRAME.fullmatch(arguments[0]) is None
    return len(arguments) != 1 or os.path.isdir(arguments[0]) or is_pattern(arguments[0])


def is_pattern(text: str) -> bool:
    """Return whether this is a pattern such as `*.png` and no file of that name."""
    return glob.has_magic(text) and not os.path.exists(text)


def find_frames(
    arguments: Iterable[str],
    output: str | Path,
    empty: bool = False,
    topic: str | None = None,
    warn: Callable[[str], None] = lambda line: None,
) -> list[Frame]:
    """Return the frames that files, folders (and those below them), patterns and bags name, each once, in this order.

    In folders and by patterns only what can be a depth image is taken: nothing inside results or the output folder, no
    hidden file and no PNG of 8 bits, which holds colours or a mask. A file that is named is taken whatever it is.

    empty : whether folders and patterns may have none, as when they are watched.
    topic : of the depth images of ROS bags, each of which has many frames; None: the only one.
    warn : called with a line about what was left out.

    Raises DerenderError : a pattern or a folder without an image.
    """
    found: dict[str, str] = {}  # the name within its folder, by path
    places = set[str]()  # where these paths lead: ./a.npy is a.npy
    output = Path(os.path.realpath(output))
    for argument in arguments:
        shallow: list[str] = []
        if is_bag(argument):
            paths = bag_frames(argument, topic)
        elif os.path.isdir(argument):
            below = _below(Path(argument), output, shallow)
            paths = {path: Path(path).relative_to(argument).with_suffix("").as_posix() for path in below}
        elif is_pattern(argument):
            # Through links that lead back up a file is found again and again: by its shortest path once.
            matches = sorted(glob.glob(argument, recursive=True), key=len, reverse=True)
            matches = sorted({os.path.realpath(path): path for path in matches}.values())
            paths = {path: Path(path).stem for path in matches if _may_be_depth(Path(path), output, shallow)}
        else:
            paths = {argument: Path(argument).stem if argument != "-" else "scene"}
        told = f"{len(shallow)} PNG{'s' * (len(shallow) != 1)} of 8 bits a pixel (colours or masks)"
        if not paths and not empty:
            if os.path.isdir(argument) and output in (here := Path(os.path.realpath(argument)), *here.parents):
                raise DerenderError("the results would lie where the frames do", argument, "choose another -o")
            but = f" but {told}" if shallow else ""
            raise DerenderError(f"no depth image is there{but}", argument, f"a frame is one of {' '.join(SUFFIXES)}")
        if shallow:
            warn(f"{argument}: {told} left out: depth in a PNG has 16")
        for path, name in paths.items():
            place = os.path.join(os.path.realpath(os.path.dirname(path)), os.path.basename(path))
            if is_unicode(path):
                if place not in places:
                    found[path] = name
                places.add(place)
            else:
                warn(f"{path} is left out: its name is not UTF-8, so that no table could hold it")
    return _named(found)


def _below(folder: Path, output: Path, shallow: list[str]) -> list[str]:
    found = []
    for place, folders, files in os.walk(folder):
        if RESULT in files or LEDGER in files:
            folders.clear()
            continue
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        paths = (os.path.join(place, name) for name in sorted(files))
        found += [path for path in paths if _may_be_depth(Path(path), output, shallow)]
    return found


def _may_be_depth(path: Path, output: Path, shallow: list[str]) -> bool:
    """Return whether a file that was not named itself is taken; PNGs of 8 bits are not, and are listed."""
    if path.suffix.lower() not in SUFFIXES or path.name.startswith("."):
        return False
    if (path.parent / RESULT).exists() or output in Path(os.path.realpath(path)).parents:
        return False
    if path.exists() and not path.is_file():  # a folder, or a pipe
        return False
    if path.suffix.lower() != ".png":
        return True
    try:
        with open(path, "rb") as file:
            head = file.read(PNG_DEPTH + 1)
    except OSError:
        return True  # it is told when it is read
    if head.startswith(PNG_HEADER) and len(head) > PNG_DEPTH and head[PNG_DEPTH] <= 8:
        shallow.append(str(path))
        return False
    return True


def _named(found: dict[str, str]) -> list[Frame]:
    """Return frames with names that no two share: where two would, they keep their folders, then their suffixes, and at
    last all folders from the root on."""
    names = dict(found)
    for longer_of in (lambda path: Path(path).with_suffix(""), Path, lambda path: Path(os.path.abspath(path))):
        count = Counter(names.values())
        for path in [path for path, name in names.items() if count[name] > 1]:
            longer = longer_of(path)  # below any folder: no root, no steps upwards
            names[path] = "/".join(part for part in longer.parts if part not in (longer.anchor, "..", "."))
    return [Frame(name, path) for path, name in names.items()]


class Watch:
    """Files that come while others are worked on.

    A file counts when its size and its time have stayed the same for SETTLED seconds: what is still being written is
    left for the next look. A copy may stall for longer than that, so a file that changes later counts again.
    """

    def __init__(self, arguments: Sequence[str], output: str | Path) -> None:
        self.arguments, self.output = arguments, output
        self.taken: dict[str, tuple[int, int]] = {}  # size and time of each file when it was given out
        self.seen: dict[str, tuple[tuple[int, int], float]] = {}

    def look(self, busy: Container[str] = ()) -> list[Frame]:
        """Return the frames that have come, or changed, since the last look and are whole; without those of names that
        are being worked on."""
        now, ready = time.monotonic(), []
        for frame in find_frames(self.arguments, self.output, empty=True):
            try:
                status = os.stat(frame.path)
            except OSError:
                continue
            state = (status.st_size, status.st_mtime_ns)
            if self.taken.get(frame.path) == state or frame.name in busy:
                continue
            former, since = self.seen.get(frame.path, (None, now))
            if former != state:
                self.seen[frame.path] = (state, now)
            old = time.time() - status.st_mtime > LONG_AGO
            if status.st_size and (old or (former == state and now - since >= SETTLED)):
                self.taken[frame.path] = state
                ready.append(frame)
        return ready


IMAGE = "image"  # of a failed frame's line in the ledger: where its image is
OBSERVED, THUMBNAIL = "observation.npz", "thumbnail.png"
THUMBNAIL_WIDTH = 160  # pixels of each half, about


@dataclass(frozen=True)
class Order:
    """What is asked of every frame alike.

    words : the options as they were typed, for the command that each result records: it makes that result alone.
    """

    options: Options = field(default_factory=lambda: Options(seed=0))  # see `workflow.infer_to_folder`
    prior: str | None = None  # see `workflow.infer_to_folder`
    reading: Reading = Reading()  # see `workflow.infer_to_folder`
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

    folder, command = Path(output) / frame.name, order.command(frame)
    return ask(frame.path, order.options, order.prior, folder, order.reading, command, warn)


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
    return Done(frame, [failed_row(frame.name, why) | {IMAGE: os.path.abspath(str(frame.path))}], why)


def still_tells(folder: Path, row: Mapping[str, Any]) -> bool:
    """Return whether a frame's row is about something that is there: its folder, or of a failure its image.

    Without either it was removed by hand. A row that does not say its image, as of an older version, stays.
    """
    if row["status"] == "done":
        return is_done(folder / row["frame"])
    image = str(row.get(IMAGE) or folder)
    recording = FRAME.fullmatch(image)
    return os.path.exists(recording[1] if recording else image)


def is_done(folder: Path) -> bool:
    """Return whether a frame's folder is whole: its thumbnail is written last."""
    return (folder / RESULT).is_file() and (folder / THUMBNAIL).is_file()


def is_outdated(folder: Path, frame: Frame, order: Order) -> bool:
    """Return whether the result in a frame's folder is of another image or camera than are there now.

    They are read anew only where one of their files changed after the result was written.
    """
    recording = FRAME.fullmatch(frame.path)
    files = [recording[1] if recording else frame.path, order.reading.camera or camera_beside(frame.path)]
    try:
        changes = [os.stat(file) for file in files if file is not None]
    except OSError:  # its image has gone, and the result stays
        return False
    try:
        made = (folder / THUMBNAIL).stat().st_mtime
        if all(max(each.st_mtime, each.st_ctime) < made for each in changes):
            return False
        seen, kept = request_of(frame, order, str(folder.parent), lambda line: None).seen, read_depth(folder / OBSERVED)
    except (OSError, DerenderError):  # another process makes it again; or it cannot be read, as is told by inferring it
        return True
    same = np.array_equal(seen.depth.astype(np.float32), kept.depth.astype(np.float32), equal_nan=True)
    return not same or seen.camera != kept.camera


def rows_in(folder: Path, name: str) -> list[dict[str, Any]]:
    """Return the rows of a frame that is done; DerenderError where its summary is none."""
    try:
        with locked(folder):  # another process may be writing it
            return rows_of(name, parse_json((folder / RESULT).read_bytes()))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, DerenderError) as fault:
        raise DerenderError("this is no summary of a result", folder / RESULT) from fault


def write_thumbnail(path: Path, posterior: Any, seen: DepthImage) -> None:
    """Write a small picture: the depth image, and beside it the best scene."""
    from derender.render.raycast.depth import render_depth
    from derender.report import pictures

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

    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def end() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()
