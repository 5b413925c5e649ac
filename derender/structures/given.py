"""Inference with a given structure: from a document and an image to a posterior.

Where faces and parents are left open, their combinations are found and weighed. Structures that a symmetry of an object
carries into each other (a cube on one of its faces is the cube on any other), where nothing stands on it and the prior
is the same for both, are one: the representative, with the prior probability of all.
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np

from derender.camera.intrinsics import Camera
from derender.compilation.threads import in_threads, interruptible
from derender.document import Document, LikelihoodPrior
from derender.errors import DerenderError
from derender.posterior.compiled.backend import backend_of
from derender.posterior.evidence import evidence_about, short_of_noise
from derender.posterior.kernels import mixture
from derender.posterior.kernels.base import Part
from derender.posterior.sampler import WALKS, MixtureSampler, Population, Settings, tempered
from derender.posterior.target import ObservedImage, SceneTarget, default_parts, period_of
from derender.render.likelihoods import likelihoods
from derender.results.posterior import Posterior, StructurePosterior
from derender.results.trust import FITS
from derender.sampling.chains import (
    DETECTED,
    POPULATIONS,
    SEARCHES,
    STRUCTURES,
    Outcome,
    Plan,
    child_seed,
    fingerprint,
    stream,
)
from derender.sampling.evidence import Evidence, shares
from derender.scene.distributions import Distribution
from derender.scene.graph import SceneGraph
from derender.scene.priors.terms import total_log_density, with_relations
from derender.scene.priors.tree import TreePrior
from derender.scene.shapes import Body
from derender.structures.detected import places_of, solids_seen
from derender.structures.options import Options, names_objects
from derender.structures.parts import part_at, part_of, part_of_one, run_until_agreed

STRUCTURE_DRAWS = 300  # of the prior at least, among which its structures are looked for
DRAWS_EACH, MOST_DRAWS = 20, 20_000  # of the prior for each that is found; and at most: equal ones count together
FIRST_DRAWS = 8  # after which a structure that was the only one is
RULED_OUT = 2_000  # scenes of a structure that break the terms, without one that does not
PREFERRED = "-z"  # face to rest on of a representative
PARTICLES, STEPS = 50, 60  # of the population by which a structure is looked at
# Nats below the likeliest at which a structure has no weight: by such populations, whose evidence was up to 15 too low
# for 9 unknowns, and differed by 2 to 12 from one to the next; and by the heights of walks, which leave out its volume.
OUT_OF_THE_QUESTION = 60.0
# Nats of each pixel below the likeliest, at most, of a structure's place where solids were seen: at .3 lay a right one.
ROUGHLY = 1.0
# Draws of each walk about which a structure is integrated, after so many rounds: about 180 places of the walks that
# look for modes alone the errors of 9 unknowns' integrals were .3 to 2 nats.
DRAWS, SETTLING = 150, 30
MOST_STRUCTURES = 64
LEAST_WEIGHT = 1e-3  # of a structure that is given chains
SMC_PARTICLES, SMC_STEPS = 400, 100
MOST_TIMES = 4  # the draws that are usual, of chains that go on because they disagree
# Searches for the mode, at most; nats within which two have ended at the same height: walks leave a few open.
MOST_SEARCHES, AS_HIGH = 4, 10.0
CLIMB_DRAWS = 200  # and as many rounds of warm-up, of chains of which the best draw alone is asked

Progress = Callable[[float, str], None]


def structures(prior: TreePrior, rng: np.random.Generator) -> list[SceneGraph]:
    """Return a scene of each structure that the prior can draw: of draws without the terms, which may allow one in
    hundreds, those of which the terms allow a scene before they have ruled out RULED_OUT."""
    shown: dict[tuple, SceneGraph | None] = {}
    ruled_out: Counter[tuple] = Counter()
    drawn, wanted = 0, FIRST_DRAWS
    while drawn < wanted or any(shown[key] is None and ruled_out[key] < RULED_OUT for key in shown):
        if drawn == MOST_DRAWS:
            break
        graph = prior.sample_unconstrained(rng)
        drawn += 1
        key = graph.structure()
        if shown.get(key) is None:
            allowed = total_log_density(prior.constraints, graph) > -math.inf
            shown[key] = with_relations(prior.constraints, graph) if allowed else None
            ruled_out[key] += shown[key] is None
        if len(shown) > 1:
            wanted = min(max(STRUCTURE_DRAWS, DRAWS_EACH * len(shown)), MOST_DRAWS)
    return [graph for graph in shown.values() if graph is not None] or [prior.sample(rng)]


class Candidate(NamedTuple):
    """A structure that a prior of named objects can draw, and how probable it is given the image.
    sampler : with places that walks met, or None: it has no weight, or is the only one and none was asked yet."""

    target: SceneTarget
    sampler: MixtureSampler | None
    weight: float = 1.0
    error: float = 0.0  # standard error of the weight
    interval: tuple[float, float] | None = None  # in which it lies with 90 %


def candidates(
    found: list[tuple[SceneTarget, float]], settings: Settings, seed: int, tell: Callable[..., Any]
) -> list[Candidate]:
    """Return a Candidate of each structure, given with the log of its prior probability: that times its evidence.

    A tempered population tells which ones are out of the question; of the others walks find where the posterior lies,
    and importance sampling about what they met gives the integral with its error.
    """
    if len(found) == 1:
        return [Candidate(found[0][0], None)]
    rng, done = np.random.default_rng([seed, 2]), 0

    def look(rng: np.random.Generator, target: SceneTarget, log_prior: float) -> float:
        nonlocal done
        mixed = mixture_of(target, settings)
        population = tempered(rng, target.space, backend_of(target, mixed), mixed, PARTICLES, STEPS, settings.particles)
        done += 1
        tell(0.5 * done / len(found), "looking at structures")
        return log_prior + population.log_evidence

    tell(0.0, "looking at structures")
    structures = [(sampler_of(target, mixture_of(target, settings), settings), prior) for target, prior in found]
    structures = with_places_seen(structures, seed) if found[0][0].sizes_open else structures
    rough = np.array(in_threads(rng, [partial(look, target=target, log_prior=prior) for target, prior in found]))
    seen = np.array([prior + sampler.seen_height for sampler, prior in structures])
    pixels = found[0][0].images.observed.size
    near = (rough > rough.max() - OUT_OF_THE_QUESTION) | (seen > seen.max() - ROUGHLY * pixels)
    possible = np.flatnonzero(near).tolist()
    samplers = searched(structures, seed, possible,
                        lambda done: tell(0.5 + 0.3 * min(done / len(possible), 1.0), "searching"))  # fmt: skip
    heights = np.array([prior + (one.height if one is not None else -np.inf)
                        for one, (_, prior) in zip(samplers, found, strict=True)])  # fmt: skip
    logs, errors = np.full(len(found), -np.inf), np.zeros(len(found))
    for k in np.flatnonzero(heights > heights.max() - OUT_OF_THE_QUESTION).tolist():
        tell(0.8, "weighing structures")
        integral = integral_of(rng, cast(MixtureSampler, samplers[k]))
        logs[k], errors[k] = found[k][1] + integral.log, integral.standard_error
    weights, spread, intervals = shares(rng, logs, errors)
    return [Candidate(target, samplers[k], float(weights[k]), float(spread[k]), (float(low), float(high)))
            for k, ((target, _), (low, high)) in enumerate(zip(found, intervals, strict=True))]  # fmt: skip


def with_places_seen(
    structures: Sequence[tuple[MixtureSampler, float]], seed: int
) -> list[tuple[MixtureSampler, float]]:
    """Return samplers without places, each beside a number, that begin some walks where solids are detected."""
    one = structures[0][0]
    if one.population <= 1 or (scene := solids_seen(one.target, seed)) is None:
        return list(structures)
    rng = stream(seed, DETECTED)
    return [(replace(sampler, seen=places_of(rng, sampler.target, sampler.backend(), scene)), prior)
            for sampler, prior in structures]  # fmt: skip


def integral_of(rng: np.random.Generator, sampler: MixtureSampler) -> Evidence:
    """Return the Evidence of a sampler's structure about the draws of some walks from the places that it has."""

    def drawn(rng: np.random.Generator) -> np.ndarray:
        state = sampler.warm_up(rng, sampler.start(rng), 0, SETTLING, SETTLING)
        return sampler.advance(rng, state, DRAWS)[1].values

    places = np.concatenate(in_threads(rng, [drawn] * WALKS))
    return evidence_about(rng, sampler.target.space, sampler.backend(), places)


