"""`derender infer IMAGE --method mcmc` or `smc`: chains or populations over an image's catalogue, kept on disk."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from derender import __version__
from derender.detection.search.greedy import total_energy
from derender.errors import DerenderError
from derender.sampling import checkpoint
from derender.sampling.checkpoint import Record, fingerprint
from derender.sampling.workers import interruptible
from derender.structures.catalogue.catalogue import catalogue_of
from derender.structures.catalogue.chain import Walker
from derender.structures.catalogue.parts import parts_of
from derender.structures.catalogue.population import population
from derender.structures.draws.refined import refine, refined_at
from derender.structures.graph_posterior import INDEPENDENT
from derender.structures.options import Options

CHAINS, DRAWS, WARMUP = 4, 250, 40
POPULATIONS, PARTICLES = 4, 100
WALK, MOST_STEPS = 30, 150  # steps between two draws and their leaps: for each solid, at most
SAVED_EVERY = 2.0  # seconds

Tell = Callable[[float, str], None]


class Plan(NamedTuple):
    """What is to be run. method : mcmc or smc; folder : of checkpoints, or None; run : their fingerprint."""

    method: str
    chains: int
    draws: int
    warmup: int
    jobs: int
    folder: Path | None
    resume: bool
    run: str

    def path(self, number: int) -> Path | None:
        """Return where a chain's checkpoint is, or None."""
        return None if self.folder is None else self.folder / f"{self.method}_{number}.npz"


def read_plan(options: Options, depth) -> Plan:
    """Return the Plan of the options of `infer_structure`.

    Raises
    ------
    DerenderError : an option that the method knows nothing about.
    """
    method = options.method
    if method == "smc" and options.warmup is not None:
        raise DerenderError("populations have no warm-up", "--warmup", "leave it out, or take --method mcmc")
    chain = method == "mcmc"
    chains, draws = int(options.chains or 0), int(options.draws or 0)
    warmup = options.warmup
    folder = options.folder
    same = options.deciding() + repr(options.draws)
    digest = fingerprint(__version__, same, np.ascontiguousarray(depth, dtype=float).tobytes())
    return Plan(
        method, chains or (CHAINS if chain else POPULATIONS), draws or (DRAWS if chain else PARTICLES),
        WARMUP if warmup is None else int(warmup), int(options.jobs or 2),
        None if folder is None else Path(folder) / "checkpoint", options.resume, digest,
    )  # fmt: skip


def leap_parts(rng, seen, state, pool, settings, plan: Plan, progress: Tell | None = None):
    """Return (parts, meta) of the posterior by chains or populations about the search's best state.

    seen, state, pool, settings : as of `graph_posterior.parts_of`; there is at least one solid.
    """
    first = refine(rng, seen, state, settings.rules)
    if seen.correlation >= INDEPENDENT:  # neighbouring pixels say the same thing more than once
        worth = float(np.isfinite(first.sensor.observed).sum()) / settings.temper
        sensor = first.sensor.changed(effective_pixels=worth)
        place = Walker.density(first.chart, sensor, first.values)
        first = refined_at(first.state, first.chart, first.values, sensor, *place)
    entries, sensor = catalogue_of(rng, first, total_energy(seen.image, state, settings), pool, settings)
    streams = rng.spawn(plan.chains)
    done = [0.0] * plan.chains

    def one(number: int) -> Record | None:
        def tell(fraction: float) -> None:
            done[number] = fraction
            if progress:
                share = sum(done) / plan.chains
                progress(0.7 + 0.3 * share, "jumping" if plan.method == "mcmc" else "adding solids")

        walker = Walker(entries, sensor)
        if plan.method == "mcmc":
            return chain_record(streams[number], walker, plan, number, stop.is_set, tell)
        return population_record(streams[number], walker, plan, number, stop.is_set, tell)

    with interruptible() as stop:
        if plan.folder is not None:
            plan.folder.mkdir(parents=True, exist_ok=True)
        with ThreadPoolExecutor(max(1, min(plan.jobs, plan.chains))) as workers:
            records = [record for record in workers.map(one, range(plan.chains)) if record is not None]
        interrupted = stop.is_set()
    records = [record for record in records if record.drawn]
    if not records:
        if plan.folder is not None and not any(plan.folder.iterdir()):
            plan.folder.rmdir()
        raise KeyboardInterrupt
    if not interrupted and plan.folder is not None:
        clear(plan)
    parts, meta = parts_of(entries, sensor, records)
    return parts, {**meta, "interrupted": interrupted}


