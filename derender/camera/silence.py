"""Keep decoders quiet: libtiff, OpenEXR and Pillow's log write on stdout and stderr what derender says in one line."""

import contextlib
import io
import logging
import os
from collections.abc import Iterator


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Send the process's stdout and stderr, Python's and C's, to nowhere, and Pillow's log with them.

    Not for use while other threads write.
    """
    log = logging.getLogger("PIL")
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    kept = [os.dup(stream) for stream in (1, 2)]
    try:
        with open(os.devnull, "w") as nowhere:
            for stream in (1, 2):
                os.dup2(nowhere.fileno(), stream)
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            yield
    finally:
        for stream, copy in zip((1, 2), kept, strict=True):
            os.dup2(copy, stream)
            os.close(copy)
        log.setLevel(level)
