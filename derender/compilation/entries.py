"""The entries of the kernel cache: files of compiled code, each named after all that it depends on; and how it is run.

An entry is code that will be run, so it is read only from folders that nobody else can write to, and only where its
digest is right: a file that was cut off, changed or renamed is deleted, and its kernel compiled again.

It holds the machine code of one version of a kernel, with the entry that Python calls (it takes the arguments apart
and makes arrays of results), and the Python constants that the code refers to. It is loaded and called without
importing numba: compiled code needs three small C modules of it.
"""

import contextlib
import ctypes
import functools
import glob
import hashlib
import importlib
import importlib.util
import os
import pickle
import re
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from derender.atomic import locked, write_bytes
from derender.errors import DerenderError

GENERATOR = "generator"  # in place of a fingerprint, which numba makes of no generator
DIGEST, DIGEST_SIZE = hashlib.sha256, 32
USERS = {"win32": "~/AppData/Local", "darwin": "~/Library/Caches"}  # folders of caches where no variable says it


def entry_path(kernel: str, stamp: str, key: tuple) -> Path | None:
    """Return the file of a version of a kernel; None where nothing can be kept.

    kernel : its name. stamp : of its sources. key : of its arguments' types.
    """
    folder = _folder()
    if folder is None:
        return None
    name = f"{re.sub('[<>]', '', kernel)}.{sys.implementation.cache_tag}.{stamp[:12]}"
    return folder / f"{name}.{hashlib.sha256(repr((_machine(), stamp, key)).encode()).hexdigest()[:20]}.run"


@functools.cache
def _machine() -> tuple:
    """Return what compiled code depends on besides its sources and types: the compiler, its settings, the processor."""
    import llvmlite
    import llvmlite.binding as llvm

    ours = Path(__file__)
    sources = [each.read_bytes() for each in (_numba() / "_version.py", ours, ours.with_name("compiler.py"))]
    settings = {key: value for key, value in os.environ.items() if key.startswith("NUMBA_") and "CACHE" not in key}
    return (sources, llvmlite.__version__, sorted(settings.items()), llvm.get_process_triple(),
            llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten())  # fmt: skip


def _numba() -> Path:
    """Return where numba is, which is not imported for it."""
    found = importlib.util.find_spec("numba")
    if found is None or found.origin is None:
        raise ImportError("numba is not installed")
    return Path(found.origin).parent


@functools.cache
def _folder() -> Path | None:
    """Return the folder of all entries; None where nothing can be kept.

    It is the first of these that can be written and that nobody else can write to: one in NUMBA_CACHE_DIR, the
    package's `__pycache__`, one in the user's cache folder, and one beside temporary files.
    """
    package = Path(__file__).parent.parent
    place = hashlib.sha256(str(package.resolve()).encode()).hexdigest()[:16]
    name = f"derender-{getattr(os, 'getuid', int)()}-{place}"
    user = os.environ.get("LOCALAPPDATA" if sys.platform == "win32" else "XDG_CACHE_HOME")
    user = user or os.path.expanduser(USERS.get(sys.platform, "~/.cache"))
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    first = [Path(chosen, name)] if chosen else []
    for folder in (*first, package / "__pycache__", Path(user, name), Path(tempfile.gettempdir(), name)):
        with contextlib.suppress(OSError):
            folder.mkdir(mode=0o755, parents=True, exist_ok=True)
            if is_private(folder):
                tempfile.TemporaryFile(dir=folder).close()
                return folder
    return None


def is_private(folder: Path) -> bool:
    """Return whether this is a folder of this user's own, no link to one, to which nobody else can write."""
    if not hasattr(os, "getuid"):
        return True  # Windows: the user's folders are its own
    status = folder.lstat()
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o022


def read_entry(path: Path) -> bytes | None:
    """Return what `write_entry` wrote to a file of this name; None where there is no such, or it was not whole."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    data = content[DIGEST_SIZE:]
    if content == _signed(path, data):
        return data
    with contextlib.suppress(OSError):
        path.unlink()
    return None


def write_entry(path: Path, data: bytes) -> None:
    """Write an entry and delete those of other sources; a full disk costs only the compilation next time."""
    kernel, stamp, _, _ = path.name.rsplit(".", 3)
    with contextlib.suppress(DerenderError, OSError):
        write_bytes(path, _signed(path, data))
        for other in path.parent.glob(f"{glob.escape(kernel)}.*.*.run"):
            if not other.name.startswith(f"{kernel}.{stamp}."):
                other.unlink(missing_ok=True)


def _signed(path: Path, data: bytes) -> bytes:
    """Return an entry after its digest, which is also of its name: that says what it depends on."""
    return DIGEST(path.name.encode() + b"\n" + data).digest() + data


@contextlib.contextmanager
def turn(entry: Path | None) -> Iterator[None]:
    """Hold the right to compile an entry: a lock of the system's on a file beside it, gone with the process."""
    if entry is None:
        yield
        return
    lock = entry.with_suffix(".lock")
    with contextlib.suppress(OSError):
        lock.touch()
    with locked(lock):  # where there are no locks, two processes may compile the same
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                lock.unlink()