def clear(plan: Plan) -> None:
    """Remove the checkpoints of a run that is done; what is not ours stays."""
    assert plan.folder is not None
    for number in range(plan.chains):
        path = plan.path(number)
        if path is not None:
            path.unlink(missing_ok=True)
    if not any(plan.folder.iterdir()):
        plan.folder.rmdir()


def former(plan: Plan, number: int) -> Record | None:
    """Return what a stopped run left of a chain, where it is to be resumed."""
    path = plan.path(number)
    return checkpoint.load(path, plan.run) if plan.resume and path is not None else None


def chain_record(rng, walker: Walker, plan: Plan, number: int, stop, tell) -> Record:
    """Return what a chain drew until it was done or told to stop; begun from an entry of its own."""
    record, path = former(plan, number), plan.path(number)
    entries = walker.entries
    widest = max(len(entry.mean) for entry in entries)
    total = plan.warmup + plan.draws
    values, visited = np.full((plan.draws, widest), np.nan), np.zeros(plan.draws, np.int64)
    densities = np.zeros((plan.draws, 2))
    if record is None:
        begin = round(number * (len(entries) - 1) / max(plan.chains - 1, 1))
        place, taken = walker.place(begin, entries[begin].start.copy()), 0
    else:
        here = int(record.state["here"])
        place, taken = walker.place(here, record.state["now"]), record.warmed + record.drawn
        values[: record.drawn], visited[: record.drawn] = record.values, record.state["visited"]
        densities[: record.drawn] = np.stack([record.log_prior, record.log_likelihood], axis=1)
        walker.tried[:], walker.taken[:] = record.state["tried"], record.state["taken"]
        rng.bit_generator.state = record.generator
    saved = time.monotonic()

    def so_far() -> Record:
        drawn = max(taken - plan.warmup, 0)
        now = {"here": np.array(place.entry), "now": place.values, "visited": visited[:drawn], "tried": walker.tried,
               "taken": walker.taken}  # fmt: skip
        return Record(min(taken, plan.warmup), values[:drawn], densities[:drawn, 0], densities[:drawn, 1], now,
                      rng.bit_generator.state)  # fmt: skip

    while taken < total and not stop():
        place = walker.stepped(rng, place, min(WALK * len(entries[place.entry].names), MOST_STEPS))
        draw = taken - plan.warmup
        if draw >= 0:
            values[draw, : len(place.values)], visited[draw] = place.values, place.entry
            densities[draw] = place.log_prior, place.log_likelihood
        taken += 1
        tell(taken / total)
        if path is not None and time.monotonic() - saved > SAVED_EVERY:
            checkpoint.save(path, so_far(), plan.run)
            saved = time.monotonic()
    if path is not None and taken < total:
        checkpoint.save(path, so_far(), plan.run)
    return so_far()


def population_record(rng, walker: Walker, plan: Plan, number: int, stop, tell) -> Record | None:
    """Return one population as if it were a chain; None where there was no time for it."""
    record, path = former(plan, number), plan.path(number)
    if record is not None or stop():
        return record
    entries = walker.entries
    found = population(rng, walker, plan.draws, tell)
    values = np.full((plan.draws, max(len(entry.mean) for entry in entries)), np.nan)
    for i, place in enumerate(found.places):
        values[i, : len(place.values)] = place.values
    densities = np.array([[place.log_prior, place.log_likelihood] for place in found.places])
    state = {"visited": np.array([place.entry for place in found.places]), "tried": walker.tried,
             "taken": walker.taken, "log_evidence": np.array(found.log_evidence),
             "effective": found.effective}  # fmt: skip
    record = Record(0, values, densities[:, 0], densities[:, 1], state, rng.bit_generator.state)
    if path is not None:
        checkpoint.save(path, record, plan.run)
    return record
