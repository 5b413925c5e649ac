"""The sampler of a fixed structure: start, warm-up that adapts, draws that do not; and `inference:`, its settings.

Populations follow prior x likelihood^b (Del Moral, Doucet, Jasra 2006): particles start from the prior, and b rises
from 0 to 1 as far as the weights' effective number bears; at each stage particles are resampled and moved by a mixture
of kernels. It finds the one mode that matters among many. The product of the mean weights estimates the evidence;
adaptive stages bias it by O(1 / n).

Before any draw is kept, populations find together where the posterior is: what one missed another found, and each
counts by its evidence. From their particles walks go out, at a temperature of one and in between at higher ones; those
that end highest are followed. Steps and an archive of places are fitted to them, stage by stage. There chains start,
and only the scales of their steps adapt in their warm-up.
"""

import math
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from derender.compilation.threads import in_threads
from derender.errors import DerenderError
from derender.posterior.compiled.backend import Backend, backend_of
from derender.posterior.kernels.base import Part, Tuning, centre_of, covariance_of, first_tuning, steps_of
from derender.posterior.space import Space
from derender.posterior.target import OF_IMAGE
from derender.sampling.chains import Segment
from derender.sampling.metropolis import adapted_scale, mean_scale
from derender.scene.priors.terms import MOST_TRIES

KEYS = ("kernels", "thin", "particles", "population", "chains", "draws", "warmup")


class Settings(NamedTuple):
    """How chains are run. kernels : entries such as {"drift": {"weight": 0.5}}, or None: the default mixture."""

    kernels: list[dict[str, Any]] | None = None
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
    if "kernels" in section:
        section["kernels"].sequence()
        entries = [{entry: None} if isinstance(entry, str) else entry for entry in plain["kernels"]]
        for entry in entries:
            fits = isinstance(entry, dict) and all(v is None or isinstance(v, dict) for v in entry.values())
            if not fits:
                raise section["kernels"].fault("a kernel is not a name with options", "write - drift: {weight: 0.5}")
        settings = settings._replace(kernels=entries, where=section["kernels"].where)
    return settings


class Walk(NamedTuple):
    """Some rounds of steps whose scales adapt."""

    later: np.ndarray  # (n, P), the places of its later half
    height: float  # mean log posterior density there
    scale: np.ndarray  # (K,), to which its steps' adapted