def mixture_of(target: SceneTarget, settings: Settings) -> list[Part]:
    """Return the mixture of kernels that settings name, or the usual one."""
    entries = settings.kernels if settings.kernels is not None else default_parts()
    return mixture(target.space, entries, settings.where)


def sampler_of(target: SceneTarget, mixed: list[Part], settings: Settings) -> MixtureSampler:
    """Return the sampler of a structure, which knows no places yet."""
    return MixtureSampler(target, mixed, settings.thin, settings.particles, settings.population)


def seed_of(seed: int, number: int) -> int:
    """Return the seed of a structure's chains: that of the first one is the run's itself."""
    return child_seed(seed, STRUCTURES, number) if number else seed


def representative(prior: TreePrior, graph: SceneGraph) -> SceneGraph:
    """Return the graph of the one structure that stands for all those that say the same."""
    for vertex in graph.vertices:
        face = vertex.contact.child_face
        if face is None or face not in vertex.body.shape.face_names or graph.children(vertex.name):
            continue
        laws = _laws(prior, graph, vertex.name)
        if laws is None:
            continue
        for other in sorted(_alike(vertex.body, face), key=lambda name: (name != PREFERRED, name)):
            if other == face:
                break
            contact = vertex.contact
            renamed = graph.replace(vertex.name, contact=type(contact)(contact.type, contact.parent_face, other,
                                                                       contact.values))  # fmt: skip
            if _laws(prior, renamed, vertex.name) == laws and prior.log_density(renamed) > -math.inf:
                graph = renamed
                break
    return graph


