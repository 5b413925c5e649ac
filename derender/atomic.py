"""Writing files so that a reader, or a crash, never meets half of one."""

import os
import shutil
import stat
import tempfile
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from derender.errors import DerenderError

try:
    import fcntl
except ImportError:  # not on Windows: there what a killed writer leaves stays
    fcntl = None  # type: ignore[assignment]

UNFINISHED = ".new-"
ROOM = 2_000_000  # bytes that have to be free before hours are spent: a result of 640 x 480 pixels takes about so many


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary name in the same folder; when the block ends well, the file there becomes `path`.

    The folder is made where it is missing. The temporary name keeps the suffix, since many writers choose their format
    by it.  After an exception no file is left behind and an older one stays as it was. A file of a set (see
    `files_together`) has its own name from the start: nobody reads it before the set is whole.

    Raises DerenderError : where the folder cannot be made, is read-only or full.
    """
    path = Path(path)
    temporary = None
    try:
        if path.is_dir():
            raise DerenderError("this is a folder", where=path, remedy="give the name of a file")
        if path.parent.name.startswith(UNFINISHED):
            temporary = path
            yield path
            temporary = None
            return
        make_folder(path.parent)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem[:40]}-", suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        _to_disk(temporary)
        temporary.chmod(_usual_mode())  # mkstemp makes files that only their owner reads
        temporary.replace(path)
        temporary = None
    except OSError as error:
        what = f"cannot be written: {error.strerror or error}"
        raise DerenderError(what, where=path, remedy="choose another place") from None
    except ValueError as error:
        if "null" not in str(error):
            raise
        raise DerenderError("a file name cannot hold a null character", where=repr(str(path))) from None
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def _to_disk(path: Path) -> None:
    """Wait until the disk has a file."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _usual_mode() -> int:
    """Return the mode of files that this process makes: the mask can be read only by setting it, for all threads."""
    with _mask_in_use:
        mask = os.umask(0)
        os.umask(mask)
    return 0o666 & ~mask


_mask_in_use = threading.Lock()


@contextmanager
def all_or_none(*paths: str | Path) -> Iterator[None]:
    """Remove those of `paths` that are new where the block fails: files that belong together come together."""
    new = [Path(path) for path in paths if not Path(path).exists()]
    try:
        yield
    except BaseException:
        for path in new:
            path.unlink(missing_ok=True)
        raise


@contextmanager
def files_together(folder: Path, names: Iterable[str]) -> Iterator[Path]:
    """Yield a temporary folder inside `folder`; when the block ends well, its files move up, as one set.

    Those of `names` that the block did not write are removed then: nothing of an older set stays beside the new one.
    After an exception the older set is as it was. What a writer that was killed left half done is removed.
    """
    try:
        with _own_folder(folder) as temporary:
            try:
                yield temporary
            except DerenderError as error:  # of a file in the folder: named as it would have been called
                if not isinstance(error.where, Path) or error.where.parent != temporary:
                    raise
                raise DerenderError(error.what, folder / error.where.name, error.remedy) from None
            from concurrent.futures import ThreadPoolExecutor

            written = sorted(temporary.iterdir())
            check_files(folder, names)
            with ThreadPoolExecutor(len(written) or 1) as pool:  # one wait for the disk is as long as that for them all
                list(pool.map(_to_disk, written))
            with locked(folder):  # another process may write a set there too, or read one
                for name in names:
                    (folder / name).unlink(missing_ok=True)
                for path in written:
                    path.replace(folder / path.name)
    except OSError as error:
        raise DerenderError(f"cannot be written: {error.strerror or error}", folder, "choose another place") from None


@contextmanager
def _own_folder(parent: Path) -> Iterator[Path]:
    """Yield a new hidden folder that is gone afterwards; those of writers that live no more go too.

    A writer holds a lock on its folder, which the system lets go of when the writer dies, however that comes about.
    """
    for left in parent.glob(f"{UNFINISHED}*"):
        with locked(left, wait=False) as ours:
            if ours:
                shutil.rmtree(left, ignore_errors=True)
    while True:
        own = Path(tempfile.mkdtemp(prefix=UNFINISHED, dir=parent))
        with locked(own) as ours:
            if not ours:  # another writer took it for a dead one's, in the moment before it was locked
                continue
            try:
                yield own
            finally:
                shutil.rmtree(own, ignore_errors=True)
            return


@contextmanager
def locked(folder: Path, wait: bool = True) -> Iterator[bool]:
    """Hold a lock on a folder; yields whether it was got and the folder is still there."""
    if fcntl is None:
        yield wait
        return
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        yield False
        return
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            held = True
        except OSError:  # another's, or a file system without locks, where nothing is removed
            held = wait
        yield held and folder.exists()
    finally:
        os.close(handle)


def check_files(folder: Path, names: Iterable[str]) -> None:
    """Raise a DerenderError where something of these names is there and is no file: reading a pipe waits for ever."""
    for path in (folder / name for name in names):
        with suppress(FileNotFoundError):
            if not stat.S_ISREG(path.stat().st_mode):
                raise DerenderError("this is no file", path, "move it away or choose another place")


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text atomically."""
    write_bytes(path, text.encode())


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write bytes atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def make_folder(path: str | Path, room: int = 0) -> Path:
    """Make a folder and its parents where missing, and return it; `room` bytes are to be free there.

    Raises DerenderError : it cannot be made or written to, or its disk is full.
    """
    path = Path(path)
    try:
        there = next(each for each in (path, *path.absolute().parents) if each.exists())
        if room and (disk := shutil.disk_usage(there)).free < room:
            if not disk.total:  # as in /proc
                raise DerenderError("nothing can be kept there", where=path, remedy="choose another place")
            what = f"the disk is full: {disk.free / 1e6:.1f} of the {room / 1e6:g} MB that are needed"
            raise DerenderError(what, where=path, remedy="make room, or choose another place")
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError, RecursionError) as error:  # the last: of thousands of folders in one another
        reason = getattr(error, "strerror", None) or error
        raise DerenderError(f"the folder cannot be made: {reason}", where=path, remedy="choose another place") from None
    if not os.access(path, os.W_OK):
        raise DerenderError("the folder cannot be written to", where=path, remedy="choose another place")
    return path