@dataclass(eq=False)
class MixtureSampler:
    """A mixture of kernels on a target, for `chains.run_chain`.

    population : particles of each tempered population that `prepared` sends out to find the mode; 1: none, walks begin
        at importance resampled draws.
    """

    segment: int = field(default=100, init=False)
    target: Any  # the posterior
    parts: list[Part]  # the mixture
    thin: int = 20  # steps for each draw
    particles: int = 100  # draws from the prior of which importance resampling takes the start
    population: int = 16
    places: np.ndarray | None = None  # (n, P) to start from; None: they are looked for
    learned: Tuning | None = None  # what fits them
    height: float = -math.inf  # mean log posterior density of the walks that met them
    seen: np.ndarray | None = None  # (n, P) places, likeliest first, where half of the first walks begin

    @cached_property
    def _first(self) -> Backend:
        return backend_of(self.target, self.parts)

    def backend(self) -> Backend:
        """Return what runs the mixture, for one thread and one stretch: it outlives none of the values returned."""
        return self._first.twin()

    @property
    def seen_height(self) -> float:
        """The log posterior density of the likeliest of those, -inf without any."""
        if self.seen is None or not len(self.seen):
            return -math.inf
        return float(sum(self.backend().evaluate(self.seen[0])))

    def prepared(self, seed: int) -> "MixtureSampler":
        """Return the sampler with typical places that walks met together, and the steps that fit them."""
        rng, space, prepared = np.random.default_rng([seed, 3]), self.target.space, copy(self)
        places = self.first_places(rng)
        starts, borrowed, kept = places[:WALKS], places[:0], list[Walk]()
        tuning = fitted_to(space, first_tuning(space, places[0]), places, borrowed)
        height, rise = -math.inf, math.inf
        for number, (temperature, rounds) in enumerate((*STAGES, *[ARRIVING] * MOST_ARRIVING)):
            if number > len(STAGES) and rise < ARRIVED:
                break
            tuning = tuning._replace(temperature=temperature)
            walks = in_threads(
                rng, [partial(self.walked, values=one, tuning=tuning, rounds=rounds, gain=GAIN) for one in starts]
            )
            if number < len(STAGES):
                met = np.concatenate([walk.later for walk in walks])
                borrowed = np.concatenate([spread_out(met, BORROWED), borrowed])[:MOST_BORROWED]
            if temperature == 1.0:
                both = [*kept, *walks]
                heights = np.array([walk.height for walk in both])
                walks = kept = [both[k] for k in systematic(rng, np.exp(heights - heights.max()), WALKS)]
                former, height = height, float(np.mean([walk.height for walk in kept]))
                rise = height - former
                places = np.concatenate([places[len(places) // 2 :], *(walk.later for walk in kept)])
            starts = np.array([walk.later[-1] for walk in walks])
            tuning = tuning._replace(scale=mean_scale([walk.scale for walk in walks]))
            tuning = fitted_to(space, tuning, places, borrowed)
        prepared.places, prepared.learned = np.concatenate([walk.later for walk in kept]), tuning
        prepared.height = height
        return prepared

    def first_places(self, rng: np.random.Generator) -> np.ndarray:
        """Return places (n, P), at least one for each walk: those given, importance resampled draws, or particles of
        some populations, each of these by its evidence."""
        space = self.target.space
        if self.places is not None:
            return np.resize(self.places, (WALKS, self.places.shape[1]))
        if self.population <= 1:
            backend = self.backend()
            return np.array([importance_resampling(rng, space, backend, self.particles) for _ in range(WALKS)])
        walking = [part._replace(weight=part.weight * (RARELY if part.block.name == OF_IMAGE else 1.0))
                   for part in self.parts if part.type in LOCAL] or self.parts  # fmt: skip
        local = backend_of(self.target, walking)
        found = in_threads(rng, [
            partial(tempered, space=space, backend=local.twin(), parts=walking, particles=self.population,
                    steps=START_STEPS, drawn=self.particles, share=SHARE) for _ in range(POPULATIONS)
        ])  # fmt: skip
        logs = np.array([each.log_evidence for each in found])
        values, weights = np.concatenate([each.values for each in found]), np.exp(logs - logs.max())
        places = values[rng.permutation(systematic(rng, np.repeat(weights, self.population)))]
        if self.seen is None or not len(self.seen):
            return places
        return np.concatenate([self.seen[np.arange(WALKS // 2) % len(self.seen)], places])

    def walked(self, rng: np.random.Generator, values: np.ndarray, tuning: Tuning, rounds: int, gain: float) -> Walk:
        """Return the Walk of so many rounds, in which the scales of its steps adapt."""
        stretch = self.backend().sweep(rng, values, tuning, rounds, self.thin, gain)
        later = rounds // 2
        height = float(stretch.densities[later:].sum(axis=1).mean())
        return Walk(stretch.values[later:], height, stretch.scale)

    def start(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        assert self.places is not None and self.learned is not None, "prepared first"
        values, counts = self.places[int(rng.random() * len(self.places))], np.zeros((len(self.parts), 2), np.int64)
        return _pack(values, self.learned, counts)

    def warm_up(
        self, rng: np.random.Generator, state: dict[str, np.ndarray], done: int, rounds: int, total: int
    ) -> dict[str, np.ndarray]:
        values, tuning, counts = _unpack(state)
        walk = self.walked(rng, values, tuning, rounds, LAST_GAIN)
        return _pack(walk.later[-1], tuning._replace(scale=walk.scale), counts)

    def advance(
        self, rng: np.random.Generator, state: dict[str, np.ndarray], draws: int
    ) -> tuple[dict[str, np.ndarray], Segment]:
        values, tuning, counts = _unpack(state)
        stretch = self.backend().sweep(rng, values, tuning, draws, self.thin)
        state = _pack(stretch.values[-1], tuning, counts + stretch.counts)
        return state, Segment(stretch.values, stretch.densities)


def importance_resampling(rng: np.random.Generator, space: Space, backend: Backend, particles: int) -> np.ndarray:
    """Return one of `particles` draws from the prior, chosen in proportion to its likelihood (section 3)."""
    drawn = [space.sample(rng) for _ in range(particles)]
    logs = np.array([backend.evaluate(values)[1] for values in drawn])
    return drawn[systematic(rng, np.exp(logs - np.max(logs)), 1)[0]]


def _pack(values: np.ndarray, tuning: Tuning, counts: np.ndarray) -> dict[str, np.ndarray]:
    """Return the state as arrays by name."""
    learned = {name: value for name, value in tuning._asdict().items() if name != "temperature"}
    return {"values": values, "counts": counts, **learned}


def _unpack(state: Mapping[str, np.ndarray]) -> tuple[np.ndarray, Tuning, np.ndarray]:
    tuning = Tuning(state["mean"], state["covariance"], state["scale"], archive=state["archive"])
    return state["values"], tuning, state["counts"]


FEW = 20  # draws' worth that must meet the prior's terms before a population is taken from them
ROUNDING = 1e-6  # of log densities
# Change of a log scale for an acceptance rate wrong by 1: at each stage of a population, of so many steps or more; and
# at each step of a walk that looks for the mode, and of a chain's warm-up.
STAGE_GAIN, FULL, GAIN, LAST_GAIN = 2.0, 20, 0.1, 0.03
LEAST_STEP = 1.05  # an exponent grows by this factor at least: a population of a few particles cannot stall
BISECTIONS = 60  # halve [present, 1] to below the spacing of floating point numbers


class Population(NamedTuple):
    """Particles of equal weight from the posterior, or from one whose likelihood counts for less."""

    values: np.ndarray  # (n, P) float64
    densities: np.ndarray  # (n, 2) float64, log prior and log likelihood
    log_evidence: float  # estimate of log p(image); unbiased on the natural scale but for the adaptation
    exponent: float = 1.0  # of the likelihood: less than 1 where someone stopped it

    def likeliest(self) -> np.ndarray:
        """Return the values (P,) of the most probable particle."""
        return self.values[self.densities.sum(axis=1).argmax()]


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


def tempered(
    rng: np.random.Generator,
    space: Space,
    backend: "Backend",
    parts: list[Part],
    particles: int,
    steps: int,
    drawn: int | None = None,
    share: float = 0.5,
    stop: Callable[[], bool] = lambda: False,
) -> Population:
    """Run the sampler.

    backend : see `backend_of`.
    parts : the mixture that moves the particles.
    particles : how many. steps : of the mixture for each particle and stage.
    drawn : how many draws from the prior the first stage weighs; at least `particles`, and as many if not given.
    share : of the particles, the weights' effective number that a stage leaves: the smaller, the fewer stages.
    stop : asked before each particle moves; the population is then returned as it is.
    """
    values, densities, log_evidence = from_prior(rng, space, backend, max(particles, drawn or particles))
    tuning, present = first_tuning(space, values[0]), 0.0
    scale, wanted = steps_of(parts, tuning)[1:3]
    while present < 1.0:
        gain = densities[:, 1]
        following = next_temperature(gain, present, share * particles / len(gain))
        with np.errstate(invalid="ignore"):  # 0 times -inf, where nothing is
            logs = np.where(gain > -np.inf, (following - present) * gain, -np.inf)
        weights = np.exp(logs - np.max(logs))
        log_evidence += float(np.max(logs) + np.log(np.mean(weights)))
        chosen = systematic(rng, weights)
        if len(gain) > particles:  # from many draws to the population
            chosen = chosen[rng.permutation(len(gain))[:particles]]
        values, densities, former, present = values[chosen], densities[chosen], present, following
        tuning = tuning._replace(temperature=present, scale=scale)
        counts = np.zeros((len(parts), 2), np.int64)
        for n in range(particles):
            if stop():
                return Population(values, densities, log_evidence, former)
            stretch = backend.sweep(rng, values[n], tuning, 1, steps)
            values[n], densities[n] = stretch.values[-1], stretch.densities[-1]
            counts += stretch.counts
        for k, (taken, accepted) in enumerate(counts.tolist()):  # fixed while particles move, which keeps the posterior
            if taken and wanted[k] > 0.0:
                trust = min(1.0, taken / FULL)
                scale[k] = adapted_scale(scale[k], accepted / taken, wanted[k], STAGE_GAIN * trust)
    return Population(values, densities, log_evidence)


LOCAL = ("drift", "slide")  # kernels that move a starting population
# Of the mixture, for each particle and temperature. One population of 32 found a tower of four cubes in 6 to 8 of 16
# tries with 40 of them, in 13 to 16 with 100; and where all four missed it, chains agreed on a lesser mode.
START_STEPS = 100
RARELY = 0.1  # of its weight there, a kernel whose steps read the image anew: one takes as long as forty others
SHARE = 0.25  # of a starting population that a stage leaves: more particles and fewer stages find more
# Temperature and rounds of the walks from there, one stage after the other: where the likelihood counts less narrow
# modes are wide, and what all of them met leads the next walks, one object at a time, from one mode to others.
STAGES = ((1.0, 20), *((0.1, 10), (0.3, 10), (1.0, 40)) * 4)
# And further ones, at most so many: until their mean log density rises by fewer nats from one to the next.
ARRIVING, MOST_ARRIVING, ARRIVED = (1.0, 80), 6, 3.0
POPULATIONS, WALKS = 4, 8  # counts
KEPT, BORROWED, MOST_BORROWED = 144, 16, 160  # places that an archive keeps: last ones; of each stage, and of all
ENOUGH = 20  # places from which on their spread says more than the prior's


def fitted_to(space: Space, tuning: Tuning, places: np.ndarray, borrowed: np.ndarray) -> Tuning:
    """Return the tuning with an archive of places (n, P) and of others (m, P), and with the centre and the spread of
    the former where they are enough."""
    tuning = tuning._replace(archive=np.concatenate([spread_out(places, KEPT), borrowed]))
    if len(places) < ENOUGH:
        return tuning
    centre = centre_of(space, places)
    return tuning._replace(mean=centre, covariance=covariance_of(space, places, centre))


def spread_out(places: np.ndarray, most: int) -> np.ndarray:
    """Return at most so many of the places, evenly spaced."""
    return places[np.linspace(0, len(places) - 1, min(most, len(places))).round().astype(int)]
