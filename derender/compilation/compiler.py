"""Kernels compiled by numba: the one file that imports it, in processes that have something to compile.

Beside the entry from which a version is loaded (loader.py) numba keeps one of its own, for compiling the version
into others: the bitcode that they inline, and what it knows of the types.
"""

import functools
import gc
import io
import pickle
import sys
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

import llvmlite.binding as llvm
import numba
from numba import typeof, types
from numba.core import caching, cgutils, config, environment, event
from numba.core.codegen import JITCodeLibrary
from numba.core.registry import cpu_target
from numba.core.runtime import rtsys
from numba.extending import intrinsic, overload, typeof_impl
from numba.np import arrayobj

from derender.compilation import cache as kernel_cache
from derender.compilation.entries import read_entry
from derender.compilation.loader import Code, Version


def compile_version(kernel, arguments, path) -> Version:
    """Compile a kernel for arguments of these types, write the entry if there is a path, and return the version."""
    if vars(config)["DISABLE_JIT"]:
        return Version(kernel.py_func, 0)
    kinds = tuple(typeof(argument) for argument in arguments)
    kernel.dispatcher.compile(kinds)
    result = kernel.dispatcher.overloads[kinds]
    # Without machine code where writing numba's own entry was interrupted: in a notebook the process goes on.
    if path and not result.reload_init and result.library.machine_code:
        kernel.entries.save(path, pickle.dumps(tuple(_code(kernel, result))))
    address = result.library.get_pointer_to_function(result.fndesc.llvm_func_name)
    return Version(result.entry_point, address)


def _code(kernel, result) -> Code:
    """Return what the loader needs of a compiled version."""
    own, others = result.environment, result.referenced_envs or result._find_referenced_environments()
    environments = [(each.env_name, each.globals["__name__"], list(each.consts)) for each in (own, *others)]
    wrapper = "" if kernel.targetoptions.get("no_cpython_wrapper") else result.fndesc.llvm_cpython_wrapper_name
    return Code(result.fndesc.llvm_func_name, wrapper, kernel.__name__, result.library.machine_code, environments)


def make_dispatcher(kernel):
    """Return numba's dispatcher of a kernel, with this cache."""
    dispatcher = numba.njit(**kernel.targetoptions)(kernel.py_func)
    if kernel.entries is not None:
        dispatcher._cache = _KernelCache(kernel)
    template = dispatcher.get_call_template

    def for_any_value(arguments, keywords):
        """Take a constant that a caller gives for any value of its type: numba would compile each apart."""
        return template([types.unliteral(kind) for kind in arguments],
                        {name: types.unliteral(kind) for name, kind in keywords.items()})  # fmt: skip

    dispatcher.get_call_template = for_any_value
    return dispatcher


@typeof_impl.register(kernel_cache.Kernel)
def _kind_of_kernel(kernel, context):
    return types.Dispatcher(kernel.dispatcher)


@typeof_impl.register(kernel_cache.Late)
@functools.cache
def _kind_of_late(late, context):
    found = late.found()  # in a module that is imported only now: its words are new to numba
    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()
    return cpu_target.typing_context.resolve_value_type(found)


class _Locator:
    """Where numba's cache looks for a function's entries."""

    def __init__(self, kernel) -> None:
        self.kernel, self.source = kernel, Path(kernel.py_func.__code__.co_filename)

    def ensure_cache_path(self) -> None:
        self.kernel.entries.folder.mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        return str(self.kernel.entries.folder)

    def get_source_stamp(self) -> str:
        return self.kernel.entries.stamp

    def get_disambiguator(self) -> str:
        return str(self.kernel.py_func.__code__.co_firstlineno)


class _Files:
    """numba's own entries, a file each, in place of its index."""

    def __init__(self, entries) -> None:
        self.entries = entries

    def path(self, key) -> Path:
        return self.entries.path((numba.__version__, key), "nbc")

    def load(self, key):
        data = read_entry(self.path(key))
        return None if data is None else _Unpickler(io.BytesIO(data)).load()

    def save(self, key, data) -> None:
        self.entries.save(self.path(key), caching.dumps(data))

    def flush(self) -> None:
        """Nothing is ever wrong with them."""


class _KernelCache(caching.FunctionCache):
    """numba's cache of one function, its entries in files of ours."""

    def __init__(self, kernel) -> None:  # in place of numba's, which looks for a folder
        implementation = caching.CompileResultCacheImpl.__new__(caching.CompileResultCacheImpl)
        implementation._locator = _Locator(kernel)
        implementation._lineno = kernel.py_func.__code__.co_firstlineno
        implementation._filename_base = kernel.entries.base
        self._name, self._py_func, self._impl = repr(kernel.py_func), kernel.py_func, implementation
        self._cache_path, self._cache_file = str(kernel.entries.folder), _Files(kernel.entries)
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
        Library.ours = True
        try:
            super().save_overload(sig, data)
        finally:
            Library.ours = False
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


