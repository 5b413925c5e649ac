"""The entries of the kernel cache: files of compiled code that are read in a third of numba's time.

What numba reads beside the code itself is needed only where kernels are compiled: the bitcode of what others inline,
and those of its own modules whose code is in there. A warm process compiles nothing.
"""

import hashlib
import os
import pickle
import sys
from pathlib import Path

import llvmlite.binding as llvm
import numba
from numba.core import caching, environment
from numba.core.codegen import JITCodeLibrary

FORMAT = 2  # of an entry


class Entries:
    """The compiled versions of one function, a file each."""

    def __init__(self, folder: Path, base: str, stamp: str) -> None:
        self.folder, self.base, self.stamp = folder, base, stamp

    def path(self, key) -> Path:
        digest = hashlib.sha256(repr((FORMAT, numba.__version__, key)).encode()).hexdigest()
        return self.folder / f"{self.base}.{self.stamp[:12]}-{digest[:20]}.nbc"

    def load(self, key):
        try:
            with self.path(key).open("rb") as file:
                return _Unpickler(file).load()
        except OSError:
            return None

    def save(self, key, data) -> None:
        """Write an entry and delete those of other sources; a full disk costs only the compilation next time."""
        path = self.path(key)
        temporary = path.with_name(f"{path.name}.tmp.{os.getpid()}")
        try:
            temporary.write_bytes(caching.dumps(data))
            os.replace(temporary, path)
            for other in [*self.folder.glob(f"{self.base}.*.nbc"), *self.folder.glob(f"{self.base}.nbi")]:
                if not other.name.startswith(f"{self.base}.{self.stamp[:12]}-"):
                    other.unlink(missing_ok=True)
        except OSError:
            temporary.unlink(missing_ok=True)

    def flush(self) -> None:
        for entry in self.folder.glob(f"{self.base}.{self.stamp[:12]}-*.nbc"):
            entry.unlink(missing_ok=True)


class Library(JITCodeLibrary):
    """Compiled code whose bitcode, for inlining it elsewhere, is parsed when something does: half the time to load it.

    A warm process compiles nothing.
    """

    _bitcode = b""

    def serialize_using_object_code(self):
        name, _, (code, bitcode) = super().serialize_using_object_code()
        module = self._get_module_for_linking()
        symbols = {one.name for some in (module.functions, module.global_variables) for one in some
                   if not one.is_declaration}  # fmt: skip
        return name, code, bitcode, symbols

    @classmethod
    def _unserialize(cls, codegen, state):
        name, code, bitcode, symbols = state
        library = codegen.create_library(name)
        library._bitcode = bitcode
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