def _alike(body: Body, face: str) -> list[str]:
    """Return the faces into which the symmetries of a solid carry one of its faces."""
    normal = body.face(face).frame[:3, 2]
    turned = body.shape.symmetry.rotations @ normal
    normals = {name: body.face(name).frame[:3, 2] for name in body.shape.face_names}
    return [name for name, n in normals.items() if (np.abs(turned - n).max(axis=1) < 1e-9).any()]


def _laws(prior: TreePrior, graph: SceneGraph, name: str) -> dict[str, tuple] | None:
    """Return the priors of an object's free numbers by address; None where its theta does not go all the way round."""
    found: dict[str, Distribution] = prior.free_addresses(graph)
    own = {address: law for address, law in found.items() if address.startswith(f"{name}.")}
    theta = f"{name}.contact.theta"
    if theta in graph.numbers() and (theta not in own or period_of(graph, theta, own[theta]) is None):
        return None
    return {address: (law.name, *law.parameters) for address, law in own.items()}


class Result(NamedTuple):
    """What came of it. posterior; interrupted: by Ctrl-C, with what there was; lost: why chains died, by number."""

    posterior: Posterior
    interrupted: bool
    lost: dict[int, str]


def observed_image(image: np.ndarray, camera: Camera, likelihood: LikelihoodPrior) -> ObservedImage:
    """Return the image bound to the likelihood's fixed numbers; its unknowns start at their prior means."""
    likelihoods[likelihood.type].complete(likelihood.means)
    return ObservedImage(camera, image, likelihood.type, likelihood.means)


def targets(document: Document, image: np.ndarray, camera: Camera, seed: int) -> list[tuple[SceneTarget, float]]:
    """Return a target for each structure that the prior can draw, with the log of its prior probability; see
    `representative`. Raises DerenderError : nothing is unknown, or there are too many structures."""
    likelihood = document.likelihood or LikelihoodPrior()
    images = observed_image(image, camera, likelihood)
    prior = cast(TreePrior, document.prior)
    found = structures(prior, np.random.default_rng([seed, 1]))
    shared: dict[tuple, tuple[SceneGraph, list[float]]] = {}
    for graph in found:
        free = prior.free_addresses(graph)
        numbers = {**graph.numbers(), **prior.root.values(graph.root_pose)}
        density = prior.log_density(graph) - total_log_density(prior.constraints, graph)
        for address, law in free.items():
            value = numbers.get(address)
            density -= law.log_density(value) if value is not None and law.size == 1 else 0.0
        same = representative(prior, graph) if len(found) > 1 else graph
        shared.setdefault(same.structure(), (same, []))[1].append(density)
    if len(shared) > MOST_STRUCTURES:
        what = f"the prior leaves more than {MOST_STRUCTURES} combinations of parents and faces open"
        raise DerenderError(what, document.file, "fix some of them, or infer without --scene")
    return [(SceneTarget(prior, graph, images, likelihood.free), float(np.logaddexp.reduce(densities)))
            for graph, densities in shared.values()]  # fmt: skip