class Version(NamedTuple):
    """A kernel compiled for arguments of certain types."""

    call: Any  # what Python calls; None where the kernel is called by its address alone
    address: int  # of the function in compiled code


class Code(NamedTuple):
    """What an entry holds."""

    name: str  # the function's symbol
    wrapper: str  # the symbol of its entry for Python, "" for none
    title: str  # the kernel's name
    machine: bytes  # an object file
    environments: list[tuple[str, str, list[Any]]]  # (symbol, module, constants) of it and of those compiled into it


def fingerprints(arguments) -> tuple:
    """Return what tells the types of arguments apart, the same in all processes."""
    return tuple([GENERATOR if isinstance(each, np.random.Generator) else fingerprint(each) for each in arguments])


def load(path: Path | None) -> Version | None:
    """Return the version in a file, or None where there is none that is whole, or where numba links in its own way."""
    data = read_entry(path) if path is not None and sys.platform != "win32" else None
    if data is None:
        return None
    code = Code(*pickle.loads(data))
    import llvmlite.binding as llvm

    engine = _engine()
    engine.add_object_file(llvm.ObjectFileRef.from_data(code.machine))
    engine.finalize_object()
    environment = None
    for symbol, module, constants in reversed(code.environments):
        environment = _dynfunc.Environment({"__name__": module})
        environment.consts[:] = constants
        ctypes.c_void_p.from_address(engine.get_global_value_address(symbol)).value = id(environment)
        _kept.append(environment)
    call = None
    if code.wrapper:
        call = _dynfunc.make_function(sys.modules[__name__], code.title, "", engine.get_function_address(code.wrapper),
                                      environment, ())  # fmt: skip
    return Version(call, engine.get_function_address(code.name))


_kept: list[Any] = []  # what code refers to by address, as long as the process lives


@functools.cache
def _engine():
    """Return the engine that links object files into this process, what numba's code calls made known to it."""
    import builtins

    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    for helpers, prefix in ((_helperlib, "numba_"), (_dynfunc, "numba_"), (_runtime, "NRT_")):
        for name, address in helpers.c_helpers.items():
            llvm.add_symbol(name if name.startswith("_") and prefix == "NRT_" else prefix + name, address)
            if prefix == "numba_" and not llvm.address_of_symbol(name):  # mathematics that the system has not
                llvm.add_symbol(name, address)
    for name, value in vars(builtins).items():
        if isinstance(value, type) and issubclass(value, BaseException):
            llvm.add_symbol(f"PyExc_{name}", id(value))
    llvm.add_symbol("_Py_NoneStruct", id(None))
    unpickle = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p)(_unpickle)
    _kept.append(unpickle)
    llvm.add_symbol("numba_unpickle", ctypes.cast(unpickle, ctypes.c_void_p).value)
    _runtime.memsys_use_cpython_allocator()
    target = llvm.Target.from_default_triple().create_target_machine(opt=3, jit=True)
    module = llvm.parse_assembly("")
    module.triple, module.data_layout = llvm.get_process_triple(), str(target.target_data)  # how symbols are spelt
    return llvm.create_mcjit_compiler(module, target)


def _unpickle(address: int, size: int, digest: int):
    """Return an object that compiled code holds pickled; numba's own does the same, and imports numba for it."""
    if address not in _unpickled:
        _unpickled[address] = pickle.loads(ctypes.string_at(address, size))
    return _unpickled[address]


_unpickled: dict[int, Any] = {}


def _parts(*names: str) -> list[ModuleType]:
    """Return C modules of numba, numba itself not imported: packages without contents stand in for it meanwhile."""
    stand_ins = []
    if "numba" not in sys.modules:
        root = _numba()
        for package, folder in (("numba", root), ("numba.core", root / "core"),
                                ("numba.core.runtime", root / "core" / "runtime")):  # fmt: skip
            sys.modules[package] = ModuleType(package)
            sys.modules[package].__path__ = [str(folder)]
            stand_ins.append(package)
    try:
        return [importlib.import_module(f"numba.{name}") for name in names]
    finally:
        for package in stand_ins:
            del sys.modules[package]


_, _dispatcher, _dynfunc, _helperlib, _runtime = _parts(
    "_devicearray", "_dispatcher", "_dynfunc", "_helperlib", "core.runtime._nrt_python"
)
if "numba.core.dispatcher" not in sys.modules:  # which does this with numbers of its own, in place of these
    _dispatcher.typeof_init(type("Omitted", (), {}), {
        name: number for number, name in enumerate((
            "bool", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float16", "float32",
            "float64", "complex64", "complex128"))})  # fmt: skip
fingerprint = _dispatcher.compute_fingerprint  # of one value; NotImplementedError for what numba tells apart by itself
