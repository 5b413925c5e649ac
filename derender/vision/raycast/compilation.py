"""The cache of compiled kernels: announced when it has to be filled, emptied when the sources are others."""

import hashlib
import sys
from functools import cache
from pathlib import Path

from numba.core.dispatcher import Dispatcher


def announce_compilation(*kernels: Dispatcher) -> bool:
    """Print one line on stderr if any of the kernels has neither been compiled in this process nor cached on disk.

    Call it just before the first use; it costs microseconds when there is nothing to say. Returns whether it spoke.
    """
    pending = [kernel for kernel in kernels if not kernel.signatures and not _cached(kernel)]
    if pending:
        _announce()
    return bool(pending)


@cache
def _announce() -> None:
    """Say it, at most once in a process."""
    print("derender: compiling kernels for this machine, once (about ten seconds; the result is cached)",
          file=sys.stderr, flush=True)


def _cached(kernel: Dispatcher) -> bool:
    """Whether an index of compiled versions of the kernel's present source lies in numba's cache folder."""
    cache = getattr(kernel, "_cache", None)
    file = getattr(cache, "_cache_file", None)
    try:
        return bool(file is not None and file._load_index())
    except Exception:  # numba's cache internals changed: a wrong guess costs one line of text
        return False


def forget_stale_kernels() -> bool:
    """Delete cached kernels that were compiled from other sources than the present ones; return whether any were.

    numba recompiles a function when its own file changes, but not when a file changes whose functions it calls: after
    an upgrade it would go on running the old ones in silence.
    """
    package = Path(__file__).parents[2]
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        text = source.read_bytes()
        if b"njit" in text or b"@intrinsic" in text:
            digest.update(text)
    stamp = Path(__file__).parent / "__pycache__" / "kernels.sha256"
    try:
        if stamp.exists() and stamp.read_text() == digest.hexdigest():
            return False
        for kind in ("*.nbi", "*.nbc"):
            for cached in package.rglob(f"__pycache__/{kind}"):
                cached.unlink(missing_ok=True)
        stamp.parent.mkdir(exist_ok=True)
        stamp.write_text(digest.hexdigest())
    except OSError:  # an installation that cannot be written to: numba caches elsewhere
        return False
    return True
