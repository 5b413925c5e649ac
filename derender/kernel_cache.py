"""`njit` for every compiled function of derender: a cache that is never stale, wherever one can be written.

numba's own cache notices a change of a function's file, but not of the files whose functions and constants are
compiled into it; two processes that fill it at once can cross each other's entries; and where neither the package nor
a home folder can be written it refuses to import. Here every entry is one file that is named after all that it depends
on: the kernel's file and every file of derender that it imports, directly or not, the types of the arguments, numba
and the processor. An entry is written under a temporary name and moved into place, so processes cannot harm each other.

The folder is the first of these that can be written: NUMBA_CACHE_DIR, the `__pycache__` beside the source, the user's
cache folder, and a private folder for temporary files. Without any, kernels are compiled anew in each process.
"""

import functools
import gc
import hashlib
import os
import re
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

import numba
from numba.core import caching, config, event
from numba.core.runtime import rtsys

from derender.kernel_entries import Entries, Library

PACKAGE = Path(__file__).parent
IMPORT = re.compile(rb"^(?:from\s+(derender[\w.]*)\s+import\s+(\([^)]*\)|[^\n]*)|import\s+(derender[\w.]+))",
                    re.MULTILINE)


def njit(function: Callable | None = None, *, cache: bool = False, **options):
    """As `numba.njit`, with this module's cache, and without the entry for C callers, a tenth of the compilation."""
    if function is None:
        return functools.partial(njit, cache=cache, **options)
    options.setdefault("no_cfunc_wrapper", True)
    _name_apart(function)
    dispatcher = numba.njit(**options)(function)
    folder = _folder(Path(function.__code__.co_filename)) if cache else None
    if folder is not None:
        dispatcher._cache = _KernelCache(function, folder)
    return dispatcher


def _name_apart(function: Callable) -> None:
    """Give a closure a name of its own, from the numbers that it holds.

    numba calls compiled code by the function's name, its argument types and a number that each process counts for
    itself. What two processes have compiled of two closures of one factory may thus bear one name; a third one that
    loads both would run one of them in place of the other.
    """
    held = [cell.cell_contents for cell in function.__closure__ or ()]
    if not all(isinstance(value, int | float | str) for value in held):
        raise TypeError(f"{function.__qualname__} can be told from its like only by numbers and words that it holds")
    function.__qualname__ += "".join(f"_{value}" for value in held)


