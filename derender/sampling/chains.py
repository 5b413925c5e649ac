"""Chains: generators of draws, resumable, and several of them at once, each in a thread.

A chain depends on its seed and its number alone, never on which worker runs it or when it was stopped: the draws are
the same bytes for any number of jobs, and a resumed chain equals an uninterrupted one. What a chain has drawn and all
that its next step needs is on disk, written whole or not at all.

What runs compiled lets go of the interpreter, so that threads walk side by side; steps in Python take turns.
"""

import hashlib
import json
import time
import traceback
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from derender.atomic import atomic_path
from derender.compilation.threads import interruptible
from derender.errors import DerenderError
from derender.json_text import parse_json

# Uses of a seed besides chains: drawn scenes, structures of one prior, tempered populations, further searches for a
# mode. Each has its own streams, children of a SeedSequence: numpy takes a list such as [seed, 0] for the seed alone,
# and seed + 1 for the next seed, which would share numbers. A chain has the child of its own number, without a use
# before it.
SCENES, STRUCTURES, POPULATIONS, SEARCHES, DETECTED = range(1, 6)


def sequence(seed: int, *key: int) -> np.random.SeedSequence:
    """Return the child of a seed for a use and its number (or numbers)."""
    return np.random.SeedSequence(seed, spawn_key=key)


def stream(seed: int, *key: int) -> np.random.Generator:
    """Return the random generator of a seed for a use and its number (or numbers)."""
    return np.random.Generator(np.random.PCG64(sequence(seed, *key)))


def child_seed(seed: int, *key: int) -> int:
    """Return a seed, below 2^63, for a use and its number."""
    return int(sequence(seed, *key).generate_state(1, np.uint64)[0] >> np.uint64(1))


FORMAT = 4  # of what a sampler's state holds; a file of another one cannot be resumed


class Record(NamedTuple):
    """A chain up to now."""

    warmed: int  # steps of warm-up that are done
    values: np.ndarray  # (draws, P) float, draws kept so far
    densities: np.ndarray  # (draws, 2) float, log prior and log likelihood
    state: dict[str, np.ndarray]  # what the sampler needs to go on, arrays by name
    generator: dict  # state of the chain's random generator, as NumPy's bit generators give and take it

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


def save_record(path: Path, record: Record, run: str) -> None:
    """Write `record` of the run with fingerprint `run`; a kill at any moment leaves the former file or this one."""
    header = {"format": FORMAT, "run": run, "warmed": record.warmed, "generator": record.generator}
    arrays: dict[str, Any] = {f"state.{name}": value for name, value in record.state.items()}
    arrays |= {"values": record.values, "densities": record.densities}
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)


