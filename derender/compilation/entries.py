"""The entries of the kernel cache: files of compiled code, each named after all that it depends on.

An entry is code that will be run, so it is read only from folders that nobody else can write to, and only where its
digest is right: a file that was cut off, changed or renamed is deleted, and its kernel compiled again.
"""

import contextlib
import functools
import hashlib
import importlib.util
import os
from pathlib import Path

FORMAT = 4  # of an entry
DIGEST = hashlib.sha256


def numba_folder() -> Path:
    """Return where numba is, which is not imported for it."""
    found = importlib.util.find_spec("numba")
    if found is None or found.origin is None:
        raise ImportError("numba is not installed")
    return Path(found.origin).parent


@functools.cache
def machine() -> tuple:
    """Return what compiled code depends on besides its sources and types: the compiler, its settings, the processor."""
    import llvmlite
    import llvmlite.binding as llvm

    version = (numba_folder() / "_version.py").read_bytes()
    settings = {key: value for key, value in os.environ.items() if key.startswith("NUMBA_") and "CACHE" not in key}
    return (hashlib.sha256(version).hexdigest(), llvmlite.__version__, sorted(settings.items()),
            llvm.get_process_triple(), llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten())  # fmt: skip


def is_private(folder: Path) -> bool:
    """Return whether a folder is this user's own and nobody else can write to it."""
    if not hasattr(os, "getuid"):
        return True  # Windows: the user's folders are its own
    status = folder.stat()
    return status.st_uid == os.getuid() and not status.st_mode & 0o022


def read_entry(path: Path) -> bytes | None:
    """Return what `write_entry` wrote to a file of this name; None where there is no such, or it was not whole."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    digest, data = content[: DIGEST().digest_size], content[DIGEST().digest_size :]
    if digest == _digest(path, data):
        return data
    discard(path)
    return None


def write_entry(path: Path, data: bytes) -> None:
    """Write an entry, whole or not at all, to the disk itself before it has its name; OSError where that fails."""
    temporary = path.with_name(f"{path.name}.tmp.{os.getpid()}")
    try:
        with temporary.open("wb") as file:
            file.write(_digest(path, data) + data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def discard(path: Path) -> None:
    """Delete an entry that is not what it should be."""
    with contextlib.suppress(OSError):
        path.unlink()


def _digest(path: Path, data: bytes) -> bytes:
    """Return the digest of an entry and its name, which says what it depends on."""
    return DIGEST(path.name.encode() + b"\n" + data).digest()


class Entries:
    """The compiled versions of one function, a file each."""

    def __init__(self, folder: Path, base: str, stamp: str) -> None:
        self.folder, self.base, self.stamp = folder, base, stamp

    def path(self, key, suffix="run") -> Path:
        digest = hashlib.sha256(repr((FORMAT, key)).encode()).hexdigest()
        return self.folder / f"{self.base}.{self.stamp[:12]}-{digest[:20]}.{suffix}"

    def save(self, path: Path, data: bytes) -> None:
        """Write an entry and delete those of other sources; a full disk costs only the compilation next time."""
        with contextlib.suppress(OSError):
            write_entry(path, data)
            for other in self.folder.glob(f"{self.base}.*.*"):
                if other.suffix in (".nbc", ".run") and not other.name.startswith(f"{self.base}.{self.stamp[:12]}-"):
                    other.unlink(missing_ok=True)
