"""The entries of the kernel cache: files of compiled code, each named after all that it depends on."""

import functools
import hashlib
import importlib.util
import os
from pathlib import Path

FORMAT = 3  # of an entry


@functools.cache
def machine() -> tuple:
    """Return what compiled code depends on besides its sources and types: the compiler, its settings, the processor."""
    import llvmlite
    import llvmlite.binding as llvm

    version = Path(importlib.util.find_spec("numba").origin).with_name("_version.py").read_bytes()
    settings = {key: value for key, value in os.environ.items() if key.startswith("NUMBA_") and "CACHE" not in key}
    return (hashlib.sha256(version).hexdigest(), llvmlite.__version__, sorted(settings.items()),
            llvm.get_process_triple(), llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten())  # fmt: skip


class Entries:
    """The compiled versions of one function, a file each."""

    def __init__(self, folder: Path, base: str, stamp: str) -> None:
        self.folder, self.base, self.stamp = folder, base, stamp

    def path(self, key, suffix="run") -> Path:
        digest = hashlib.sha256(repr((FORMAT, key)).encode()).hexdigest()
        return self.folder / f"{self.base}.{self.stamp[:12]}-{digest[:20]}.{suffix}"

    def save(self, path: Path, data: bytes) -> None:
        """Write an entry and delete those of other sources; a full disk costs only the compilation next time."""
        temporary = path.with_name(f"{path.name}.tmp.{os.getpid()}")
        try:
            temporary.write_bytes(data)
            os.replace(temporary, path)
            for other in self.folder.glob(f"{self.base}.*.*"):
                if other.suffix in (".nbc", ".run") and not other.name.startswith(f"{self.base}.{self.stamp[:12]}-"):
                    other.unlink(missing_ok=True)
        except OSError:
            temporary.unlink(missing_ok=True)