def infer_scene(
    document: Document,
    image: np.ndarray,
    camera: Camera,
    settings: Settings | None = None,
    options: Options | None = None,
    command: str = "",
    progress: Progress | None = None,
    warn: Callable[[str], None] | None = None,
) -> Result:
    """Infer the unknown numbers of a document's scene from a depth image.

    image : (H, W) metres, NaN where nothing returned.
    settings : of the chains and particles, as the document's `inference:` may say.
    options : of which method, seed, jobs, folder and resume are looked at. jobs are threads, on
        which the draws do not depend.
    progress : called with the fraction that is done and a word on what is being done.
    warn : called with a line on what makes it slow.

    Raises DerenderError : an open prior, nothing unknown, a fault in the mixture, a checkpoint of another run.
    """
    settings, options = settings or Settings(), options or Options()
    seed, method = options.seed or 0, options.method
    if not names_objects(document):
        raise DerenderError("the prior does not name its objects", document.file, "infer without --scene")
    found = targets(document, image, camera, seed)
    tell = progress or (lambda fraction, words: None)
    parts, lost, interrupted = [], {}, False
    for number, one in enumerate(candidates(found, settings, seed, tell)):
        target = one.target
        if one.weight < LEAST_WEIGHT or interrupted:
            continue
        mixed = mixture_of(target, settings)
        if method == "smc":
            drawn, interrupted = _particles(target, mixed, settings, seed, number, tell)
            parts.append(weighted(drawn, one))
            continue
        backend_of(target, mixed)
        if target.uncompiled and warn is not None and not parts:
            warn(f"chains run uncompiled, a hundred times slower: there is no compiled form of {target.uncompiled}")
        run = fingerprint(
            image.tobytes(), repr(camera), document.file, repr(target.space.unknowns), repr(target.template.numbers()),
            repr(settings._replace(draws=0, goes_on=False, where=None)), method, str(seed), str(number),
        )  # fmt: skip
        outcome = _walk(target, one.sampler, mixed, settings, options, number, run, tell)
        lost.update(outcome.lost)
        interrupted = interrupted or outcome.interrupted
        part = part_of(target, list(outcome.records.values()), mixed)
        if part is not None:
            part = summit(target, part.best_only(), options.gradient, seed) if method == "map" else part
            parts.append(weighted(part, one))
    if not parts:
        raise KeyboardInterrupt
    total = sum(part.weight for part in parts)
    parts = [part.scaled(1.0 / total) for part in parts]
    posterior = Posterior(tuple(parts), seed, command)
    best = posterior.best_part
    target = next(target for target, _ in found if target.template.structure() == best.graph.structure())
    values = best.values.reshape(-1, best.values.shape[-1])[best.log_density.argmax()]
    short = short_of_noise(stream(seed, SEARCHES), target, values)
    return Result(replace(posterior, meta={"short_of_noise": short}), interrupted, lost)


def weighted(part: StructurePosterior, one: Candidate) -> StructurePosterior:
    """Return a structure's part with its weight and the error of that."""
    return replace(part, weight=one.weight, weight_error=one.error, weight_interval=one.interval)


