"""`njit` for every compiled function of derender: a cache that is never stale, wherever one can be written.

numba's own cache notices a change of a function's file, but not of the functions and constants elsewhere that are
compiled into it, and half a second of each command is spent on importing numba. Here every version of a function is one
file that is named after all that it depends on: the bytecode and the constants of the function and of those that it
calls, the types of the arguments, numba and the processor. numba is imported by the process that compiles something
(compiler.py), and by no other: what was compiled before is loaded without it (entries.py).
"""

import contextlib
import functools
import hashlib
import importlib
import importlib.util
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple

import numpy as np

from derender.compilation.entries import GENERATOR, Version, entry_path, fingerprint, fingerprints, load, turn

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

    py_func : the Python function; targetoptions : of numba.njit. numba asks for both by these names.
    cache : whether versions are kept in files.
    """

    def __init__(self, function: Callable, cache: bool, options: dict[str, Any]) -> None:
        self.py_func, self.cache, self.targetoptions = function, cache, {"no_cfunc_wrapper": True, **options}
        self.__name__, self.__doc__, self.__module__ = function.__name__, function.__doc__, function.__module__
        self._versions: dict[tuple, Version] = {}
        _name_apart(function)

    def __call__(self, *arguments):
        try:  # `fingerprints`, most of which are made without a look at each argument
            if isinstance(arguments[0], np.random.Generator):
                version = self._versions[(GENERATOR, *map(fingerprint, arguments[1:]))]
            else:
                version = self._versions[tuple(map(fingerprint, arguments))]
        except (IndexError, KeyError, NotImplementedError):
            version = self.version(arguments)
        return version.call(*arguments)

    def bound(self, *arguments) -> Callable:
        """Return what is called for arguments of these types, which then are looked at no more: that takes longer than
        many a kernel."""
        return self.version(arguments).call

    def version(self, arguments) -> Version:
        """Return what was compiled for arguments of these types: loaded, or compiled now."""
        key = fingerprints(arguments)
        if key not in self._versions:
            with _lock:
                if key not in self._versions:  # another thread may have been faster
                    self._versions[key] = self._new_version(key, arguments)
        return self._versions[key]

    def _new_version(self, key: tuple, arguments: tuple) -> Version:
        path = entry_path(f"{self.__module__}.{self.py_func.__qualname__}", self.stamp, key) if self.cache else None
        found = load(path)
        if found is None:
            if path is not None:
                announce()
            with turn(path):
                found = load(path)  # another process may have compiled it meanwhile
                if found is None:
                    from derender.compilation.compiler import compile_version

                    found = compile_version(self, arguments, path)
        return found

    @functools.cached_property
    def stamp(self) -> str:
        """A digest of all that its code is made from: of this function and of those that are compiled into it."""
        waiting: list[Any] = [self]
        parts: dict[Any, Any] = {}
        while waiting:
            one = waiting.pop()
            if one in parts:
                continue
            function, code = one.py_func, one.py_func.__code__
            named = [function.__globals__[name] for name in code.co_names if name in function.__globals__]
            waiting += [value for value in named if isinstance(value, Kernel)]
            code = code.replace(co_consts=tuple(each for each in code.co_consts if each != function.__doc__))
            parts[one] = [told(each) for each in (one, code, function.__defaults__, *one.targetoptions.items(), *named)]
        return hashlib.sha256(repr(list(parts.values())).encode()).hexdigest()

    @functools.cached_property
    def dispatcher(self):
        """numba's own form of this kernel, for others that it is compiled into."""
        from derender.compilation.compiler import make_dispatcher

        return make_dispatcher(self)


def told(value: Any) -> str:
    """Return what tells a thing that a kernel names from others of its name, the same in all processes."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape} {value.tobytes()!r}"
    if isinstance(value, CodeType):
        return f"{value.co_code!r} {value.co_varnames} {value.co_names} {[told(each) for each in value.co_consts]}"
    if isinstance(value, Late):
        return f"{value.name} {_source(value.module)}"
    if isinstance(value, ModuleType):
        return _source(value.__name__)
    if isinstance(value, tuple):
        return str([sorted(each) if isinstance(each, set) else each for each in value])
    named = getattr(value, "py_func", value)
    name = getattr(named, "__qualname__", None)
    return repr(value) if name is None else f"{named.__module__}.{name} {getattr(value, '_fields', '')}"


@functools.cache
def _source(module: str) -> str:
    """Return a digest of a module's file; the name of one that no file of Python holds."""
    found = importlib.util.find_spec(module)
    if found is None or found.origin is None or not found.origin.endswith(".py"):
        return module
    return hashlib.sha256(Path(found.origin).read_bytes()).hexdigest()


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


def late(module: str, *names: str) -> tuple[Late, ...]:
    """Return stand-ins in kernels for what a module has under these names, which is imported when one is compiled."""
    return tuple(Late(module, name) for name in names)


helpers: list[Callable[[], object]] = []  # called when this process first compiles a kernel, if it ever does


@functools.cache
def announce() -> None:
    """Say it, at most once in a process, and call for help; of worker processes the first one says it for all."""
    import multiprocessing

    alone = multiprocessing.parent_process() is None
    for helper in helpers if alone else ():
        helper()
    if alone or multiprocessing.current_process().name.endswith("-1"):
        clear = "\r\x1b[K" if sys.stderr.isatty() else ""  # of a progress bar, which stands in this line
        words = "derender: compiling kernels that are new to this machine (seconds to a minute; they are kept)"
        with contextlib.suppress(OSError):  # what stderr does not take costs nothing
            print(f"{clear}{words}", file=sys.stderr, flush=True)


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
