"""The sampler of a fixed structure, start, warm-up that adapts, draws that do not; and `inference:`, its settings."""

import functools
import json
import math
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from derender.posterior.compiled.backend import Backend, backend_of
from derender.posterior.kernels.base import Part, Tuning, first_tuning, rescale
from derender.posterior.smc import LOCAL, pilot_runs, shaped, systematic
from derender.posterior.space import Space
from derender.sampling.chains import Segment

KEYS = ("kernels", "order", "thin", "particles", "population", "chains", "draws", "warmup")


class Settings(NamedTuple):
    """How chains are run. kernels : entries such as {"drift": {"weight": 0.5}}, or None: the default mixture."""

    kernels: list[dict[str, Any]] | None = None
    cycle: bool = False  # kernels take turns, in the order of the file, instead of being drawn by weight
    thin: int = 20  # steps for each draw
    particles: int = 200  # draws from the prior that the start is resampled from
    population: int = 32  # particles of the tempered SMC that looks for the mode; 1: none
    chains: int = 4  # counts
    draws: int = 1000  # counts
    warmup: int = 200  # counts
    goes_on: bool = False  # whether chains that disagree after so many draws make more
    where: str | None = None  # file and line, for messages


def read_settings(section: Any) -> Settings:
    """Return the settings of a raw section, or the defaults where there is none.

    Raises DerenderError : an unknown key or a value of the wrong kind, with its line.
    """
    settings = Settings()
    if section is None:
        return settings
    section.allow(*KEYS)
    counts = {
        key: section[key].integer(lower=1, upper=10_000_000)
        for key in ("thin", "particles", "population", "chains", "draws")
        if key in section
    }
    if "warmup" in section:
        counts["warmup"] = section["warmup"].integer(lower=0, upper=10_000_000)
    settings = settings._replace(**counts)
    plain = section.plain()
    if "order" in section:
        if plain["order"] not in ("mixture", "cycle"):
            raise section["order"].fault(f"order is {plain['order']!r}", "choose mixture or cycle")
        settings = settings._replace(cycle=plain["order"] == "cycle")
    if "kernels" in section:
        section["kernels"].sequence()
        entries = [{entry: None} if isinstance(entry, str) else entry for entry in plain["kernels"]]
        for entry in entries:
            fits = isinstance(entry, dict) and all(v is None or isinstance(v, dict) for v in entry.values())
            if not fits:
                raise section["kernels"].fault("a kernel is not a name with options", "write - drift: {weight: 0.5}")
        settings = settings._replace(kernels=entries, where=section["kernels"].where)
    return settings


@dataclass(eq=False)
class MixtureSampler:
    """A mixture or cycle of kernels on a target, for `chains.run_chain`.

    population : particles of each tempered population that `prepared` sends out to find the mode; 1: none, the start
        is the resampled draw.
    """

    segment: int = field(default=100, init=False)
    target: Any  # the posterior
    parts: list[Part]  # the mixture
    thin: int = 20  # steps for each draw
    cycle: bool = False  # kernels take turns instead of being drawn by weight
    particles: int = 100  # draws from the prior of which importance resampling takes the start
    population: int = 16
    places: np.ndarray | None = None  # (n, P) that pilots found, and what fits them
    learned: Tuning | None = None

    @functools.cached_property
    def _first(self) -> Backend:
        return backend_of(self.target, self.parts, self.cycle)

    def backend(self) -> Backend:
        """Return what runs the mixture, for one thread and one stretch: it outlives none of the values returned."""
        return self._first.twin()

    def prepared(self, seed: int, chains: int, jobs: int) -> "MixtureSampler":
        """Return the sampler with what pilots of `chains` chains found together; they depend on the seed alone."""
        if self.population <= 1:
            return self
        walking = [part for part in self.parts if part.type in LOCAL] or self.parts
        local = backend_of(self.target, walking, self.cycle)
        backends = [self.backend() for _ in range(chains)]
        movers = [local.twin() for _ in range(chains)]
        found = pilot_runs(self.target.space, backends, self.parts, movers, seed, jobs, self.thin, self.population,
                    self.particles)  # fmt: skip
        if found is None:  # nothing possible: each chain starts from the prior on its own
            return self
        sampler = copy(self)
        sampler.places, sampler.learned = found
        return sampler

    def start(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        space = self.target.space
        if self.places is not None:
            values = self.places[int(rng.random() * len(self.places))]
        else:
            values = importance_resampling(rng, space, self.backend(), self.particles)
        tuning = self.learned or first_tuning(space, values)
        return _pack(values, tuning, np.empty((0, len(values))), self.parts)

    def warm_up(
        self, rng: np.random.Generator, state: dict[str, np.ndarray], done: int, rounds: int, total: int
    ) -> dict[str, np.ndarray]:
        values, tuning, history, counts, taken = _unpack(state)
        backend = self.backend()
        stop = done + rounds
        while done < stop:
            stretch_rounds = min(25, stop - done)
            stretch = backend.sweep(rng, values, tuning, stretch_rounds, self.thin, taken)
            values = stretch.values[-1]
            taken += stretch_rounds * self.thin
            done += stretch_rounds
            gain = 3.0 / math.sqrt(1.0 + 10.0 * done / total)
            tuning = tuning._replace(scale=rescale(tuning.scale, self.parts, stretch.counts, gain))
            history = np.concatenate([history, stretch.values])
            tuning = shaped(self.target.space, tuning, history[len(history) // 2 :])
        return _pack(values, tuning, history if done < total else history[:0], self.parts, counts, taken)

    def advance(
        self, rng: np.random.Generator, state: dict[str, np.ndarray], draws: int
    ) -> tuple[dict[str, np.ndarray], Segment]:
        values, tuning, history, counts, taken = _unpack(state)
        stretch = self.backend().sweep(rng, values, tuning, draws, self.thin, taken)
        taken += draws * self.thin
        state = _pack(stretch.values[-1], tuning, history, self.parts, counts + stretch.counts, taken)
        return state, Segment(stretch.values, stretch.densities[:, 0], stretch.densities[:, 1])


def importance_resampling(rng: np.random.Generator, space: Space, backend: Backend, particles: int) -> np.ndarray:
    """Return one of `particles` draws from the prior, chosen in proportion to its likelihood (section 3)."""
    drawn = [space.sample(rng) for _ in range(particles)]
    logs = np.array([backend.evaluate(values)[1] for values in drawn])
    return drawn[systematic(rng, np.exp(logs - np.max(logs)), 1)[0]]


def _pack(
    values: np.ndarray,
    tuning: Tuning,
    history: np.ndarray,
    parts: list[Part],
    counts: np.ndarray | None = None,
    taken: int = 0,
) -> dict[str, np.ndarray]:
    """Return the state as arrays by name."""
    return {
        "values": values,
        "mean": tuning.mean,
        "covariance": tuning.covariance,
        "scale": np.frombuffer(json.dumps(dict(tuning.scale)).encode(), np.uint8),
        "temperature": np.array(tuning.temperature),
        "archive": tuning.places,
        "history": history,
        "counts": np.zeros((len(parts), 2), np.int64) if counts is None else counts,
        "taken": np.array(taken),
    }


def _unpack(state: Mapping[str, np.ndarray]) -> tuple[np.ndarray, Tuning, np.ndarray, np.ndarray, int]:
    scale = json.loads(bytes(state["scale"]))
    tuning = Tuning(state["mean"], state["covariance"], scale, float(state["temperature"]), state["archive"])
    return state["values"], tuning, state["history"], state["counts"], int(state["taken"])
