"""Arrays and a JSON header in one .npz under a seal: a file that is not as it was written is told and never used."""

import hashlib
import json
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from derender.atomic import atomic_path
from derender.errors import DerenderError
from derender.json_text import parse_json

# What decoders of arrays and pictures raise on damaged files; anything else is a bug and shows its traceback.
DAMAGE = (OSError, EOFError, SyntaxError, ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError,
          MemoryError, RuntimeError, struct.error, zlib.error, zipfile.BadZipFile, tokenize.TokenError)  # fmt: skip


def write_archive(path: str | Path, form: int, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write an .npz, whole or not at all.

    form : the version of what it holds. header : as JSON has it. arrays : by name, without Python's objects.
    """
    text = json.dumps({"format": form, **header}, sort_keys=True)
    members = {"header": np.frombuffer(text.encode(), np.uint8), **arrays}
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, seal=_seal(members), **members)  # type: ignore[arg-type]


def read_archive(path: str | Path, form: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the header and the arrays of a file that `write_archive` wrote.

    Raises DerenderError : it is damaged, was changed, holds another version or is none; `what` says which.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            members = {name: file[name] for name in file.files}
        seal, header = members.pop("seal", None), parse_json(bytes(members["header"]))
        found = header["format"]
    except DAMAGE as fault:
        raise DerenderError("it is damaged, or something else", path) from fault
    if found != form:
        raise DerenderError(f"its format is {found!r:.20}, this version reads {form}", path)
    if seal is None or not np.array_equal(seal, _seal(members)):
        raise DerenderError("it was changed after it was written", path)
    del members["header"]
    return header, members


def _seal(members: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return a digest (32,) uint8 of arrays and their names."""
    digest = hashlib.sha256()
    for name, array in sorted(members.items()):
        array = np.asarray(array)
        digest.update(f"{name} {array.dtype.str} {array.shape} ".encode() + array.tobytes())
    return np.frombuffer(digest.digest(), np.uint8)
