"""Say once, on stderr, that compiled kernels are being compiled: the first call would otherwise seem to hang."""

import sys
from functools import cache

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
