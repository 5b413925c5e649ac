"""`njit` for every compiled function of derender: a cache that is never stale, wherever one can be written.

numba's own cache notices a change of a function's file, but not of the files whose functions and constants are
compiled into it; two processes that fill it at once can cross each other's entries; and where neither the package nor
a home folder can be written it refuses to import. Here every entry is one file that is named after all that it depends
on: the kernel's file and every file of derender that it imports, directly or not, the types of the arguments, numba
and the processor. An entry is written under a temporary name and moved into place, so processes cannot harm each other.

numba is imported by the process that compiles something (compiler.py), and by no other: what was compiled before
is loaded without it (entries.py), for its import takes as long as many a command.

The folder is the first of these that can be written and that nobody else can write to: NUMBA_CACHE_DIR, the
`__pycache__` beside the source, the user's cache folder, and a private folder for temporary files. Without any, kernels
are compiled anew in each process.
"""

import functools
import hashlib
import importlib
import os
import re
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

from derender.compilation.entries import Entries, Version, fingerprint, fingerprints, is_private, load, machine, turn

PACKAGE = Path(__file__).parent.parent
COMMENT = re.compile(rb"#[^\n]*")  # may hold parentheses, at which a list of imports seems to end
IMPORT = re.compile(
    rb"^(?:from\s+(derender[\w.]*)\s+import\s+(\([^)]*\)|[^\n]*)|import\s+(derender[\w.]+)"
    rb'|[^\n]* = late\(\s*"(derender[\w.]+)")',
    re.MULTILINE,
)
LOADS = sys.platform != "win32"  # where numba links in a way of its own
_lock = threading.RLock()  # one thread loads or compiles at a time


def njit(function: Callable | None = None, *, cache: bool = False, borrows: bool = False, **options):
    """As `numba.njit`, with this module's cache, and without the entry for C callers, a tenth of the compilation.

    borrows : whether the function makes no array and returns none, but works on those that its callers hold. Then no
        references to them are counted, which numba does by locked instructions wherever an array is passed on or a part
        of it taken: half the time of a walk of small kernels.
    """
    if function is None:
        return functools.partial(njit, cache=cache, borrows=borrows, **options)
    return Kernel(function, cache, {"_nrt": not borrows, **options})


class Kernel:
    """A function that is compiled for the types of its arguments when it is first called with such.

    Attributes
    ----------
    py_func : the Python function; targetoptions : of numba.njit. numba asks for both by these names.
    cache : whether versions are kept in files.
    """

    def __init__(self, function: Callable, cache: bool, options: dict[str, Any]) -> None:
        self.py_func, self.cache, self.targetoptions = function, cache, {"no_cfunc_wrapper": True, **options}
        self.__name__, self.__doc__, self.__module__ = function.__name__, function.__doc__, function.__module__
        self._versions: dict[tuple, Version] = {}
        self._calls: dict[tuple, Callable] = {}
        _name_apart(function)

    def __call__(self, *arguments):
        try:
            call = self._calls[tuple(map(fingerprint, arguments))]
        except (KeyError, NotImplementedError):
            arguments = self._complete(arguments)
            call = self.version(arguments).call
        return call(*arguments)

    def _complete(self, arguments):
        """Return the arguments with the defaults of those left out."""
        count, defaults = self.py_func.__code__.co_argcount, self.py_func.__defaults__ or ()
        missing = count - len(arguments)
        if not 0 <= missing <= len(defaults):
            raise TypeError(f"{self.__name__} takes {count} arguments, not {len(arguments)}")
        return (*arguments, *defaults[len(defaults) - missing :])

    def version(self, arguments) -> Version:
        """Return what was compiled for arguments of these types: loaded, or compiled now."""
        key = fingerprints(arguments)
        if key not in self._versions:
            with _lock:
                if key not in self._versions:  # another thread may have been faster
                    found = self._versions[key] = self._new_version(key, arguments)
                    if found.call is not None:
                        self._calls[key] = found.call
        return self._versions[key]

    def _new_version(self, key, arguments) -> Version:
        path = self.entries.path((machine(), key)) if self.entries else None
        found = load(path) if path and LOADS else None
        if found is None:
            if path:
                announce()
            with turn(path):
                found = load(path) if path and LOADS else None  # another process may have compiled it meanwhile
                if found is None:
                    from derender.compilation.compiler import compile_version

                    found = compile_version(self, arguments, path)
        return found

    @functools.cached_property
    def entries(self) -> Entries | None:
        """Where the code of its versions lies; None where nothing can be kept."""
        code = self.py_func.__code__
        source = Path(code.co_filename)
        folder = _folder(source) if self.cache else None
        if folder is None:
            return None
        base = f"{source.stem}.{self.py_func.__qualname__.replace('<locals>.', '')}-{code.co_firstlineno}"
        return Entries(folder, f"{base}.py{sys.version_info[0]}{sys.version_info[1]}", source_stamp(source))

    @functools.cached_property
    def dispatcher(self):
        """numba's own form of this kernel, for others that it is compiled into."""
        from derender.compilation.compiler import make_dispatcher

        return make_dispatcher(self)


