"""The sampler of a fixed structure, start, warm-up that adapts, draws that do not; and `inference:`, its settings.

Populations follow prior x likelihood^b (Del Moral, Doucet, Jasra 2006): particles start from the prior, and b rises
from 0 to 1 as far as the weights' effective number bears; at each stage particles are resampled and moved by a mixture
of kernels. It finds the one mode that matters among many. The product of the mean weights estimates the evidence;
adaptive stages bias it by O(1 / n).

Pilots look together, before any draw is kept, for where the posterior is and how to walk on it. Populations find good
places. From there each chain climbs a ladder of temperatures (Geyer 1991): on the levels above the first the likelihood
is raised to a power below one, narrow modes are wide there, and neighbours exchange their places by the Metropolis
rule. What the first level has seen by the end fixes the tuning that every chain starts with. What one chain missed
another found: only together do they know all modes.
"""

import functools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from derender.errors import DerenderError
from derender.posterior.compiled.backend import Backend, backend_of
from derender.posterior.kernels.base import Part, Tuning, centre_of, covariance_of, first_tuning, rescale
from derender.posterior.space import Space
from derender.sampling.chains import Segment
from derender.sampling.metropolis import log_threshold
from derender.scene.priors.terms import MOST_TRIES

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


FEW = 20  # draws' worth that must meet the prior's terms before a population is taken from them
ROUNDING = 1e-6  # of log densities
GAIN = 2.0  # change of a log scale for an acceptance rate wrong by 1, at each stage
LEAST_STEP = 1.05  # an exponent grows by this factor at least: a population of a few particles cannot stall
BISECTIONS = 60  # halve [present, 1] to below the spacing of floating point numbers

Advance = Callable[[np.ndarray, float], np.ndarray]


class Population(NamedTuple):
    """Particles of equal weight from the posterior."""

    values: np.ndarray  # (n, P) float64
    densities: np.ndarray  # (n, 2) float64, log prior and log likelihood
    log_evidence: float  # estimate of log p(image); unbiased on the natural scale but for the adaptation
    stops: list[np.ndarray]  # (n, P) float64, the populations at the exponents that were asked for, or just above