class Library(JITCodeLibrary):
    """Compiled code whose bitcode, for inlining it elsewhere, is parsed when something does.

    Other packages' functions are compiled into it too: in their caches they stand as numba writes them, so that a
    process without derender can read them.

    Attributes
    ----------
    ours : whether it is an entry of our own cache that is being written; numba's compiler lock is held meanwhile.
    """

    machine_code, _bitcode = b"", b""
    ours = False

    def serialize_using_object_code(self):
        plain = super().serialize_using_object_code()
        if not Library.ours:
            return plain
        name, _, (code, bitcode) = plain
        self.machine_code = code
        module = self._get_module_for_linking()
        symbols = {one.name for some in (module.functions, module.global_variables) for one in some
                   if not one.is_declaration}  # fmt: skip
        return name, code, bitcode, symbols

    @classmethod
    def _unserialize(cls, codegen, state):
        if len(state) == 3:  # another package's
            return super()._unserialize(codegen, state)
        name, code, bitcode, symbols = state
        library = codegen.create_library(name)
        library.machine_code, library._bitcode = code, bitcode
        library.enable_object_caching()
        library._set_compiled_object(code)
        library._finalize_final_module()
        codegen._engine._defined_symbols |= symbols
        return library

    def _get_module_for_linking(self):
        if self._shared_module is None and self._bitcode:
            self._shared_module = llvm.parse_bitcode(self._bitcode)
        return super()._get_module_for_linking()


class _Unpickler(pickle.Unpickler):
    """Reads entries without importing the parts of numba that are compiled into them: its Unicode tables and more."""

    def find_class(self, module, name):
        if name == "_rebuild_env":
            return _environment
        return super().find_class(module, name)


def _environment(module, constants, name):
    """Return the environment of compiled code. Code of numba's own needs the constants alone."""
    if module.startswith("numba.") and module not in sys.modules:
        return environment.lookup_environment(name) or _bare_environment(module, constants, name)
    return environment._rebuild_env(module, constants, name)


def _bare_environment(module, constants, name):
    made = environment.Environment({"__name__": module})
    made.consts[:] = constants
    made.env_name = name
    environment.Environment._memo[name] = made
    return made


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
            kernel_cache.announce()

    def on_end(self, happening) -> None:
        dispatcher = happening.data["dispatcher"]
        failed = tuple(happening.data["args"]) not in dispatcher.overloads  # numba's `is_failed` says the opposite
        if failed and isinstance(dispatcher._cache, _KernelCache):
            dispatcher._cache.end_turn()
        self.depth -= 1
        if self.depth == 0 and self.collecting:
            gc.enable()


event.register("numba:compile", _WhileCompiling())


def _raise_for_shapes(source, target):
    """Say that an array does not fit the part of another that it is assigned to."""


@overload(_raise_for_shapes)
def _compiled_raise_for_shapes(source, target):
    def implementation(source, target):
        raise ValueError("cannot assign an array of another shape to a slice")

    return implementation


# numba's own makes a text of both shapes: five seconds of each kernel's compilation that assigns an array to a slice.
arrayobj.raise_with_shape_context = _raise_for_shapes


def _caller(result):
    """Return an intrinsic that calls an address: (address, *arguments) -> result."""

    @intrinsic
    def call(typing, address, *arguments):
        kinds = tuple(types.unliteral(kind) for kind in arguments)
        if any(isinstance(kind, types.Array) and kind.layout != "C" for kind in kinds):
            raise TypeError(f"the kernel was compiled for C-contiguous arrays, not for {kinds}")

        def generate(context, builder, signature, values):
            convention = context.call_conv
            pointer = convention.get_function_type(result, kinds).as_pointer()
            function = builder.inttoptr(values[0], pointer)
            given = cgutils.unpack_tuple(builder, values[1])
            status, answer = convention.call_function(builder, function, result, kinds, given)
            with cgutils.if_unlikely(builder, status.is_error):
                convention.return_status_propagate(builder, status)
            return answer

        return result(types.int64, types.StarArgTuple(arguments)), generate

    return call


call_for_nothing, call_for_number = _caller(types.none), _caller(types.float64)
call_for_two_numbers = _caller(types.UniTuple(types.float64, 2))