def interpreted(kernel: Kernel, **replaced: Callable) -> Callable:
    """Return a kernel as a Python function that calls Python functions only: the same source, run without compiling.

    replaced : functions by name, which it and those that it calls take in place of their own.
    """
    made: dict[Kernel, Callable] = {}

    def plain(one: Kernel) -> Callable:
        if one not in made:
            function, scope = one.py_func, dict[str, Any]()
            made[one] = FunctionType(function.__code__, scope, one.__name__, function.__defaults__)
            for name in function.__code__.co_names:
                value = replaced.get(name, function.__globals__.get(name))
                if value is not None:
                    scope[name] = plain(value) if isinstance(value, Kernel) else value
        return made[one]

    return plain(kernel)


class Late(NamedTuple):
    """Something that kernels name and that only numba can make: looked up when one of them is compiled."""

    module: str
    name: str

    def found(self):
        return getattr(importlib.import_module(self.module), self.name)


def late(module: str, *names: str) -> tuple[Late, ...]:
    """Return stand-ins in kernels for what a module has under these names, which is imported when one is compiled."""
    return tuple(Late(module, name) for name in names)


def when_compiling(function: Callable[[], object]) -> None:
    """Have a function called when this process first compiles a kernel, if it ever does."""
    helpers.append(function)


helpers: list[Callable[[], object]] = []


@functools.cache
def announce() -> None:
    """Say it, at most once in a process, and call for help; worker processes leave it to the one that started them."""
    import multiprocessing

    if multiprocessing.parent_process() is None:
        for helper in helpers:
            helper()
        clear = "\r\x1b[K" if sys.stderr.isatty() else ""  # of a progress bar, which stands in this line
        print(
            f"{clear}derender: compiling kernels that are new to this machine (seconds to a minute; they are kept)",
            file=sys.stderr,
            flush=True,
        )


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
    for module, names, plain, later in IMPORT.findall(COMMENT.sub(b"", text)):
        place = os.path.join(PACKAGE, *(module or plain or later).decode().split(".")[1:])
        words = re.findall(r"\w+", names.decode())
        found += [_file_of(target) for target in (place, *(os.path.join(place, word) for word in words))]
    return hashlib.sha256(text).digest(), [file for file in found if file is not None]


@functools.cache
def _file_of(module: str) -> Path | None:
    """Return the file of a module of this path; None where it is no module but a name in one."""
    folder, name = os.path.split(module)
    if f"{name}.py" in _listing(folder):
        return Path(f"{module}.py")
    return Path(module, "__init__.py") if "__init__.py" in _listing(module) else None


@functools.cache
def _listing(folder: str) -> frozenset[str]:
    """Return the names in a folder: asked once, for there are a thousand to look up."""
    return frozenset(os.listdir(folder)) if os.path.isdir(folder) else frozenset()


@functools.cache
def _folder(source: Path) -> Path | None:
    """Return the folder for the kernels of a file, or None where nothing can be kept."""
    for folder in _candidates(source):
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            folder.mkdir(mode=0o755, exist_ok=True)
            if not is_private(folder):
                continue
            tempfile.TemporaryFile(dir=folder).close()
        except OSError:
            continue
        return folder
    return None


def _candidates(source: Path):
    """Yield the folders to try, the best first."""
    place = source.resolve().parent
    name = f"{place.name}_{hashlib.sha256(str(place).encode()).hexdigest()[:16]}"
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
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


# Compiled kernels called through their addresses: `call_for_number(address, *arguments)` in a kernel calls one that
# returns a number. What a kernel calls by name is compiled into it a second time: seconds, for something as large as
# the engine. A call through an address costs a nanosecond, and its target is compiled once. An address holds in one
# process only: it is looked up when a state is made and never kept in a file.
call_for_nothing, call_for_number, call_for_two_numbers = late(
    "derender.compilation.compiler", "call_for_nothing", "call_for_number", "call_for_two_numbers"
)


def address_of(kernel, *arguments) -> int:
    """Return where the version of a kernel for arguments of these types lies in this process; compiled if need be."""
    return kernel.version(arguments).address
