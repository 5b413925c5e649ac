"""The depth images that a command line names: files, folders and patterns, each with a name of its own."""

import glob
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from derender.camera.ros_bag import FRAME, bag_frames, is_bag
from derender.errors import DerenderError, is_unicode

SUFFIXES = (".png", ".npy", ".npz", ".tif", ".tiff", ".exr")
RESULT, LEDGER = "summary.json", "results.jsonl"  # a folder that holds one of them is a result, no folder of frames
PNG_HEADER, PNG_DEPTH = b"\x89PNG\r\n\x1a\n", 24  # where the bits for one number stand in a PNG
SETTLED = 1.0  # seconds for which a file has not changed: whoever writes it has finished


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
    output = Path(os.path.realpath(output))
    for argument in arguments:
        shallow: list[str] = []
        if is_bag(argument):
            paths = bag_frames(argument, topic)
        elif os.path.isdir(argument):
            paths = {path: _inside(path, argument) for path in _below(Path(argument), output, shallow)}
        elif is_pattern(argument):
            # Through links that lead back up a file is found again and again: by its shortest path once.
            matches = sorted(glob.glob(argument, recursive=True), key=len, reverse=True)
            matches = sorted({os.path.realpath(path): path for path in matches}.values())
            paths = {path: Path(path).stem for path in matches if _may_be_depth(Path(path), output, shallow)}
        else:
            paths = {argument: Path(argument).stem if argument != "-" else "scene"}
        told = f"{len(shallow)} PNG{'s' * (len(shallow) != 1)} of 8 bits a pixel (colours or masks)"
        if not paths and not empty:
            but = f" but {told}" if shallow else ""
            raise DerenderError(f"no depth image is there{but}", argument, f"a frame is one of {' '.join(SUFFIXES)}")
        if shallow:
            warn(f"{argument}: {told} left out: depth in a PNG has 16")
        for path, name in paths.items():
            if is_unicode(path):
                found.setdefault(path, name)
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


def _inside(path: str, folder: str) -> str:
    """Return a path below a folder without folder and suffix."""
    return Path(path).relative_to(folder).with_suffix("").as_posix()


def _named(found: dict[str, str]) -> list[Frame]:
    """Return frames with names that no two share: where two would, they keep their folders, and then their suffixes."""
    longer = [lambda path: _rooted(Path(path).with_suffix("")), lambda path: _rooted(Path(path))]
    names = dict(found)
    for other in longer:
        count = Counter(names.values())
        names = {path: name if count[name] == 1 else other(path) for path, name in names.items()}
    return [Frame(name, path) for path, name in names.items()]


def _rooted(path: Path) -> str:
    """Return a path as one below any folder: without its root and without steps upwards."""
    return "/".join(part for part in path.parts if part not in (path.anchor, "..", "."))


class Watch:
    """Files that come while others are worked on.

    A file counts when its size and its time have stayed the same for SETTLED seconds: what is still being written is
    left for the next look.
    """

    def __init__(self, arguments: Sequence[str], output: str | Path) -> None:
        self.arguments, self.output = arguments, output
        self.known: set[str] = set()
        self.seen: dict[str, tuple[tuple[int, int], float]] = {}

    def look(self) -> list[Frame]:
        """Return the frames that have come since the last look and are whole."""
        now, ready = time.monotonic(), []
        for frame in find_frames(self.arguments, self.output, empty=True):
            if frame.path in self.known:
                continue
            try:
                status = os.stat(frame.path)
            except OSError:
                continue
            state = (status.st_size, status.st_mtime_ns)
            former, since = self.seen.get(frame.path, (None, now))
            if former != state:
                self.seen[frame.path] = (state, now)
            old = time.time() - status.st_mtime > 2 * SETTLED  # it lay there before we came
            if status.st_size and (old or (former == state and now - since >= SETTLED)):
                self.known.add(frame.path)
                ready.append(frame)
        return ready