def load_record(path: Path, run: str) -> Record | None:
    """Return the record in `path`, or None where there is none yet.

    Raises DerenderError if the file is no checkpoint, or belongs to another run or another version of derender.
    """
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            header = parse_json(bytes(file["header"]))
            state = {name.removeprefix("state."): file[name] for name in file.files if name.startswith("state.")}
            record = Record(header["warmed"], file["values"], file["densities"], state, header["generator"])
    except (DerenderError, OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as fault:
        raise DerenderError("not a checkpoint of a chain", path, "remove it, or run without --resume") from fault
    if header.get("format") != FORMAT:
        raise DerenderError("was written by another version of derender", path, "run without --resume")
    if header["run"] != run:
        what = "was written by a run with another image, prior, seed or settings"
        raise DerenderError(what, path, "repeat that command exactly to resume it, or run without --resume")
    return record


class Segment(NamedTuple):
    """Some consecutive draws."""

    values: np.ndarray  # (n, P) float
    densities: np.ndarray  # (n, 2) float, log prior and log likelihood


class Sampler(Protocol):
    """How one chain walks; each in a thread of its own.

    segment : number of draws (and of warm-up rounds) between two moments at which a chain can be stopped.
    state : arrays by name; all that the next step depends on besides `rng`.
    """

    segment: int

    def start(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Return a first state."""

    def warm_up(
        self, rng: np.random.Generator, state: Any, done: int, rounds: int, total: int
    ) -> dict[str, np.ndarray]:
        """Return the state after `rounds` more of `total` warm-up rounds, of which `done` are done; may adapt."""

    def advance(self, rng: np.random.Generator, state: Any, draws: int) -> tuple[dict[str, np.ndarray], Segment]:
        """Return the state and the draws after `draws` more of them; adapts nothing."""


class Plan(NamedTuple):
    """What one run of several chains is. chains, warmup, draws : counts; warm-up rounds and draws are per chain."""

    sampler: Sampler  # walks each chain
    seed: int  # chain k uses the k-th spawn of its SeedSequence
    chains: int
    warmup: int
    draws: int
    folder: Path | None = None  # of the checkpoints, or None to keep none
    run: str = ""  # fingerprint that checkpoints must carry
    resume: bool = False  # whether to go on from the checkpoints in `folder`
    records: Mapping[int, Record] = {}  # by number, of chains that go on from there
    checkpoint_seconds: float = 2.0  # time between two checkpoints of a chain


Stop = Callable[[], bool]
Progress = Callable[[int, int, int], None]


def chain(sampler: Sampler, rng: Any, warmup: int, draws: int, record: Record | None = None) -> Iterator[Record]:
    """Yield the chain's record after each segment, from the start or from `record`, until `draws` are there.

    Segments are cut at fixed places, so that stopping between two of them changes nothing that follows. The arrays of
    the yielded records are views of one buffer: later draws are appended behind them, what is in them stays.
    """
    if record is None:
        state = sampler.start(rng)
        record = Record(0, np.empty((0, 0)), np.empty((0, 2)), state, rng.bit_generator.state)
        yield record
    else:
        rng.bit_generator.state = record.generator
    while record.warmed < warmup:
        rounds = min(sampler.segment - record.warmed % sampler.segment, warmup - record.warmed)
        state = sampler.warm_up(rng, record.state, record.warmed, rounds, warmup)
        record = record._replace(warmed=record.warmed + rounds, state=state, generator=rng.bit_generator.state)
        yield record
    buffers: list[np.ndarray] = []
    while record.drawn < draws:
        done = record.drawn
        count = min(sampler.segment - done % sampler.segment, draws - done)
        state, segment = sampler.advance(rng, record.state, count)
        if not buffers:
            buffers = [np.empty((draws, *column.shape[1:])) for column in segment]
            if done:
                for buffer, column in zip(buffers, record[1:3], strict=True):
                    buffer[:done] = column
        for buffer, column in zip(buffers, segment, strict=True):
            buffer[done : done + count] = column
        values, densities = (buffer[: done + count] for buffer in buffers)
        record = Record(record.warmed, values, densities, state, rng.bit_generator.state)
        yield record


def run_chain(plan: Plan, number: int, stop: Stop, progress: Progress) -> Record:
    """Run one chain of the plan until it is done or `stop()`; return its record, written to its checkpoint.

    A short chain that runs to its end writes no checkpoint: to repeat it costs less.
    """
    path = None if plan.folder is None else Path(plan.folder) / f"chain_{number}.npz"
    if path is not None:  # what a kill left behind in the midst of writing
        for torn in path.parent.glob(f".{path.stem}-*"):
            torn.unlink(missing_ok=True)
    rng = stream(plan.seed, number)
    record = former = plan.records.get(number)
    if former is None and plan.resume and path is not None:
        record = former = load_record(path, plan.run)
    saved_at = time.monotonic()
    total = plan.warmup + plan.draws
    for record in chain(plan.sampler, rng, plan.warmup, plan.draws, former):
        done = record.warmed + record.drawn
        progress(number, done, total)
        stopped = stop() and done < total
        due = time.monotonic() - saved_at > plan.checkpoint_seconds or (done == total and path and path.exists())
        if path is not None and (stopped or due):
            started = time.monotonic()
            save_record(path, record, plan.run)
            # The next one waits at least twenty times as long as this one took: at most 5 % of the time goes to disk.
            saved_at = time.monotonic() + 20 * (time.monotonic() - started)
        if stopped:
            break
    assert record is not None
    return record


class Outcome(NamedTuple):
    """What came of a run."""

    records: dict[int, Record]  # one for each chain that ran, by its number
    lost: dict[int, str]  # why a chain was lost, by its number
    interrupted: bool  # whether someone asked to stop before the end


def run_chains(plan: Plan, jobs: int = 1, progress: Progress = lambda *_: None) -> Outcome:
    """Run the plan's chains, at most `jobs` at a time.

    The first Ctrl-C lets every chain finish its segment and write its checkpoint; a second one raises.

    Raises DerenderError : the fault of the user that stopped a chain (no checkpoint of this run, for instance).
    RuntimeError : every chain was lost.
    """
    records: dict[int, Record] = {}
    lost: dict[int, str] = {}

    def one(number: int) -> None:
        if stop.is_set():
            return
        try:
            records[number] = run_chain(plan, number, stop.is_set, progress)
        except DerenderError:
            stop.set()
            raise
        except Exception:  # a bug in one chain must not cost the draws of the others: it is reported with its traceback
            lost[number] = traceback.format_exc()

    jobs = min(jobs, plan.chains)
    with interruptible() as stop:
        if jobs == 1:
            for number in range(plan.chains):
                one(number)
        else:
            with ThreadPoolExecutor(jobs) as pool:
                for future in [pool.submit(one, number) for number in range(plan.chains)]:
                    future.result()
    if lost and not records:
        raise RuntimeError("every chain was lost:\n" + "\n".join(lost.values()))
    return Outcome(dict(sorted(records.items())), lost, stop.is_set())
