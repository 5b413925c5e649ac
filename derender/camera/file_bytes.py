"""The bytes of a file that a user gave."""

import sys
from pathlib import Path

from derender.errors import DerenderError


def read_bytes(path: str | Path, most: int, what: str, remedy: str) -> bytes:
    """Return the bytes of a file, `-` for stdin.

    Raises
    ------
    DerenderError : it cannot be read (`what` says of it what it is, `remedy` what to do), has more than `most` bytes,
        or none.
    """
    try:
        if str(path) == "-":
            data = sys.stdin.buffer.read(most + 1)
        else:
            with open(path, "rb") as file:
                data = file.read(most + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise DerenderError(f"cannot read {what}: {reason}", path, remedy) from None
    if len(data) > most:
        raise DerenderError(f"too large for {what.replace('the ', 'a ', 1)}", path)
    if not data.strip():
        raise DerenderError("the file is empty", path, remedy)
    return data
