"""One chain on disk: what it has drawn and all that its next step needs. Written whole or not at all."""

import hashlib
import json
import zipfile
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from derender.atomic import atomic_path
from derender.errors import DerenderError
from derender.json_text import parse_json

FORMAT = 2  # of what a sampler's state holds; a file of another one cannot be resumed


class Record(NamedTuple):
    """A chain up to now.

    Attributes
    ----------
    warmed : steps of warm-up that are done.
    values : (draws, P) float, draws kept so far.
    log_prior, log_likelihood : (draws,) float.
    state : what the sampler needs to go on, arrays by name.
    generator : state of the chain's random generator, as NumPy's bit generators give and take it.
    """

    warmed: int
    values: np.ndarray
    log_prior: np.ndarray
    log_likelihood: np.ndarray
    state: dict[str, np.ndarray]
    generator: dict

    @property
    def drawn(self) -> int:
        return len(self.values)


def fingerprint(*parts: bytes | str) -> str:
    """Return a digest of what a chain depends on (image, prior, options): only a run with the same one may resume."""
    digest = hashlib.sha256()
    for part in parts:
        content = part.encode() if isinstance(part, str) else part
        digest.update(len(content).to_bytes(8, "little") + content)
    return digest.hexdigest()


def save(path: Path, record: Record, run: str) -> None:
    """Write `record` of the run with fingerprint `run`; a kill at any moment leaves the former file or this one."""
    header = {"format": FORMAT, "run": run, "warmed": record.warmed, "generator": record.generator}
    arrays: dict[str, Any] = {f"state.{name}": value for name, value in record.state.items()}
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez(
            file,
            header=np.frombuffer(json.dumps(header).encode(), np.uint8),
            values=record.values,
            log_prior=record.log_prior,
            log_likelihood=record.log_likelihood,
            **arrays,
        )


def load(path: Path, run: str) -> Record | None:
    """Return the record in `path`, or None where there is none yet.

    Raises DerenderError if the file is no checkpoint, or belongs to another run or another version of derender.
    """
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            header = parse_json(bytes(file["header"]))
            state = {name.removeprefix("state."): file[name] for name in file.files if name.startswith("state.")}
            record = Record(
                header["warmed"], file["values"], file["log_prior"], file["log_likelihood"], state, header["generator"]
            )
    except (DerenderError, OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as fault:
        raise DerenderError("not a checkpoint of a chain", path, "remove it, or run without --resume") from fault
    if header.get("format") != FORMAT:
        raise DerenderError("was written by another version of derender", path, "run without --resume")
    if header["run"] != run:
        raise DerenderError(
            "was written by a run with another image, prior, seed or settings",
            path,
            "repeat that command exactly to resume it, or run without --resume",
        )
    return record
