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
import hashlib
import importlib
import importlib.util
import os
import pickle
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

try:
    import fcntl
except ImportError:  # Windows: two processes may compile the same
    fcntl = None  # type: ignore[assignment]

FORMAT = 5  # of an entry
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


@contextlib.contextmanager
def turn(entry: Path | None) -> Iterator[None]:
    """Hold the right to compile an entry: a lock of the system's on a file beside it, gone with the process."""
    with contextlib.ExitStack() as stack:
        if entry is not None and fcntl is not None:
            with contextlib.suppress(OSError):  # a file system without locks: two processes may compile the same
                lock = entry.with_suffix(".lock")
                file = stack.enter_context(lock.open("wb"))
                stack.callback(lock.unlink, missing_ok=True)
                fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _digest(path: Path, data: bytes) -> bytes:
    """Return the digest of an entry and its name, which says what it depends on."""
    return DIGEST(path.name.encode() + b"\n" + data).digest()


class Entries:
    """The compiled versions of one function, a file each."""

    def __init__(self, folder: Path, base: str, stamp: str) -> None:
        self.folder, self.base, self.stamp = folder, base, stamp

    def path(self, key) -> Path:
        digest = hashlib.sha256(repr((FORMAT, key)).encode()).hexdigest()
        return self.folder / f"{self.base}.{self.stamp[:12]}-{digest[:20]}.run"

    def save(self, path: Path, data: bytes) -> None:
        """Write an entry and delete those of other sources; a full disk costs only the compilation next time."""
        with contextlib.suppress(OSError):
            write_entry(path, data)
            for other in self.folder.glob(f"{self.base}.*.run"):
                if not other.name.startswith(f"{self.base}.{self.stamp[:12]}-"):
                    other.unlink(missing_ok=True)


class Version(NamedTuple):
    """A kernel compiled for arguments of certain types.

    Attributes
    ----------
    call : what Python calls; None where the kernel is called by its address alone.
    address : of the function in compiled code.
    """

    call: Callable | None
    address: int


class Code(NamedTuple):
    """What an entry holds.

    Attributes
    ----------
    name, wrapper : symbols of the function and of its entry for Python ("" for none). title : the kernel's name.
    machine : an object file.
    environments : (symbol, module, constants) of the function and of those compiled into it.
    """

    name: str
    wrapper: str
    title: str
    machine: bytes
    environments: list[tuple[str, str, list[Any]]]


def fingerprints(arguments) -> tuple:
    """Return what tells the types of arguments apart, the same in all processes."""
    return tuple(["generator" if isinstance(each, np.random.Generator) else fingerprint(each) for each in arguments])


def load(path: Path) -> Version | None:
    """Return the version in a file, or None where there is none that is whole."""
    data = read_entry(path)
    if data is None:
        return None
    code = Code(*pickle.loads(data))
    if not code.machine:  # LLVM would end the process
        return None
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
        root = numba_folder()
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