def from_prior(
    rng: np.random.Generator, space: Space, backend: "Backend", count: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return values (count, P) from the prior with its terms, their densities (count, 2), and the log of what the terms
    leave of the unknowns' own prior: draws of that one weighed by the terms and resampled, more where few count.

    Raises DerenderError where no draw meets the terms.
    """
    values, densities, terms = (np.empty((0, *shape)) for shape in ((space.offsets[-1],), (2,), ()))
    while True:
        drawn = np.array([space.sample(rng) for _ in range(count)])
        found = np.array([backend.evaluate(value) for value in drawn])
        own = np.array([space.log_prior(value) for value in drawn])
        values, densities = np.concatenate([values, drawn]), np.concatenate([densities, found])
        terms = np.concatenate([terms, found[:, 0] - own])
        if np.abs(terms).max() < ROUNDING:
            return values, densities, 0.0
        most = terms.max()
        weights = np.exp(terms - most) if most > -np.inf else np.zeros(len(terms))
        if np.sum(weights) ** 2 >= FEW * np.sum(weights**2) > 0.0 or len(values) >= MOST_TRIES:
            break
    if most == -np.inf:
        remedy = "spread the objects out or ask for fewer"
        raise DerenderError(f"none of {len(values)} scenes drawn meets the constraints", remedy=remedy)
    chosen = systematic(rng, weights, count)[rng.permutation(count)]
    return values[chosen], densities[chosen], float(most + np.log(np.mean(weights)))


def next_temperature(gain: np.ndarray, present: float, share: float = 0.5) -> float:
    """Return the largest exponent, at most 1, at which the weights' effective number is `share` of the particles.

    Particles that no stage keeps (a gain of -inf) do not count.
    """
    possible = gain[gain > -np.inf]
    if not len(possible):
        raise ValueError("no particle has any weight")

    def effective(exponent: float) -> float:
        weights = np.exp((exponent - present) * (possible - np.max(possible)))
        return float(np.sum(weights) ** 2 / np.sum(weights**2))

    wanted = min(share * len(gain), 0.999 * len(possible))
    if effective(1.0) >= wanted:
        return 1.0
    low, high = present, 1.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective(middle) >= wanted else (low, middle)
    return min(1.0, max(low, present * LEAST_STEP))


def systematic(rng: np.random.Generator, weights: np.ndarray, count: int | None = None) -> np.ndarray:
    """Return (count,) indices (default: as many as there are weights): systematic resampling, which copies each
    particle n w or n w + 1 times."""
    count = len(weights) if count is None else count
    places = (rng.random() + np.arange(count)) / count
    cumulative = np.cumsum(weights) / np.sum(weights)
    return np.minimum(np.searchsorted(cumulative, places, side="right"), len(weights) - 1)


def anneal(
    rng: np.random.Generator, gain: np.ndarray, advance: Advance, count: int | None = None, share: float = 0.5
) -> float:
    """Raise the exponent on a population's gain from 0 to 1; return the log of the estimated mean weight.

    gain : (n,) log increments of the particles, -inf allowed.
    advance : called at each stage with the indices of the particles that are kept, copies among them, and the exponent;
        moves them and returns their gains in full.
    count : of particles after the first stage; None: n.
    share : of the particles, the effective number that a stage leaves: the smaller, the fewer stages.
    """
    count = len(gain) if count is None else count
    log_mean, present = 0.0, 0.0
    while present < 1.0:
        following = next_temperature(gain, present, share * count / len(gain))
        with np.errstate(invalid="ignore"):  # 0 times -inf, where nothing is
            logs = np.where(gain > -np.inf, (following - present) * gain, -np.inf)
        weights = np.exp(logs - np.max(logs))
        log_mean += float(np.max(logs) + np.log(np.mean(weights)))
        chosen = systematic(rng, weights)
        if len(gain) > count:  # from many draws to the population
            chosen = chosen[rng.permutation(len(gain))[:count]]
        gain, present = advance(chosen, following), following
    return log_mean


def tempered(
    rng: np.random.Generator,
    space: Space,
    backend: "Backend",
    parts: list[Part],
    particles: int,
    steps: int,
    drawn: int | None = None,
    stops: Sequence[float] = (),
    share: float = 0.5,
) -> Population:
    """Run the sampler.

    backend : see `backend_of`.
    parts : the mixture that moves the particles.
    particles : how many. steps : of the mixture for each particle and stage.
    drawn : how many draws from the prior the first stage weighs; at least `particles`, and as many if not given.
    stops : exponents, rising, at which to keep the population.
    share : of the particles, the weights' effective number that a stage leaves: the smaller, the fewer stages.
    """
    values, densities, log_evidence = from_prior(rng, space, backend, max(particles, drawn or particles))
    tuning = first_tuning(space, values[0])
    kept = list[np.ndarray]()

    def advance(chosen: np.ndarray, exponent: float) -> np.ndarray:
        nonlocal values, densities, tuning
        values, densities = values[chosen], densities[chosen]
        tuning = tuning._replace(temperature=exponent)
        counts = np.zeros((len(parts), 2), np.int64)
        for n in range(particles):
            stretch = backend.sweep(rng, values[n], tuning, 1, steps)
            values[n], densities[n] = stretch.values[-1], stretch.densities[-1]
            counts += stretch.counts
        tuning = tuning._replace(scale=rescale(tuning.scale, parts, counts, GAIN))
        while len(kept) < len(stops) and exponent >= stops[len(kept)]:
            kept.append(values.copy())
        return densities[:, 1]

    log_ratio = anneal(rng, densities[:, 1], advance, particles, share)
    return Population(values, densities, log_evidence + log_ratio, kept)


LOCAL = ("drift", "slide")  # kernels that move a starting population
GOOD = 20.0  # nats below the best place found: as good a start
START_STEPS = 40  # of the mixture, for each particle and temperature
SHARE = 0.25  # of a starting population that a stage leaves: more particles and fewer stages find more
LADDER = (1.0, 0.5, 0.25, 0.12, 0.06)
STAGES = (10, 20, 40, 80)  # rounds of each; then all levels are fitted anew to what all chains saw in its later half
STRETCH = 5  # rounds between two exchanges
RISE = 3.0  # nats by which the mean log density still rises from one stage to the next: it has not arrived
MOST_STAGES = 6
COLD, HOT, BORROWED = 144, 48, 16  # places that archives keep: the first level's, others', and from each hotter level


class Climb(NamedTuple):
    """One chain's stage."""

    last: np.ndarray  # (R, P), where each level ended
    seen: np.ndarray  # (R, n, P)
    density: float  # mean log posterior of the first level
    scales: list[dict[str, float]]  # step scales of each level


def pilot_runs(space: Space, backends: list, parts: list[Part], movers: list, seed: int, jobs: int, thin: int,
                population: int, particles: int) -> tuple[np.ndarray, Tuning] | None:  # fmt: skip
    """Return typical places (n, P) that pilots found and the Tuning fitted to them; None where nothing possible was.

    backends : one for each chain, of the mixture `parts`; movers : the same, of its local kernels only.
    thin : steps in a round. population, particles : of each start, see `smc.tempered`.
    """

    def each(work, *columns) -> list:
        with ThreadPoolExecutor(jobs) as pool:
            return list(pool.map(work, range(len(backends)), *columns))

    def explore(number: int):
        rng = np.random.default_rng([seed, 3, number])
        mover = movers[number]
        return tempered(rng, space, mover, mover.parts, population, START_STEPS, particles, LADDER[::-1], SHARE)

    explored = each(explore)
    densities = np.concatenate([found.densities.sum(axis=1) for found in explored])
    good = densities > np.max(densities) - GOOD
    if not good.any():
        return None
    pools = [np.concatenate([found.stops[-1 - r] for found in explored]) for r in range(len(LADDER))]
    pools[0] = np.concatenate([found.values for found in explored])[good]
    levels = [first_tuning(space, pools[0][0], temperature) for temperature in LADDER]
    levels = refitted(space, levels, pools, [[{}]] * len(levels))
    rngs = [np.random.default_rng([seed, 4, number]) for number in range(len(backends))]
    starts = [np.array([pool[rng.integers(len(pool))] for pool in pools]) for rng in rngs]
    stage, density, rising = 0, -math.inf, True
    while stage < len(STAGES) or (rising and stage < MOST_STAGES):
        with ThreadPoolExecutor(jobs) as pool:
            list(pool.map(backends[0].program, levels))
        rounds = STAGES[min(stage, len(STAGES) - 1)]
        climbs = each(lambda n, rng, start, rounds=rounds, levels=levels:
                      climb(rng, backends[n], parts, levels, start, rounds, thin), rngs, starts)  # fmt: skip
        starts = [one.last for one in climbs]
        pools = [np.concatenate([one.seen[r] for one in climbs]) for r in range(len(levels))]
        levels = refitted(space, levels, pools, [[one.scales[r] for one in climbs] for r in range(len(levels))])
        stage, former, density = stage + 1, density, float(np.mean([one.density for one in climbs]))
        rising = density > former + RISE
    backends[0].program(levels[0])
    return pools[0], levels[0]


def climb(
    rng: np.random.Generator,
    backend: Any,
    parts: list[Part],
    levels: list[Tuning],
    start: np.ndarray,
    rounds: int,
    thin: int,
) -> Climb:
    """Walk on all levels from `start` (R, P) and let neighbours exchange places, with

    log ratio = (temperature - temperature') * (log likelihood' - log likelihood).
    """
    places, logs = start.copy(), np.zeros((len(levels), 2))
    seen: list[list[np.ndarray]] = [[] for _ in levels]
    tunings, densities = list(levels), []
    for turn in range(0, rounds, STRETCH):
        gain = 3.0 / math.sqrt(1.0 + turn / STRETCH)
        for r, tuning in enumerate(tunings):
            stretch = backend.sweep(rng, places[r], tuning, STRETCH, thin, turn * thin)
            places[r], logs[r] = stretch.values[-1], stretch.densities[-1]
            tunings[r] = tuning._replace(scale=rescale(tuning.scale, parts, stretch.counts, gain))
            seen[r].append(stretch.values)
            if r == 0:
                densities.append(stretch.densities.sum(axis=1).mean())
        for r in range(len(levels) - 1):
            log_ratio = (levels[r].temperature - levels[r + 1].temperature) * (logs[r + 1, 1] - logs[r, 1])
            if log_threshold(rng) < log_ratio:
                places[[r, r + 1]], logs[[r, r + 1]] = places[[r + 1, r]], logs[[r + 1, r]]
    later = np.array([np.concatenate(one)[rounds // 2 :] for one in seen])
    return Climb(places, later, float(np.mean(densities[len(densities) // 2 :])), [dict(t.scale) for t in tunings])


def refitted(space: Space, levels: list[Tuning], pools: list[np.ndarray], scales: list[list]) -> list[Tuning]:
    """Return the levels' tunings as fitted to the places (n, P) and step scales that all chains found on each.

    A level's archive also takes places of the hotter ones: what they know of other modes comes down one object at a
    time, which is far likelier than by an exchange of whole scenes.
    """
    result = []
    for r, level in enumerate(levels):
        archive = [spread_out(pools[r], HOT if r else COLD), *(spread_out(pool, BORROWED) for pool in pools[r + 1 :])]
        names = {name for scale in scales[r] for name in scale}
        means = {n: float(np.exp(np.mean([np.log(scale.get(n, 1.0)) for scale in scales[r]]))) for n in sorted(names)}
        result.append(shaped(space, level._replace(scale=means, archive=np.concatenate(archive)), pools[r]))
    return result


def shaped(space: Space, tuning: Tuning, recent: np.ndarray) -> Tuning:
    """Return the tuning with centre and covariance fitted to where chains have been of late."""
    if len(recent) < 20:
        return tuning
    centre = centre_of(space, recent)
    return tuning._replace(mean=centre, covariance=covariance_of(space, recent, centre))


def spread_out(places: np.ndarray, most: int = COLD) -> np.ndarray:
    """Return at most so many of the places, evenly spaced."""
    return places[np.linspace(0, len(places) - 1, min(most, len(places))).round().astype(int)]