def _walk(
    target: SceneTarget, known: MixtureSampler | None, mixed: list[Part], settings: Settings, options: Options,
    number: int, run: str, tell: Progress,
) -> Outcome:  # fmt: skip
    """Return the Outcome of the chains of structure `number`, with checkpoints in a folder of their own where there is
    one. known : the sampler with the places that walks met. run : fingerprint of all that decides about the draws."""
    sampler = known or sampler_of(target, mixed, settings)
    draws, warmup, chains = settings.draws, settings.warmup, settings.chains
    place = None
    if options.method == "map":
        draws, warmup = CLIMB_DRAWS, CLIMB_DRAWS
    elif options.folder is not None:
        place = options.folder / "checkpoint" / str(number)
        place.mkdir(parents=True, exist_ok=True)
    own, jobs = seed_of(options.seed or 0, number), options.jobs or 1
    if known is None and not (
        options.resume and place is not None and all((place / f"chain_{k}.npz").exists() for k in range(chains))
    ):
        tell(0.0, "searching")
        alone = [(sampler, 0.0)]
        (found,) = searched(with_places_seen(alone, own) if target.sizes_open else alone, own)
        sampler = cast(MixtureSampler, found)
    plan = Plan(sampler, own, chains, warmup, draws, place, run, options.resume)
    done = dict.fromkeys(range(chains), 0)

    def report(chain: int, steps: int, most: int) -> None:
        done[chain] = steps
        tell(sum(done.values()) / (chains * most), "sampling")

    goes_on = settings.goes_on and options.method != "map"
    return run_until_agreed(plan, target, MOST_TIMES * draws if goes_on else draws, jobs, report)


def searched(
    structures: Sequence[tuple[MixtureSampler, float]], seed: int, first: Sequence[int] = (0,),
    tell: Callable[[int], Any] = lambda done: None,
) -> list[MixtureSampler | None]:  # fmt: skip
    """Return the sampler of each structure with the places that walks met; None of those that were not searched.

    Until the likeliest scene explains the image as its noise lets expect, or two searches end as high, with ever more
    particles, and from the second on also from where solids are detected: of three cubes that float anywhere one search
    in two ended thousands of nats below the mode.

    structures : samplers without places, each with the log of its prior probability. first : numbers of those that are
        searched first. tell : called with how many searches are done.
    """
    best: list[MixtureSampler | None] = [None] * len(structures)
    rng, highest, likeliest, done = stream(seed, SEARCHES), -math.inf, structures[first[0]][0], 0
    for number in range(MOST_SEARCHES):
        former, ended = highest, -math.inf
        if number:  # solids are detected anew: what two searches were led to by the same ones would be the same
            structures = with_places_seen(structures, child_seed(seed, SEARCHES, number))
        for k in first if number == 0 else range(len(structures)):
            tell(done)
            sampler, log_prior = structures[k]
            own = child_seed(seed_of(seed, k), SEARCHES, number) if number else seed_of(seed, k)
            done += 1
            found = replace(sampler, population=sampler.population << max(number - 1, 0)).prepared(own)
            height, known = log_prior + found.height, best[k]
            best[k] = found if known is None or found.height > known.height else known
            ended = max(ended, height)
            if height > highest:
                highest, likeliest = height, found
        assert likeliest.places is not None
        if likeliest.population <= 1 or abs(ended - former) < AS_HIGH:
            break
        if short_of_noise(rng, likeliest.target, likeliest.places[-1]) < FITS:
            break
    return best


def summit(target: SceneTarget, part: StructurePosterior, gradient: str, seed: int) -> StructurePosterior:
    """Return a part of one draw moved to the end of an ascent by gradient, if that is more probable."""
    from derender.posterior.ascent import climb

    values = climb(target, part.values[0, 0], gradient, np.random.default_rng([seed, 3]))
    if np.array_equal(values, part.values[0, 0]):
        return part
    return part_of_one(target, values, part.weight, part.extras)


def _particles(
    target: SceneTarget, mixed: list[Part], settings: Settings, seed: int, number: int, tell: Progress
) -> tuple[StructurePosterior, bool]:
    """Return tempered particles as chains of independent draws, one for each of `settings.chains` populations, and
    whether someone interrupted them: then of the populations that are done, or the best particle so far."""
    populations: list[Population] = []
    with interruptible() as stop:
        for chain in range(settings.chains):
            tell(chain / settings.chains, "tempering")
            rng = stream(seed, POPULATIONS, number, chain)
            backend = backend_of(target, mixed)
            found = tempered(rng, target.space, backend, mixed, SMC_PARTICLES, SMC_STEPS, stop=stop.is_set)
            if stop.is_set() and found.exponent < 1.0:
                break
            populations.append(found)
        interrupted = stop.is_set()
    if not populations:
        return part_of_one(target, found.likeliest(), 1.0, {}), interrupted
    densities = np.stack([population.densities for population in populations])
    extras = {"log_evidence": [population.log_evidence for population in populations]}
    values = np.stack([population.values for population in populations])
    return part_at(target, values, densities, 1.0, extras), interrupted