class _Locator:
    """Where numba's cache looks for a function's entries."""

    def __init__(self, function: Callable, folder: Path) -> None:
        self.folder, self.source = folder, Path(function.__code__.co_filename)
        self.line = function.__code__.co_firstlineno

    def ensure_cache_path(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        return str(self.folder)

    def get_source_stamp(self) -> str:
        return source_stamp(self.source)

    def get_disambiguator(self) -> str:
        return str(self.line)


class _KernelCache(caching.FunctionCache):
    """numba's cache of one function, its entries in files of ours."""

    def __init__(self, function: Callable, folder: Path) -> None:  # in place of numba's, which looks for a folder
        implementation = caching.CompileResultCacheImpl.__new__(caching.CompileResultCacheImpl)
        implementation._locator = _Locator(function, folder)
        implementation._lineno = function.__code__.co_firstlineno
        source = Path(function.__code__.co_filename)
        implementation._filename_base = implementation.get_filename_base(
            f"{source.stem}.{function.__qualname__}", getattr(sys, "abiflags", ""))
        self._name, self._py_func, self._impl, self._cache_path = repr(function), function, implementation, str(folder)
        self._cache_file = Entries(folder, implementation.filename_base, source_stamp(source))
        self._turns: list[_Turn] = []
        self.enable()

    def load_overload(self, sig, target_context):
        """Load an entry, without numba's registries of what can be compiled (a quarter of a second).

        Where there is none it is this process's turn to compile it: another one that is at it already is waited for.
        """
        target_context.codegen()._library_class = Library
        rtsys.initialize(target_context)
        found = self._load_overload(sig, target_context)
        if found is None:
            turn = _Turn(self._cache_file.path(self._index_key(sig, target_context.codegen())))
            found = self._load_overload(sig, target_context)
            if found is None:
                self._turns.append(turn)
            else:
                turn.end()
        return found

    def save_overload(self, sig, data):
        """Write an entry; whoever waits for it may have it."""
        super().save_overload(sig, data)
        self.end_turn()

    def end_turn(self) -> None:
        """Let others compile what this process has compiled last, or failed to."""
        if self._turns:
            self._turns.pop().end()


class _Turn:
    """The right to compile one entry: a lock of the system's on a file beside it, gone with the process.

    Who compiles an entry waits at most for entries that it calls: no two processes can wait for each other.
    """

    def __init__(self, entry: Path) -> None:
        self.path, self.file = entry.with_suffix(".lock"), None
        if fcntl is not None:
            try:
                self.file = self.path.open("wb")
                fcntl.flock(self.file, fcntl.LOCK_EX)
            except OSError:  # a file system without locks: both compile it
                self.end()

    def end(self) -> None:
        """Let the next one have it."""
        if self.file is not None:
            self.path.unlink(missing_ok=True)
            self.file.close()
            self.file = None


@functools.cache
def source_stamp(source: Path) -> str:
    """Return the hash of a Python file and of all files of derender that it imports when it is imported."""
    waiting, seen = [source], set()
    while waiting:
        file = waiting.pop()
        if file not in seen:
            seen.add(file)
            waiting.extend(_read(file)[1])
    digest = hashlib.sha256()
    for file in sorted(seen):
        digest.update(_read(file)[0])
    return digest.hexdigest()


@functools.cache
def _read(source: Path) -> tuple[bytes, list[Path]]:
    """Return the hash of a file and the files of derender that its top level imports."""
    text = source.read_bytes() if source.exists() else b""
    found = []
    for module, names, plain in IMPORT.findall(text):
        place = PACKAGE.joinpath(*(module or plain).decode().split(".")[1:])
        for name in ["", *re.findall(r"\w+", re.sub(r"#.*", "", names.decode()))]:
            target = place / name if name else place
            found += [file for file in (target.with_suffix(".py"), target / "__init__.py") if file.is_file()]
    return hashlib.sha256(text).digest(), found


@functools.cache
def _folder(source: Path) -> Path | None:
    """Return the folder for the kernels of a file, or None where nothing can be written."""
    for folder in _candidates(source):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError:
            continue
        return folder
    return None


def _candidates(source: Path):
    """Yield the folders to try, the best first."""
    place = source.resolve().parent
    name = f"{place.name}_{hashlib.sha256(str(place).encode()).hexdigest()[:16]}"
    if chosen := getattr(config, "CACHE_DIR", ""):
        yield Path(chosen) / name
    yield source.parent / "__pycache__"
    if sys.platform == "win32":
        user = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        user = Path(os.path.expanduser("~/Library/Caches"))
    else:
        user = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    yield user / "derender" / "kernels" / name
    if hasattr(os, "getuid"):  # entries are code: nobody else may be able to put one there
        private = Path(tempfile.gettempdir()) / f"derender-{os.getuid()}"
        try:
            private.mkdir(mode=0o700, exist_ok=True)
            status = private.lstat()
        except OSError:
            return
        if not private.is_symlink() and status.st_uid == os.getuid() and not status.st_mode & 0o077:
            yield private / name


class _WhileCompiling(event.Listener):
    """Announces the first compilation of a process, and keeps the garbage collector, a tenth of its time, out of it."""

    def __init__(self) -> None:
        self.depth, self.collecting = 0, False

    def on_start(self, happening) -> None:
        if self.depth == 0:
            self.collecting = gc.isenabled()
            gc.disable()
        self.depth += 1
        if isinstance(getattr(happening.data["dispatcher"], "_cache", None), _KernelCache):
            _announce()

    def on_end(self, happening) -> None:
        dispatcher = happening.data["dispatcher"]
        failed = tuple(happening.data["args"]) not in dispatcher.overloads  # numba's `is_failed` says the opposite
        if failed and isinstance(dispatcher._cache, _KernelCache):
            dispatcher._cache.end_turn()
        self.depth -= 1
        if self.depth == 0 and self.collecting:
            gc.enable()


def when_compiling(function: Callable[[], object]) -> None:
    """Have a function called when this process first compiles a kernel, if it ever does."""
    _helpers.append(function)


_helpers: list[Callable[[], object]] = []


@functools.cache
def _announce() -> None:
    """Say it, at most once in a process, and call for help; worker processes leave it to the one that started them."""
    import multiprocessing

    if multiprocessing.parent_process() is None:
        for helper in _helpers:
            helper()
        clear = "\r\x1b[K" if sys.stderr.isatty() else ""  # of a progress bar, which stands in this line
        print(f"{clear}derender: compiling kernels for this machine, once (ten seconds or more; the result is cached)",
              file=sys.stderr, flush=True)


event.register("numba:compile", _WhileCompiling())
