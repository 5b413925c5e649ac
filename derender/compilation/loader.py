"""Compiled kernels loaded and called without importing numba: its compiled code needs three small C modules of it.

An entry holds the machine code of one version of a kernel, with the entry that Python calls (it takes the arguments
apart and makes arrays of results), and the Python constants that the code refers to.
"""

import ctypes
import functools
import importlib
import importlib.util
import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from derender.compilation.entries import numba_folder, read_entry


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
